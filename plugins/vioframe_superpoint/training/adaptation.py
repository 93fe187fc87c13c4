"""Homographic adaptation: answers averaged over many views of a picture (DeTone et al. 2018, section 5)."""

import cv2
import numpy as np
import torch

from vioframe.checks import Array, Mask
from vioframe.pictures import sample_homography, valid_mask, warp_picture
from vioframe.types import Image
from vioframe_superpoint.net.keypoints import heatmap, suppress
from vioframe_superpoint.net.superpoint import SuperPointNet
from vioframe_superpoint.training.options import AdaptationOptions
from vioframe_superpoint.training.precision import autocast
from vioframe_superpoint.training.steps import as_float

# px, half the side of the square over which a maximum of the mean heat is placed between pixels.
_REACH = 2


def adapted_heat(
    net: SuperPointNet, picture: Image, rng: np.random.Generator, options: AdaptationOptions, precision: str = "32"
) -> tuple[Array, Mask]:
    """Mean heat (H, W) over the views that show a pixel, and where enough do, (H, W) bool; elsewhere it is zero.

    Args:
        net: on its device, in evaluation mode.
        picture: (H, W) uint8, multiples of 8.
        rng: generator of the homographies; the first is the identity.
        options: of the adaptation.
        precision: ``32`` or ``bf16``.
    """
    height, width = picture.shape
    size = (width, height)
    homographies: list[Array] = [np.eye(3)]
    homographies += [sample_homography(size, rng, options.ranges) for _ in range(options.homographies - 1)]
    total = np.zeros((height, width))
    views = np.zeros((height, width))
    for start in range(0, len(homographies), options.batch_size):
        batch = homographies[start : start + options.batch_size]
        heat = heat_of(net, np.stack([warp_picture(picture, H) for H in batch]), precision)
        for H, answer in zip(batch, heat, strict=True):
            shown = valid_mask(H, size, options.border_px).astype(np.float32)
            # Back into the picture: warping by the inverse of H.
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            total += cv2.warpPerspective(answer * shown, H, size, flags=flags)
            views += cv2.warpPerspective(shown, H, size, flags=flags)
    enough: Mask = views >= options.least_views * len(homographies)
    mean: Array = np.where(enough, total / np.maximum(views, 1e-6), 0.0)
    return mean, enough


def points_of(heat: Array, options: AdaptationOptions) -> Array:
    """Points (P, 2) px of a mean heat (H, W), the hottest first: maxima above the threshold, placed between pixels."""
    kept = suppress(torch.from_numpy(heat.astype(np.float32))[None], options.nms_radius_px)[0].numpy()
    y, x = np.nonzero(kept > options.threshold)
    order = np.argsort(-kept[y, x], kind="stable")[: options.max_points]
    return refined(heat, np.stack((x[order], y[order]), axis=1))


def refined(heat: Array, pixels: Array) -> Array:
    """Centre of heat (P, 2) px in the square of 5×5 px around each of ``pixels`` (P, 2)."""
    steps = np.arange(-_REACH, _REACH + 1)
    padded = np.pad(heat, _REACH)
    patches = padded[
        pixels[:, 1, None, None] + _REACH + steps[:, None], pixels[:, 0, None, None] + _REACH + steps[None, :]
    ]
    weight = np.maximum(patches.sum(axis=(1, 2)), 1e-12)
    shift = np.stack(
        ((patches * steps[None, None, :]).sum((1, 2)), (patches * steps[None, :, None]).sum((1, 2))), axis=1
    )
    placed: Array = pixels + shift / weight[:, None]
    return placed


@torch.inference_mode()
def heat_of(net: SuperPointNet, pictures: Image, precision: str = "32") -> Array:
    """Heat (N, H, W) of grey pictures (N, H, W) uint8."""
    device = next(net.parameters()).device
    with autocast(device, precision):
        logits = net.detector(net.encoder(as_float(torch.from_numpy(pictures).to(device))))
    answers: Array = heatmap(logits.float()).cpu().numpy()
    return answers
