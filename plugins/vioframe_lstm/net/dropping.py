"""Windows that lose a sensor for a while, so that a net meets in training what happens in use."""

import torch

from vioframe_lstm.net.pairs import Pairs


def lose_stretches(pairs: Pairs, share: float, longest: int) -> Pairs:
    """Take a stretch of the VO's answers from ``share`` of the windows, and of the inertial samples from as many.

    Args:
        pairs: (B, S).
        share: probability of either.
        longest: pairs; lengths are drawn evenly from 1.
    """
    count, length = pairs.visual.shape
    device = pairs.visual.device
    place = torch.arange(length, device=device)

    def drawn() -> torch.Tensor:
        lost = torch.rand(count, 1, device=device) < share
        first = torch.randint(-longest + 1, length, (count, 1), device=device)
        size = torch.randint(1, longest + 1, (count, 1), device=device)
        return lost & (place >= first) & (place < first + size)

    return pairs.without(drawn(), drawn())
