"""Two images into one vector: the spatial stream of TSVO, which is FlowNetS, and a linear layer."""

import torch
from torch import Tensor, nn

from vioframe.learning.flownet import PAIR_CHANNELS, SpatialStream, centred, check_maps


class PairEncoderNet(nn.Module):
    """Pairs of images to ``features`` numbers between −1 and 1 each."""

    def __init__(self, *, size_px: tuple[int, int], features: int, width: float, batch_norm: bool) -> None:
        """Build it for images of ``size_px`` (width, height); ``width`` and ``batch_norm`` as the stream's."""
        super().__init__()
        self.size_px = size_px
        self.stream = SpatialStream(size_px, width=width, batch_norm=batch_norm)
        self.join = nn.Linear(self.stream.features, features)

    def forward(self, pairs: Tensor) -> Tensor:
        """Embeddings (N, D) of pairs (N, 6, H, W) of images in [0, 1], the earlier first.

        Raises:
            ShapeError: images of another size than the net was built for.
        """
        check_maps("images", pairs, PAIR_CHANNELS, self.size_px)
        # Bounded, so that what takes the place of a missing pair is of the same size as any other.
        return torch.tanh(self.join(self.stream(centred(pairs))))
