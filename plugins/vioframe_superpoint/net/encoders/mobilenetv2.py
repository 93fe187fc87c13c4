"""The beginning of MobileNetV2 (Sandler et al., CVPR 2018), as CNN-VINS cuts it (Yu et al., table 1)."""

from torch import Tensor, nn

from vioframe_superpoint.net.encoders.base import EncoderNet
from vioframe_superpoint.net.layers import convolution, divisible

STEM = 32
BOTTLENECKS = ((1, 16, 1), (6, 24, 2), (6, 24, 1), (6, 32, 2), (6, 32, 1), (6, 32, 1))
"""Expansion, channels, stride. CNN-VINS prints expansions and strides; the channels with them are MobileNetV2's."""


class InvertedResidual(nn.Module):
    """Widen, filter each channel for itself, narrow without activation; added to the input where it fits.

    Args:
        inputs: channels.
        outputs: channels.
        expansion: of the channels between.
        stride: of the filters.
    """

    def __init__(self, inputs: int, outputs: int, expansion: int, stride: int) -> None:
        super().__init__()
        inner = expansion * inputs
        widen = [convolution(inputs, inner, 1, active=nn.ReLU6(inplace=True))] if expansion > 1 else []
        self.layers = nn.Sequential(
            *widen,
            convolution(inner, inner, stride=stride, groups=inner, active=nn.ReLU6(inplace=True)),
            convolution(inner, outputs, 1),
        )
        self.adds = stride == 1 and inputs == outputs

    def forward(self, features: Tensor) -> Tensor:
        """(B, inputs, h, w) to (B, outputs, h / stride, w / stride)."""
        made: Tensor = self.layers(features)
        return features + made if self.adds else made


class MobileNetV2(EncoderNet):
    """A convolution of stride 2 and six inverted residuals.

    Args:
        width: factor on the channels.
    """

    def __init__(self, width: float = 1.0) -> None:
        sizes = [divisible(width * channels, 8) for channels in (STEM, *(row[1] for row in BOTTLENECKS))]
        super().__init__(sizes[-1])
        # Table 1 prints ReLU here; MobileNetV2 itself, whose blocks follow, has ReLU6 throughout.
        layers: list[nn.Module] = [convolution(1, sizes[0], stride=2, active=nn.ReLU(inplace=True))]
        for (expansion, _, stride), inputs, outputs in zip(BOTTLENECKS, sizes, sizes[1:], strict=False):
            layers.append(InvertedResidual(inputs, outputs, expansion, stride))
        self.layers = nn.Sequential(*layers)

    def forward(self, images: Tensor) -> Tensor:
        """See :class:`EncoderNet`."""
        features: Tensor = self.layers(images)
        return features
