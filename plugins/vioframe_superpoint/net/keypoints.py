"""From what the heads say to points: heat, suppression of neighbours, descriptors between cells."""

import torch
from torch import Tensor
from torch.nn import functional

from vioframe_superpoint.net.superpoint import CELL_PX

_CENTRE = (CELL_PX - 1) / 2
"""Of the first cell, px, where the centre of the first pixel is 0."""


def heatmap(logits: Tensor) -> Tensor:
    """Probability (B, H, W) that a pixel is its cell's point.

    Args:
        logits: (B, 65, H/8, W/8), of a softmax over the pixels of a cell and the dustbin, which is dropped.
    """
    return functional.pixel_shuffle(logits.softmax(dim=1)[:, :-1], CELL_PX)[:, 0]


def suppress(heat: Tensor, radius: int) -> Tensor:
    """Heat (B, H, W) that is zero but where it is the maximum of the square of 2 radius + 1 pixels around.

    Of equal maxima within one square the first, row by row, is kept, so that no two points are ever as near as that.
    """
    if radius == 0:
        return heat
    highest = heat == _square_maximum(heat, radius)
    order = torch.arange(heat[0].numel(), 0, -1, device=heat.device, dtype=torch.float32).reshape(heat.shape[1:])
    rank = torch.where(highest, order, 0.0)
    return torch.where(highest & (rank == _square_maximum(rank, radius)), heat, 0.0)


def remove_border(heat: Tensor, border: int) -> Tensor:
    """Heat (B, H, W) that is zero within ``border`` px of the edge."""
    if border == 0:
        return heat
    inner = torch.zeros_like(heat)
    inner[:, border:-border, border:-border] = heat[:, border:-border, border:-border]
    return inner


def sample_descriptors(descriptors: Tensor, pixels: Tensor) -> Tensor:
    """Unit descriptors (B, N, D) between cells, bilinear; beyond the outermost centres as at those.

    Args:
        descriptors: (B, D, h, w) at the centres of the cells: that of the first is at 3.5 px.
        pixels: (B, N, 2) px, x right and y down; the centre of the top-left pixel is (0, 0).
    """
    batch, channels, height, width = descriptors.shape
    # Where channels lie together in memory this copies nothing, and each corner is one read of a row.
    rows = descriptors.permute(0, 2, 3, 1).reshape(batch * height * width, channels)
    cells, shares = surrounding_cells(pixels, height, width)
    cells = cells + torch.arange(batch, device=rows.device)[:, None, None] * (height * width)
    mixed = (functional.embedding(cells, rows) * shares.to(rows.dtype)[..., None]).sum(dim=-2)
    return functional.normalize(mixed, dim=-1)


def surrounding_cells(pixels: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
    """Numbers (..., 4), row by row, of the cells around pixels (..., 2) px, and each one's bilinear share (..., 4).

    Args:
        pixels: as of :func:`sample_descriptors`.
        height: of the map, in cells.
        width: likewise.
    """
    places = (pixels.to(torch.float32) - _CENTRE) / CELL_PX
    x = places[..., 0].clamp(0.0, width - 1.0)
    y = places[..., 1].clamp(0.0, height - 1.0)
    left = x.detach().floor().clamp(max=max(width - 2, 0))
    top = y.detach().floor().clamp(max=max(height - 2, 0))
    first = top.long() * width + left.long()
    right, down = min(1, width - 1), width * min(1, height - 1)
    along, across = x - left, y - top
    numbers = torch.stack([first, first + right, first + down, first + down + right], dim=-1)
    shares = torch.stack(
        [(1 - across) * (1 - along), (1 - across) * along, across * (1 - along), across * along], dim=-1
    )
    return numbers, shares


def _square_maximum(values: Tensor, radius: int) -> Tensor:
    """Maximum over the square around each pixel (B, H, W); beyond the edge there is nothing."""
    return _line_maximum(_line_maximum(values, radius).mT, radius).mT


def _line_maximum(values: Tensor, radius: int) -> Tensor:
    """Maximum of 2 radius + 1 neighbours in a row, by doubling: a few passes, where a pooling takes one for each."""
    size = values.shape[-1]
    reached, covered = functional.pad(values, (radius, radius), value=-torch.inf), 1
    while covered < 2 * radius + 1:
        step = min(covered, 2 * radius + 1 - covered)
        reached = torch.maximum(reached[..., :-step], reached[..., step:])
        covered += step
    return reached[..., :size]
