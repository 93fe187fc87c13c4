"""FlowNetS convolutions on an image pair: the spatial stream of TSVO, and the features of DeepVO.

Layer table: Dosovitskiy et al., "FlowNet: Learning Optical Flow with Convolutional Networks", ICCV 2015. DeepVO
(Wang et al., ICRA 2017) ends at Conv6; TSVO (Zhao et al. 2022, table 1) adds Conv6-1 and a pool of 2.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from vioframe.errors import ShapeError

PAIR_CHANNELS = 6
"""Two RGB images, the earlier first."""


@dataclass(frozen=True, slots=True)
class Layer:
    """One convolution: padding is half the kernel, so that only the stride changes the size."""

    name: str
    kernel: int
    stride: int
    channels: int


LAYERS = (
    Layer("conv1", 7, 2, 64),
    Layer("conv2", 5, 2, 128),
    Layer("conv3", 5, 2, 256),
    Layer("conv3_1", 3, 1, 256),
    Layer("conv4", 3, 2, 512),
    Layer("conv4_1", 3, 1, 512),
    Layer("conv5", 3, 2, 512),
    Layer("conv5_1", 3, 1, 512),
    Layer("conv6", 3, 2, 1024),
    Layer("conv6_1", 3, 1, 1024),
)
"""All ten; DeepVO takes the first nine."""


class FlowNetConvolutions(nn.Module):
    """The table above in a row, each convolution followed by a rectifier."""

    def __init__(
        self,
        *,
        layers: Sequence[Layer] = LAYERS,
        channels: int = PAIR_CHANNELS,
        width: float = 1.0,
        slope: float = 0.0,
        batch_norm: bool = False,
        dropout: float = 0.0,
        last_dropout: float = 0.0,
    ) -> None:
        """Build the layers.

        Args:
            layers: rows of the table.
            channels: of what is given, two images and what else is known of them.
            width: factor on all channel counts, kept multiples of 8; 1 is the table.
            slope: of the rectifier below zero: 0 as the paper (ReLU), 0.1 as FlowNet.
            batch_norm: normalise after each convolution (whose bias is then dropped); neither paper does, but
                without FlowNet's weights to start from, it is what makes the deep layers train.
            dropout: after every layer but the last.
            last_dropout: after the last.
        """
        super().__init__()
        self.strides = tuple(layer.stride for layer in layers)
        for position, layer in enumerate(layers):
            out = channels_at(layer.channels, width)
            convolution = nn.Conv2d(channels, out, layer.kernel, layer.stride, layer.kernel // 2, bias=not batch_norm)
            nn.init.kaiming_normal_(convolution.weight, a=slope, nonlinearity="leaky_relu")
            if convolution.bias is not None:
                nn.init.zeros_(convolution.bias)
            parts: list[nn.Module] = [convolution]
            if batch_norm:
                parts.append(nn.BatchNorm2d(out))
            parts.append(nn.LeakyReLU(slope, inplace=True) if slope else nn.ReLU(inplace=True))
            probability = last_dropout if position == len(layers) - 1 else dropout
            if probability:
                parts.append(nn.Dropout(probability))
            self.add_module(layer.name, nn.Sequential(*parts))
            channels = out
        self.out_channels = channels

    def out_size(self, size_px: tuple[int, int]) -> tuple[int, int]:
        """(width, height) of the last map for images of ``size_px``: each stride divides, rounding up."""
        width, height = size_px
        for stride in self.strides:
            width, height = -(-width // stride), -(-height // stride)
        return width, height

    def forward(self, pair: Tensor) -> Tensor:
        """Maps (N, C, H/64, W/64) of pairs (N, 6, H, W)."""
        for layer in self.children():
            pair = layer(pair)
        return pair


class SpatialStream(nn.Module):
    """Ten convolutions and a pool; 24 050 752 parameters and 8 × 4 → 4 × 2 maps at 512 × 256."""

    def __init__(
        self,
        size_px: tuple[int, int],
        *,
        channels: int = PAIR_CHANNELS,
        width: float = 1.0,
        batch_norm: bool = False,
    ) -> None:
        """Build the stream for images of ``size_px`` (width, height); other arguments as the convolutions'."""
        super().__init__()
        self.convolutions = FlowNetConvolutions(channels=channels, width=width, batch_norm=batch_norm)
        # Rounding up changes nothing at 512×256 and keeps the rim of maps of odd size, so that images below 128
        # pixels, whose last map is one pixel high, are possible.
        self.pool = nn.MaxPool2d(2, 2, ceil_mode=True)
        columns, rows = self.convolutions.out_size(size_px)
        self.features = self.convolutions.out_channels * -(-columns // 2) * -(-rows // 2)

    def forward(self, pair: Tensor) -> Tensor:
        """Features (N, F) of pairs (N, 6, H, W)."""
        return torch.flatten(self.pool(self.convolutions(pair)), 1)


def channels_at(channels: int, width: float) -> int:
    """``channels`` times ``width``, to a multiple of 8 and at least 8."""
    return max(8, 8 * round(channels * width / 8))


def pairs_of(images: Tensor) -> Tensor:
    """Neighbouring images (B, S, 6, H, W) of images in a row (B, S + 1, 3, H, W), or of one channel, repeated."""
    if images.shape[2] == 1:
        images = images.expand(-1, -1, 3, -1, -1)
    return torch.cat([images[:, :-1], images[:, 1:]], dim=2)


def centred(pair: Tensor) -> Tensor:
    """Images of [0, 1] in [-1, 1]: without a mean that the first layer would have to learn away."""
    return 2.0 * pair - 1.0


def check_maps(what: str, maps: Tensor, channels: int, size_px: tuple[int, int]) -> None:
    """Refuse maps (N, C, H, W) of another size than a net was built for.

    Raises:
        ShapeError: with what was expected and what came.
    """
    if maps.ndim != 4 or maps.shape[1] != channels or tuple(maps.shape[2:]) != size_px[::-1]:
        raise ShapeError(
            f"the net takes {what} of {channels} channels and {size_px[0]}×{size_px[1]} px, "
            f"got an array of shape {tuple(maps.shape)} (number, channels, height, width)"
        )
