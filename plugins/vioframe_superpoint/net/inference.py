"""The net for use: the same answers as :class:`SuperPointNet`'s, up to rounding, in less time."""

import copy
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.fusion import fuse_conv_bn_eval

from vioframe_superpoint.net.keypoints import heatmap, surrounding_cells
from vioframe_superpoint.net.superpoint import SuperPointNet


class InferenceNet:
    """A trained net without its batch normalisations, which are folded into the convolutions before them.

    Descriptors are computed in the cells around the points alone: with 300 points of a 480×640 image a fifth of them.

    Args:
        net: on its device; it is copied.
        half: work in half precision.
    """

    def __init__(self, net: SuperPointNet, *, half: bool) -> None:
        fused = fold(net).requires_grad_(False)
        if half:
            fused.half()
        for parameter in fused.parameters():
            if parameter.ndim == 4:
                parameter.data = parameter.data.contiguous(memory_format=torch.channels_last)
        self._encoder = fused.encoder
        self._detector = fused.detector
        first, last = cast(nn.Conv2d, fused.descriptor.wide[0]), fused.descriptor.last
        # As a matrix on the nine cells around a cell, whose channels lie together.
        self._patch = first.weight.permute(0, 2, 3, 1).reshape(len(first.weight), -1).contiguous()
        self._patch_bias = first.bias
        self._last = last.weight[:, :, 0, 0]
        self._last_bias = last.bias
        self._type = self._last.dtype

    def detect(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Heat and what descriptors are made of.

        Args:
            images: (B, 1, H, W) in [0, 1]; H and W are multiples of 8.

        Returns:
            heat (B, H, W) float32, and features (B, C, H/8, W/8).
        """
        features = self._encoder(images.to(self._type, memory_format=torch.channels_last))
        return heatmap(self._detector(features).float()), features

    def describe(self, features: Tensor, pixels: Tensor) -> Tensor:
        """Unit descriptors (N, 256) float32.

        Args:
            features: (C, h, w) of one image.
            pixels: (N, 2) px.
        """
        channels, height, width = features.shape
        around, shares = surrounding_cells(pixels, height, width)
        cells, place = torch.unique(around, return_inverse=True)
        padded = functional.pad(features, (1, 1, 1, 1)).permute(1, 2, 0).reshape(-1, channels)
        corner = cells // width * (width + 2) + cells % width
        steps = torch.arange(3, device=cells.device)
        patches = (corner[:, None, None] + steps[:, None] * (width + 2) + steps).reshape(len(cells), 9)
        hidden = functional.linear(padded[patches].reshape(len(cells), -1), self._patch, self._patch_bias).relu_()
        # The last layer is linear, and so it may as well come after the interpolation.
        mixed = (hidden[place] * shares.to(hidden.dtype)[..., None]).sum(dim=-2)
        return functional.normalize(functional.linear(mixed, self._last, self._last_bias).float(), dim=-1)


def fold(net: SuperPointNet) -> SuperPointNet:
    """A copy for evaluation in which each convolution does what the batch normalisation after it did."""
    folded = copy.deepcopy(net).eval()
    for head in (folded.detector, folded.descriptor):
        if isinstance(head.centre, nn.BatchNorm2d):
            head.last, head.centre = fuse_conv_bn_eval(head.last, head.centre), nn.Identity()
    for block in folded.modules():
        if not isinstance(block, nn.Sequential):
            continue
        for place in range(len(block) - 1):
            first, second = block[place], block[place + 1]
            if isinstance(first, nn.Conv2d) and isinstance(second, nn.BatchNorm2d):
                block[place] = fuse_conv_bn_eval(first, second)
                block[place + 1] = nn.Identity()
    return folded
