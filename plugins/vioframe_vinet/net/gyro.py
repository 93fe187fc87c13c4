"""Rotation from the gyro, corrected by what the images say of its bias.

The rotation that an embedding shows is far coarser than a gyro's over one pair, but most of what it is off by changes
from pair to pair: its differences from the gyro are filtered, axis by axis, into what they have in common. That is the
gyro's bias and what images are always off by themselves, and nothing in a recording tells one from the other: it is
shared out by how large each is known to be, and the doubt that remains never goes away. What changes from pair to pair
is not white either: pairs in a row count for less than as many pairs apart.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from vioframe.learning.motion import exp_so3, log_so3, product

USUAL_S = 0.1
"""What times between images are measured against, s."""
# What an output of 1 means, rad: the rotation of a car between two images.
_SIGHT_UNIT = 0.02
_HIDDEN = 64
# In squared units of the output, logarithms.
_LARGEST_LOG_VARIANCE = 12.0
# ln of a variance that an output of 1 is worth.
_DOUBT_GAIN = 4.0
# rad/s that rotations shown by images are always off by, before anything is learned of it.
_LASTING_SIGMA = 0.002
# Pairs in a row that are worth one, likewise.
_ALIKE = 20.0
# ln of a variance that one unit of a parameter is worth: an optimiser's steps are of the size of weights.
_LASTING_GAIN = 100.0


class Bias(NamedTuple):
    """What gyro and images differ by: mean (B, 3), rad in :data:`USUAL_S`, and its variance (B, 3)."""

    mean: Tensor
    variance: Tensor


class Sight(NamedTuple):
    """Rotation that images show: vector (B, S, 3) rad, and natural logarithms (B, S, 3) of its variances, rad²."""

    vector: Tensor
    log_variances: Tensor


class Checked(NamedTuple):
    """What is to be added to the gyro's rotations.

    Attributes:
        correction: (B, S, 3) rad, to be multiplied from the right as Exp.
        variance: (B, S, 3) of what the gyro is off by still, (rad/s)²: one error that lasts.
        kept: (B, S, 3) share of it that is left of what it was over the pair before.
    """

    correction: Tensor
    variance: Tensor
    kept: Tensor


class GyroCheck(nn.Module):
    """Two layers that find the rotation in an embedding, and a Kalman filter of what the gyro differs from it by."""

    def __init__(self, *, embedding: int, bias_sigma: float, memory: int) -> None:
        """Build it.

        Args:
            embedding: D.
            bias_sigma: rad/s an axis, of the bias at first.
            memory: pairs after which what was seen counts 1/e.
        """
        super().__init__()
        self.hidden = nn.Sequential(nn.Linear(embedding, _HIDDEN), nn.ReLU(inplace=True))
        self.sight = nn.Linear(_HIDDEN, 3)
        self.doubt = nn.Linear(_HIDDEN, 3)
        self.lasting = nn.Parameter(torch.zeros(3))
        self.alike = nn.Parameter(torch.zeros(3))
        self._bias_variance = (bias_sigma * USUAL_S) ** 2
        self._memory = memory

    @property
    def lasting_variance(self) -> Tensor:
        """(3,) of what the rotations of images are always off by, rad² in :data:`USUAL_S`."""
        # Within a factor of 50 either way of where it starts.
        moved = (_LASTING_GAIN * self.lasting).clamp(-8.0, 8.0)
        return torch.exp(moved + 2.0 * math.log(_LASTING_SIGMA * USUAL_S))

    @property
    def pairs_alike(self) -> Tensor:
        """(3,) pairs in a row whose rotations are off by the same, so that they are worth one."""
        return torch.exp((_LASTING_GAIN * self.alike).clamp(-4.0, 4.0) + math.log(_ALIKE))

    def begin(self, like: Tensor, sequences: int) -> Bias:
        """What is known before anything was seen."""
        zero = torch.zeros(sequences, 3, dtype=torch.float32, device=like.device)
        return Bias(zero, zero + self._bias_variance + self.lasting_variance)

    def see(self, embedding: Tensor) -> Sight:
        """The rotations of (B, S, D)."""
        hidden = self.hidden(embedding)
        numbers = self.sight(hidden).float()
        # What is learned of errors must not bend what is learned of rotations.
        limited = _DOUBT_GAIN * self.doubt(hidden.detach()).float()
        limited = limited.clamp(-_LARGEST_LOG_VARIANCE, _LARGEST_LOG_VARIANCE)
        return Sight(_SIGHT_UNIT * numbers, limited + 2.0 * math.log(_SIGHT_UNIT))

    def forward(
        self, turns: Tensor, sight: Sight, checked: Tensor, duration_s: Tensor, bias: Bias
    ) -> tuple[Checked, Bias]:
        """What is to be added to the gyro's rotations, and what is known now.

        Args:
            turns: (B, S, 3, 3) of the gyro.
            sight: of the same pairs.
            checked: (B, S) bool, whether there are samples and both images.
            duration_s: (B, S).
            bias: known before.
        """
        usual = (duration_s / USUAL_S)[..., None].clamp_min(1e-3)
        lacking = log_so3(product(turns.transpose(-1, -2), exp_so3(sight.vector))) / usual
        # How far sight is to be believed is learned from its errors, not from what it does to the bias.
        noise = self.pairs_alike * sight.log_variances.detach().exp() / usual**2
        lasting = self.lasting_variance
        at_first = self._bias_variance + lasting
        # The gyro's share of what they differ by, and the variance of that share when the difference is known.
        share, apart = self._bias_variance / at_first, self._bias_variance * lasting / at_first
        means, variances, kept = [], [], []
        for k in range(turns.shape[1]):
            fresh = checked[:, k, None]
            # Forgetting: what was known is worth less with each pair, but never less than nothing.
            variance = torch.minimum(bias.variance * (1.0 + 1.0 / self._memory), at_first)
            gain = torch.where(fresh, variance / (variance + noise[:, k]), torch.zeros_like(variance))
            left = apart + share**2 * (1.0 - gain) * bias.variance
            kept.append(left / (apart + share**2 * bias.variance))
            # What errors are like is learned from how likely they are, not from what it does to the motions.
            bias = Bias(bias.mean + gain.detach() * (lacking[:, k] - bias.mean), (1.0 - gain) * variance)
            means.append(share.detach() * bias.mean)
            variances.append(apart + share**2 * bias.variance)
        found = Checked(
            torch.stack(means, dim=1) * usual,
            torch.stack(variances, dim=1) / USUAL_S**2,
            torch.stack(kept, dim=1),
        )
        return found, bias
