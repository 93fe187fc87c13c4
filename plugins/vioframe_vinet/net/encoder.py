"""Two images into one vector: the spatial stream of TSVO, which is FlowNetS, and a linear layer."""

import torch
from torch import Tensor, nn

from vioframe.learning.flownet import PAIR_CHANNELS, SpatialStream, centred, check_maps

_FLOW_CHANNELS = 2


class PairEncoderNet(nn.Module):
    """Pairs of images, and the flow between them where it is known, to ``features`` numbers between −1 and 1 each."""

    def __init__(
        self, *, size_px: tuple[int, int], features: int, width: float, batch_norm: bool, with_flow: bool
    ) -> None:
        """Build it for images of ``size_px`` (width, height); ``width`` and ``batch_norm`` as the stream's."""
        super().__init__()
        self.size_px = size_px
        channels = PAIR_CHANNELS + (_FLOW_CHANNELS if with_flow else 0)
        self.stream = SpatialStream(size_px, channels=channels, width=width, batch_norm=batch_norm)
        self.join = nn.Linear(self.stream.features, features)

    def forward(self, pairs: Tensor, flow: Tensor | None = None) -> Tensor:
        """Embeddings (N, D).

        Args:
            pairs: (N, 6, H, W) of images in [0, 1], the earlier first.
            flow: (N, 2, H, W), of the order of 1 where much moves; for a net that was built with it.

        Raises:
            ShapeError: images or flow of another size than the net was built for.
        """
        check_maps("images", pairs, PAIR_CHANNELS, self.size_px)
        seen = centred(pairs)
        if flow is not None:
            check_maps("flow", flow, _FLOW_CHANNELS, self.size_px)
            seen = torch.cat([seen, flow], dim=1)
        # Bounded, so that what takes the place of a missing pair is of the same size as any other.
        return torch.tanh(self.join(self.stream(seen)))
