"""The beginning of GhostNet (Han et al., CVPR 2020), as CNN-VINS cuts it (Yu et al., table 2)."""

import torch
from torch import Tensor, nn

from vioframe_superpoint.net.encoders.base import EncoderNet
from vioframe_superpoint.net.layers import convolution, divisible

STEM = 16
BOTTLENECKS = (
    (3, 16, 16, 0.0, 1),
    (3, 48, 24, 0.0, 2),
    (3, 72, 24, 0.0, 1),
    (5, 72, 40, 0.25, 2),
    (5, 120, 40, 0.25, 1),
    (3, 240, 80, 0.0, 1),
)
"""Kernel, expanded channels, channels, share of squeeze and excitation (0: none), stride.

CNN-VINS prints expansions, shares and strides; kernels and channels with them are GhostNet's (its table 1). The last
row's stride is 1 here, where GhostNet has 2: the map is an eighth of the image already.
"""


class Ghost(nn.Module):
    """Half of the channels by a 1×1 convolution, the other half by a 3×3 filter on each of those.

    Args:
        inputs: channels.
        outputs: channels, even.
        active: a ReLU after both.
    """

    def __init__(self, inputs: int, outputs: int, *, active: bool) -> None:
        super().__init__()
        half = outputs // 2
        self.primary = convolution(inputs, half, 1, active=nn.ReLU(inplace=True) if active else None)
        self.cheap = convolution(half, half, groups=half, active=nn.ReLU(inplace=True) if active else None)

    def forward(self, features: Tensor) -> Tensor:
        """(B, inputs, h, w) to (B, outputs, h, w)."""
        primary = self.primary(features)
        return torch.cat([primary, self.cheap(primary)], dim=1)


class SqueezeExcite(nn.Module):
    """Weighs each channel by what the means of all channels say (Hu et al., CVPR 2018), with a hard sigmoid.

    Args:
        channels: in and out.
        share: of them in the layer between.
    """

    def __init__(self, channels: int, share: float) -> None:
        super().__init__()
        between = divisible(share * channels, 4)
        self.weigh = nn.Sequential(
            nn.Conv2d(channels, between, 1), nn.ReLU(inplace=True), nn.Conv2d(between, channels, 1), nn.Hardsigmoid()
        )

    def forward(self, features: Tensor) -> Tensor:
        """(B, channels, h, w) to the same."""
        weights: Tensor = self.weigh(features.mean(dim=(2, 3), keepdim=True))
        return features * weights


class GhostBottleneck(nn.Module):
    """Ghost, filter where it strides, squeeze and excitation, ghost without activation; added to a shortcut.

    Args:
        inputs: channels.
        inner: channels between.
        outputs: channels.
        kernel: odd side of the filters.
        share: of squeeze and excitation, 0 for none.
        stride: of the filters.
    """

    def __init__(self, inputs: int, inner: int, outputs: int, kernel: int, share: float, stride: int) -> None:
        super().__init__()
        layers: list[nn.Module] = [Ghost(inputs, inner, active=True)]
        if stride > 1:
            layers.append(convolution(inner, inner, kernel, stride=stride, groups=inner))
        if share > 0.0:
            layers.append(SqueezeExcite(inner, share))
        layers.append(Ghost(inner, outputs, active=False))
        self.layers = nn.Sequential(*layers)
        self.shortcut: nn.Module = nn.Identity()
        if stride > 1 or inputs != outputs:
            self.shortcut = nn.Sequential(
                convolution(inputs, inputs, kernel, stride=stride, groups=inputs), convolution(inputs, outputs, 1)
            )

    def forward(self, features: Tensor) -> Tensor:
        """(B, inputs, h, w) to (B, outputs, h / stride, w / stride)."""
        made: Tensor = self.layers(features)
        shortcut: Tensor = self.shortcut(features)
        return made + shortcut


class GhostNet(EncoderNet):
    """A convolution of stride 2 and six ghost bottlenecks: the first seven layers.

    Args:
        width: factor on the channels; CNN-VINS has 1.2.
    """

    def __init__(self, width: float = 1.2) -> None:
        sizes = [divisible(width * channels, 4) for channels in (STEM, *(row[2] for row in BOTTLENECKS))]
        super().__init__(sizes[-1])
        layers: list[nn.Module] = [convolution(1, sizes[0], stride=2, active=nn.ReLU(inplace=True))]
        for row, inputs, outputs in zip(BOTTLENECKS, sizes, sizes[1:], strict=False):
            kernel, inner, _, share, stride = row
            layers.append(GhostBottleneck(inputs, divisible(width * inner, 4), outputs, kernel, share, stride))
        self.layers = nn.Sequential(*layers)

    def forward(self, images: Tensor) -> Tensor:
        """See :class:`EncoderNet`."""
        features: Tensor = self.layers(images)
        return features
