"""What the net is trained to make small: a loss of the detector, and three of the descriptors.

Maps are of cells of 8×8 pixels: (B, ..., h, w) for images of 8h×8w. The centre of the top-left pixel is (0, 0), so that
of the first cell is (3.5, 3.5). ``H`` maps pixels of the first image of a pair to pixels of the second.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

from vioframe_superpoint.net.keypoints import sample_descriptors
from vioframe_superpoint.training.options import DenseLoss, DescriptorLoss, SparseHingeLoss, SparseTripletLoss

CELL = 8
"""px, side of a cell."""
DUSTBIN = CELL * CELL
"""The class of a cell without a point."""


def detector_loss(logits: Tensor, classes: Tensor, valid: Tensor) -> Tensor:
    """Cross-entropy of the 65 classes of a cell, mean over the valid cells: L_p of DeTone et al. (2018), eq. 2.

    Args:
        logits: (B, 65, h, w).
        classes: (B, h, w) int64, place of the point in its cell (row · 8 + column), or 64 for none.
        valid: (B, h, w) bool, cells where it is known whether there is one.
    """
    each = F.cross_entropy(logits.float(), classes, reduction="none")
    return (each * valid).sum() / valid.sum().clamp(min=1)


def descriptor_loss(
    options: DescriptorLoss,
    first: Tensor,
    second: Tensor,
    H: Tensor,
    *,
    points: tuple[Tensor, Tensor],
    matched: Tensor,
    valid: tuple[Tensor, Tensor],
    seed: int,
) -> Tensor:
    """The loss that ``options`` asks for, before its weight λ; in single precision, whatever the net computes in.

    Args:
        options: which, and its numbers.
        first: (B, D, h, w) raw descriptors of the first images.
        second: of the second ones.
        H: (B, 3, 3) from pixels of the first to pixels of the second.
        points: (B, N, 2) px in either image, which correspond; for the sparse losses.
        matched: (B, N) bool, which of them are there.
        valid: (B, h, w) bool, cells of the first that the second shows, and the reverse; for the dense loss.
        seed: of what a loss draws.
    """
    # With 8 bits of mantissa a coordinate of some hundred px would be a pixel or two off.
    with torch.autocast(first.device.type, enabled=False):
        first, second = first.float(), second.float()
        if isinstance(options, DenseLoss):
            return dense_loss(options, first, second, H, valid)
        descriptors = (sample_descriptors(first, points[0]), sample_descriptors(second, points[1]))
        if isinstance(options, SparseHingeLoss):
            return sparse_hinge_loss(options, *descriptors, points[1], matched, seed)
        if isinstance(options, SparseTripletLoss):
            return sparse_triplet_loss(options, *descriptors, points, matched)
    raise TypeError(f"{type(options).__name__} is no loss of descriptors")


def dense_loss(options: DenseLoss, first: Tensor, second: Tensor, H: Tensor, valid: tuple[Tensor, Tensor]) -> Tensor:
    """Hinge over all pairs of cells, DeTone et al. (2018), eq. 4 to 6, of unit descriptors d, d'.

    ``l = λ_d s max(0, m_p − d·d') + (1 − s) max(0, d·d' − m_n)``, with s = 1 where the centre of the first cell,
    warped, lies within ``radius_px`` of the second's; mean over all pairs of valid cells. Arguments as of
    :func:`descriptor_loss`.
    """
    batch, _, rows, columns = first.shape
    centres = cell_centres(rows, columns, first.device)
    warped = warp(centres.expand(batch, -1, -1), H)
    belongs = torch.cdist(warped, centres.expand(batch, -1, -1)) <= options.radius_px
    similarity = torch.bmm(_unit(first).transpose(1, 2), _unit(second))
    pull = options.positive_weight * F.relu(options.positive_margin - similarity)
    push = F.relu(similarity - options.negative_margin)
    counted = valid[0].flatten(1)[:, :, None] & valid[1].flatten(1)[:, None, :]
    each = torch.where(belongs, pull, push) * counted
    return each.sum() / counted.sum().clamp(min=1)


def sparse_hinge_loss(
    options: SparseHingeLoss, first: Tensor, second: Tensor, second_px: Tensor, matched: Tensor, seed: int
) -> Tensor:
    """The hinge of :func:`dense_loss` on sampled pairs (Jau et al. 2020): each match, and random non-matches of it.

    Mean of ``max(0, m_p − d·d')`` over matches, plus the sum of ``max(0, d·d'' − m_n)`` over the non-matches divided by
    one more than how many of them are above zero.

    Args:
        options: its numbers.
        first: (B, N, D) unit descriptors.
        second: those that correspond.
        second_px: (B, N, 2) px, where the latter lie.
        matched: (B, N) bool, which rows count.
        seed: of the non-matches.
    """
    batch, count, _ = first.shape
    similarity = torch.bmm(first, second.transpose(1, 2)).float()
    positive = F.relu(options.positive_margin - torch.diagonal(similarity, dim1=1, dim2=2))
    pull = (positive * matched).sum() / matched.sum().clamp(min=1)
    # Drawn on the CPU, so that a GPU draws the same.
    generator = torch.Generator().manual_seed(seed)
    shape = (batch, count, min(options.negatives, count))
    others = torch.randint(count, shape, generator=generator).to(first.device)
    far = _apart(second_px, options.radius_px) & matched[:, :, None] & matched[:, None, :]
    negative = F.relu(similarity.gather(2, others) - options.negative_margin) * far.gather(2, others)
    push = negative.sum() / ((negative > 0).sum() + 1)
    return options.positive_weight * pull + push


def sparse_triplet_loss(
    options: SparseTripletLoss, first: Tensor, second: Tensor, points: tuple[Tensor, Tensor], matched: Tensor
) -> Tensor:
    """Triplets of a match and its nearest non-matches, as CNN-VINS (Yu et al. 2021) has it.

    ``mean max(0, m_d + L_dp − L_dn)`` with ``L_dp = ‖d − d'‖²`` and L_dn the mean of ``‖d − d''‖²`` over the M
    nearest d'' of the other image that lie further than ``radius_px`` from the match. With ``both_ways`` also from the
    second image to the first.

    Args:
        options: its numbers.
        first: (B, N, D) unit descriptors.
        second: those that correspond.
        points: (B, N, 2) px, where either lie.
        matched: (B, N) bool, which rows count.
    """
    # Of unit vectors ‖a − b‖² = 2 − 2 a·b.
    distance = 2.0 - 2.0 * torch.bmm(first, second.transpose(1, 2)).float()
    positive = torch.diagonal(distance, dim1=1, dim2=2)
    losses = [_triplets(options, distance, positive, points[1], matched)]
    if options.both_ways:
        losses.append(_triplets(options, distance.transpose(1, 2), positive, points[0], matched))
    return torch.stack(losses).mean()


def _triplets(
    options: SparseTripletLoss, distance: Tensor, positive: Tensor, other_px: Tensor, matched: Tensor
) -> Tensor:
    """Mean loss of the anchors in the rows of ``distance`` (B, N, N), whose candidates lie at ``other_px``."""
    usable = _apart(other_px, options.radius_px) & matched[:, None, :]
    # Farther than any, so that what must not be taken comes last.
    count = min(options.negatives, distance.shape[2])
    nearest, places = distance.masked_fill(~usable, 5.0).topk(count, dim=2, largest=False)
    there = usable.gather(2, places)
    negative = (nearest * there).sum(2) / there.sum(2).clamp(min=1)
    counted = matched & there.any(2)
    each = F.relu(options.margin + positive - negative) * counted
    return each.sum() / counted.sum().clamp(min=1)


def cell_centres(rows: int, columns: int, device: torch.device | None = None) -> Tensor:
    """Centres (rows · columns, 2) px of the cells, row by row."""
    y = torch.arange(rows, device=device, dtype=torch.float32) * CELL + (CELL - 1) / 2
    x = torch.arange(columns, device=device, dtype=torch.float32) * CELL + (CELL - 1) / 2
    return torch.stack((x.expand(rows, columns), y[:, None].expand(rows, columns)), dim=-1).reshape(-1, 2)


def warp(points: Tensor, H: Tensor) -> Tensor:
    """Points (B, N, 2) px mapped by (B, 3, 3); far away where they have no place."""
    mapped = torch.baddbmm(H[:, None, :, 2], points, H[:, :, :2].transpose(1, 2))
    depth = mapped[..., 2:]
    return torch.where(depth > 1e-6, mapped[..., :2] / depth.clamp(min=1e-6), torch.full_like(points, -1e6))


def _unit(maps: Tensor) -> Tensor:
    """Unit descriptors (B, D, h·w) in single precision."""
    return F.normalize(maps.float().flatten(2), dim=1)


def _apart(points: Tensor, radius_px: float) -> Tensor:
    """Which points (B, N, 2) lie further apart than the radius, (B, N, N) bool."""
    return torch.cdist(points.float(), points.float()) > radius_px
