"""What an encoder is."""

from torch import nn


class EncoderNet(nn.Module):
    """Images (B, 1, H, W) in [0, 1] to a map (B, channels, H/8, W/8); H and W are multiples of 8.

    Args:
        channels: of the map.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.channels = channels
