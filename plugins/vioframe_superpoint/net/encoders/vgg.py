"""The encoder of SuperPoint (DeTone et al., CVPRW 2018, section 3.1), with batch normalisation."""

from torch import Tensor, nn

from vioframe_superpoint.net.encoders.base import EncoderNet
from vioframe_superpoint.net.layers import convolution

CHANNELS = (64, 64, 64, 64, 128, 128, 128, 128)
"""Of the eight 3×3 convolutions; a 2×2 maximum follows the second, fourth and sixth."""


class Vgg(EncoderNet):
    """Pairs of 3×3 convolutions between maxima of 2×2 pixels.

    Args:
        width: factor on the channels.
    """

    def __init__(self, width: float = 1.0) -> None:
        sizes = [max(1, round(width * channels)) for channels in CHANNELS]
        super().__init__(sizes[-1])
        layers: list[nn.Module] = []
        for number, (inputs, outputs) in enumerate(zip([1, *sizes], sizes, strict=False)):
            if number and number % 2 == 0:
                layers.append(nn.MaxPool2d(2))
            layers.append(convolution(inputs, outputs, active=nn.ReLU(inplace=True)))
        self.layers = nn.Sequential(*layers)

    def forward(self, images: Tensor) -> Tensor:
        """See :class:`EncoderNet`."""
        features: Tensor = self.layers(images)
        return features
