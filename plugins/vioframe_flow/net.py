"""TVNet: TV-L1 optical flow with its iterations unrolled into layers (Fan et al. 2018), in tensors only.

The energy is Σ λ |I₂(x + u) − I₁(x)| + |∇u₁| + |∇u₂| (Zach, Pock & Bischof 2007). With I₂ linearised at the flow of
the last warp, u⁰, and g = ∇I₂(x + u⁰), ρ(u) = I₂(x + u⁰) + g·(u − u⁰) − I₁, one iteration is

    v = u + g · clamp(−ρ(u)/|g|², −λθ, λθ)              the thresholding step in one line
    u = v + θ div p
    p = (p + (τ/θ) ∇u) / (1 + (τ/θ) |∇u|)               for each component of u

The difference kernels of ∇u and of div p are parameters, one pair for each warp, iteration, component and axis; they
begin as forward and backward differences, with which the network is classical TV-L1.
"""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

# Keeps square roots differentiable and quotients finite where an image is flat; grey levels are 0 … 255.
_TINY = 1e-12
# ITU-R BT.601, as OpenCV turns RGB into grey.
_LUMA = (0.299, 0.587, 0.114)
_SMOOTHING_REACH = 2


class TvNet(nn.Module):
    """TV-L1 flow of image pairs of any size.

    Args:
        dual_step: τ.
        data_weight: λ, for images that span 0 … 255.
        coupling: θ.
        warps: linearisations a scale.
        iterations: steps a warp.
        zoom: size of a scale by the one below it, between 0 and 1.
        max_scales: of the pyramid; small images have fewer.
        smoothing_px: standard deviation of the 5 × 5 Gaussian that images pass first; 0 leaves it out.
        trust_outside: let a pixel that is sought beyond the border pull at the flow by what the border shows.
        learn_constants: make τ, λ and θ parameters, too.
        start_grid: (rows, columns) of a learned flow to start from, as shares of the image's width and height; it
            is stretched over any image. None starts from zero.
    """

    def __init__(
        self,
        *,
        dual_step: float = 0.25,
        data_weight: float = 0.15,
        coupling: float = 0.3,
        warps: int = 5,
        iterations: int = 5,
        zoom: float = 0.5,
        max_scales: int = 5,
        smoothing_px: float = 0.85,
        trust_outside: bool = False,
        learn_constants: bool = False,
        start_grid: tuple[int, int] | None = None,
    ) -> None:
        super().__init__()
        self.warps = warps
        self.iterations = iterations
        self.zoom = zoom
        self.max_scales = max_scales
        self.trust_outside = trust_outside
        # By warp, iteration, component of the flow, axis (x, y) and tap.
        difference = torch.tensor([-1.0, 1.0]).repeat(warps, iterations, 2, 2, 1)
        self.gradient_kernels = nn.Parameter(difference)
        self.divergence_kernels = nn.Parameter(difference.clone())
        # As logarithms they stay positive whatever an optimiser does.
        constants = torch.tensor([dual_step, data_weight, coupling]).log()
        self.log_constants = nn.Parameter(constants, requires_grad=learn_constants)
        self.start = nn.Parameter(torch.zeros(1, 2, *start_grid)) if start_grid is not None else None
        offsets = torch.arange(-_SMOOTHING_REACH, _SMOOTHING_REACH + 1.0)
        bell = torch.exp(-0.5 * (offsets / smoothing_px) ** 2) if smoothing_px > 0.0 else (offsets == 0.0).float()
        self.register_buffer("bell", bell / bell.sum(), persistent=False)

    def scales(self, height: int, width: int) -> int:
        """Number of scales for an image: the coarsest is about four pixels across, if as many are allowed."""
        diagonal = math.hypot(height, width)
        room = 1 + math.floor(math.log(max(diagonal / 4.0, 1.0)) / math.log(1.0 / self.zoom))
        return max(1, min(self.max_scales, room))

    def prepare(self, first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
        """Grey, jointly stretched to 0 … 255, smoothed: (B, 1, H, W) each.

        Args:
            first, second: (B, 1, H, W) grey or (B, 3, H, W) RGB, of any range.
        """
        pair = torch.cat([_grey(first), _grey(second)], dim=1)
        low = pair.amin(dim=(1, 2, 3), keepdim=True)
        span = pair.amax(dim=(1, 2, 3), keepdim=True) - low
        pair = 255.0 * (pair - low) / span.clamp(min=_TINY)
        bell: Tensor = self.get_buffer("bell").to(pair)
        size = 2 * _SMOOTHING_REACH + 1
        padded = functional.pad(pair, (_SMOOTHING_REACH,) * 4, mode="replicate")
        across = functional.conv2d(padded, bell.view(1, 1, 1, size).expand(2, 1, 1, size), groups=2)
        smooth = functional.conv2d(across, bell.view(1, 1, size, 1).expand(2, 1, size, 1), groups=2)
        return smooth[:, :1], smooth[:, 1:]

    def forward(self, first: Tensor, second: Tensor) -> Tensor:
        """Flow (B, 2, H, W) px, x then y: what is at x in ``first`` is at x + flow in ``second``.

        Args:
            first, second: (B, 1, H, W) grey or (B, 3, H, W) RGB, of any range.
        """
        return self.solve(*self.prepare(first, second))

    def solve(self, first: Tensor, second: Tensor) -> Tensor:
        """Flow (B, 2, H, W) px of prepared images (B, 1, H, W)."""
        pyramid = [(first, second)]
        height, width = first.shape[-2:]
        for level in range(1, self.scales(height, width)):
            factor = self.zoom**level
            size = max(1, round(height * factor)), max(1, round(width * factor))
            pyramid.append((_resize(pyramid[-1][0], size), _resize(pyramid[-1][1], size)))
        flow = self._begin(pyramid[-1][0])
        for coarse, fine in pyramid[::-1]:
            flow = _stretch(flow, coarse.shape[-2], coarse.shape[-1])
            flow = self._refine(coarse, fine, flow)
        return flow

    def _begin(self, coarsest: Tensor) -> Tensor:
        batch, _, height, width = coarsest.shape
        if self.start is None:
            return coarsest.new_zeros(batch, 2, height, width)
        size = self.start.new_tensor([width, height]).view(1, 2, 1, 1)
        start = functional.interpolate(self.start, (height, width), mode="bilinear", align_corners=False)
        return (start * size).expand(batch, -1, -1, -1)

    def _refine(self, first: Tensor, second: Tensor, flow: Tensor) -> Tensor:
        """Flow (B, 2, h, w) of one scale."""
        dual_step, data_weight, coupling = self.log_constants.exp()
        reach, ratio = data_weight * coupling, dual_step / coupling
        channels = torch.cat([second, _centred(second)], dim=1)
        dual_x, dual_y = torch.zeros_like(flow), torch.zeros_like(flow)
        for warp in range(self.warps):
            seen, inside = _warp(channels, flow)
            slope_x, slope_y = seen[:, 1:2], seen[:, 2:]
            if not self.trust_outside:
                slope_x, slope_y = slope_x * inside, slope_y * inside
            slope = torch.cat([slope_x, slope_y], dim=1)
            per_steepness = -1.0 / (slope_x * slope_x + slope_y * slope_y + _TINY)
            rest = seen[:, :1] - first - slope_x * flow[:, :1] - slope_y * flow[:, 1:]
            for step in range(self.iterations):
                misfit = torch.addcmul(torch.addcmul(rest, slope_x, flow[:, :1]), slope_y, flow[:, 1:])
                pull = torch.minimum(torch.maximum(misfit * per_steepness, -reach), reach)
                pulled = torch.addcmul(flow, slope, pull)
                flow = pulled + coupling * _divergence(dual_x, dual_y, self.divergence_kernels[warp, step])
                change_x, change_y = _gradient(flow, self.gradient_kernels[warp, step])
                shrink = 1.0 / (1.0 + ratio * _length(change_x, change_y))
                dual_x, dual_y = (dual_x + ratio * change_x) * shrink, (dual_y + ratio * change_y) * shrink
        return flow


def photometric_loss(first: Tensor, second: Tensor, flow: Tensor, data_weight: float | Tensor = 0.15) -> Tensor:
    """The energy of TV-L1, which needs no truth: λ mean|I₂(x + u) − I₁| + mean(|∇u₁| + |∇u₂|).

    Args:
        first, second: prepared images (B, 1, H, W), 0 … 255.
        flow: (B, 2, H, W) px.
        data_weight: λ.
    """
    seen, _ = _warp(second, flow)
    kernels = torch.tensor([-1.0, 1.0]).to(flow).expand(2, 2, 2)
    roughness = _length(*_gradient(flow, kernels)).sum(dim=1).mean()
    energy: Tensor = data_weight * (seen - first).abs().mean() + roughness
    return energy


def split_pairs(images: Tensor, size_px: tuple[int, int] | None) -> tuple[Tensor, Tensor]:
    """First and second images (B·S, 1, H, W) of all pairs of consecutive images, grey, in single precision.

    Args:
        images: (B, S + 1, C, H, W).
        size_px: (width, height) to which they are brought; None, or the size they have, leaves them as they are.
    """
    batch, count = images.shape[:2]
    images = images.float()
    if size_px is not None and images.shape[-2:] != size_px[::-1]:
        images = _resize(images.flatten(0, 1), size_px[::-1])
        images = images.reshape(batch, count, *images.shape[1:])
    if images.shape[2] == len(_LUMA):
        # In whole levels, as streaming has grey images; gradients pass unchanged.
        grey = _grey(images.flatten(0, 1))
        grey = grey + ((255.0 * grey).round() / 255.0 - grey).detach()
        images = grey.reshape(batch, count, *grey.shape[1:])
    return images[:, :-1].flatten(0, 1), images[:, 1:].flatten(0, 1)


def _grey(image: Tensor) -> Tensor:
    if image.shape[1] == 1:
        return image
    weights = image.new_tensor(_LUMA).view(1, 3, 1, 1)
    return (image * weights).sum(dim=1, keepdim=True)


def _resize(image: Tensor, size: tuple[int, int]) -> Tensor:
    return functional.interpolate(image, size, mode="bilinear", align_corners=False, antialias=True)


def _stretch(flow: Tensor, height: int, width: int) -> Tensor:
    """The same motion on the grid of another scale."""
    if flow.shape[-2:] == (height, width):
        return flow
    ratio = flow.new_tensor([width / flow.shape[-1], height / flow.shape[-2]]).view(1, 2, 1, 1)
    return functional.interpolate(flow, (height, width), mode="bilinear", align_corners=False) * ratio


def _centred(image: Tensor) -> Tensor:
    """Slopes (B, 2, H, W) along x and y, from both neighbours, or from one at the border."""
    slopes = []
    for axis in (3, 2):
        if image.shape[axis] == 1:
            slopes.append(torch.zeros_like(image))
            continue
        (slope,) = torch.gradient(image, dim=axis)
        slopes.append(slope)
    return torch.cat(slopes, dim=1)


def _warp(channels: Tensor, flow: Tensor) -> tuple[Tensor, Tensor]:
    """What is at x + flow: (B, C, H, W), bilinear; and 1 where that lies in the image (B, 1, H, W), else 0."""
    height, width = flow.shape[-2:]
    x = torch.arange(width, dtype=flow.dtype, device=flow.device) + flow[:, 0]
    y = torch.arange(height, dtype=flow.dtype, device=flow.device)[:, None] + flow[:, 1]
    inside = (x >= 0.0) & (x <= width - 1) & (y >= 0.0) & (y <= height - 1)
    places = torch.stack([2.0 * x / max(width - 1, 1) - 1.0, 2.0 * y / max(height - 1, 1) - 1.0], dim=-1)
    seen = functional.grid_sample(channels, places, mode="bilinear", padding_mode="border", align_corners=True)
    return seen, inside[:, None].to(flow.dtype)


def _gradient(flow: Tensor, kernels: Tensor) -> tuple[Tensor, Tensor]:
    """Differences (B, 2, H, W) along x and along y; zero beyond the last pixel.

    Args:
        flow: (B, 2, H, W).
        kernels: (2, 2, 2) by component, axis and tap.
    """
    taps = kernels[..., None, None]
    along_x = taps[:, 0, 0] * flow[..., :-1] + taps[:, 0, 1] * flow[..., 1:]
    along_y = taps[:, 1, 0] * flow[..., :-1, :] + taps[:, 1, 1] * flow[..., 1:, :]
    return functional.pad(along_x, (0, 1)), functional.pad(along_y, (0, 0, 0, 1))


def _length(change_x: Tensor, change_y: Tensor) -> Tensor:
    return (change_x * change_x + change_y * change_y + _TINY).sqrt()


def _divergence(dual_x: Tensor, dual_y: Tensor, kernels: Tensor) -> Tensor:
    """Divergence (B, 2, H, W), by backward differences; what lies before the first pixel counts as zero.

    Args:
        dual_x, dual_y: (B, 2, H, W).
        kernels: (2, 2, 2) by component, axis and tap.
    """
    taps = kernels[..., None, None]
    before_x = functional.pad(taps[:, 0, 0] * dual_x[..., :-1], (1, 0))
    before_y = functional.pad(taps[:, 1, 0] * dual_y[..., :-1, :], (0, 0, 1, 0))
    return before_x + taps[:, 0, 1] * dual_x + before_y + taps[:, 1, 1] * dual_y
