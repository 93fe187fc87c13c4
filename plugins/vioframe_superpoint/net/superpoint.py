"""SuperPoint: an encoder, and two heads on its map (DeTone et al., CVPRW 2018)."""

from collections.abc import Mapping

from torch import Tensor, nn

from vioframe_superpoint.net.encoders.base import EncoderNet
from vioframe_superpoint.net.encoders.ghostnet import GhostNet
from vioframe_superpoint.net.encoders.mobilenetv2 import MobileNetV2
from vioframe_superpoint.net.encoders.vgg import Vgg
from vioframe_superpoint.net.layers import convolution
from vioframe_superpoint.options import Encoder, encoder_named

CELL_PX = 8
"""Side of the square of pixels that one column of the heads' maps speaks of."""
DETECTOR_CHANNELS = CELL_PX * CELL_PX + 1
"""The pixels of a cell, row by row, and last the dustbin: there is no point in this cell."""
DESCRIPTOR_CHANNELS = 256
HEAD_CHANNELS = 256

ENCODERS: Mapping[str, type[Vgg] | type[MobileNetV2] | type[GhostNet]] = {
    "vgg": Vgg,
    "mobilenetv2": MobileNetV2,
    "ghostnet": GhostNet,
}
"""By the name that ``encoder=`` has."""


class Head(nn.Module):
    """A 3×3 convolution to 256 channels, and a linear layer of what it finds in each cell.

    Args:
        inputs: channels.
        outputs: channels.
        centred: normalise what comes out. Vectors of a net that has learned nothing are else all but parallel, and
            losses that push non-matches apart find no direction to do it in.
    """

    def __init__(self, inputs: int, outputs: int, *, centred: bool) -> None:
        super().__init__()
        self.wide = convolution(inputs, HEAD_CHANNELS, active=nn.ReLU(inplace=True))
        self.last = nn.Conv2d(HEAD_CHANNELS, outputs, 1, bias=not centred)
        self.centre: nn.Module = nn.BatchNorm2d(outputs) if centred else nn.Identity()

    def forward(self, features: Tensor) -> Tensor:
        """(B, inputs, h, w) to (B, outputs, h, w)."""
        answer: Tensor = self.centre(self.last(self.wide(features)))
        return answer


class SuperPointNet(nn.Module):
    """Where points are and how they look, for each cell of 8×8 pixels.

    Args:
        encoder: from the image to the map both heads read.
    """

    def __init__(self, encoder: EncoderNet) -> None:
        super().__init__()
        self.encoder = encoder
        self.detector = Head(encoder.channels, DETECTOR_CHANNELS, centred=False)
        self.descriptor = Head(encoder.channels, DESCRIPTOR_CHANNELS, centred=True)

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Run the net.

        Args:
            images: (B, 1, H, W) grey in [0, 1]; H and W are multiples of 8.

        Returns:
            logits (B, 65, H/8, W/8): channel c of cell (i, j) is pixel (8i + c // 8, 8j + c % 8), the last none;
            descriptors (B, 256, H/8, W/8), not normalised, at the centres of the cells.
        """
        features = self.encoder(images)
        return self.detector(features), self.descriptor(features)


def make_net(encoder: Encoder | str) -> SuperPointNet:
    """A net with random weights.

    Args:
        encoder: its options, or its name alone.

    Raises:
        ConfigError: no such encoder.
    """
    options = encoder_named(encoder) if isinstance(encoder, str) else encoder
    return SuperPointNet(ENCODERS[options.name](options.width))
