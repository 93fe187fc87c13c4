"""Errors that motions in a row share: what is left of the gyro's bias, and of the scale of lengths."""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

# Share that all lengths of a stretch are off by, before anything is learned of it.
_SCALE_SIGMA = 0.05
# ln of a variance that one unit of the parameter is worth: an optimiser's steps are of the size of weights.
_GAIN = 100.0


class Lasting(NamedTuple):
    """Four errors of each motion, independent of each other, that it shares with those before and after it.

    Attributes:
        variance: (B, S, 4) of the rate of rotation, (rad/s)² about each axis of the answer, and of the scale.
        kept: (B, S, 4) share of each that is left of what it was over the pair before.
    """

    variance: Tensor
    kept: Tensor

    def joined(self, variance: Tensor, kept: Tensor) -> "Lasting":
        """With those of rotation (B, S, 3) as given."""
        return Lasting(
            torch.cat([variance, self.variance[..., 3:]], dim=-1), torch.cat([kept, self.kept[..., 3:]], dim=-1)
        )


class LastingScale(nn.Module):
    """How far lengths are off together: one variance, learned, of an error that is forgotten at a given rate."""

    def __init__(self, memory: int) -> None:
        """``memory``: pairs after which 1/e is left of it."""
        super().__init__()
        self.lasting = nn.Parameter(torch.zeros(1))
        self.memory = memory

    @property
    def variance(self) -> Tensor:
        """(1,)."""
        moved = (_GAIN * self.lasting).clamp(-8.0, 8.0)
        return torch.exp(moved + 2.0 * math.log(_SCALE_SIGMA))

    def forward(self, visible: Tensor) -> Lasting:
        """The errors of lengths, and none of rotation, of pairs (B, S) of which there are images, or not.

        What the core guesses without images is off by something else each time.
        """
        variance = torch.cat([self.variance.new_zeros(3), self.variance])
        kept = torch.full_like(variance, math.exp(-1.0 / self.memory))
        return Lasting(visible[..., None] * variance, kept.expand(*visible.shape, 4))
