"""Rotation from the gyro, corrected by what the images say of its bias.

The rotation that an embedding shows is far coarser than a gyro's over one pair, but not wrong by the same amount all
the time: its differences from the gyro are filtered, axis by axis, into the one thing that the gyro does not know.
"""

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


class Bias(NamedTuple):
    """What is known of the gyro: mean (B, 3) of what it lacks, rad in :data:`USUAL_S`, and its variance (B, 3)."""

    mean: Tensor
    variance: Tensor


class Sight(NamedTuple):
    """Rotation that images show: vector (B, S, 3) rad, and natural logarithms (B, S, 3) of its variances, rad²."""

    vector: Tensor
    log_variances: Tensor


class GyroCheck(nn.Module):
    """Two layers that find the rotation in an embedding, and a Kalman filter of the gyro's bias."""

    def __init__(self, *, embedding: int, bias_sigma: float, memory: int) -> None:
        """Build it.

        Args:
            embedding: D.
            bias_sigma: rad/s an axis, of the bias at first.
            memory: pairs after which what was seen counts 1/e.
        """
        super().__init__()
        self.sight = nn.Sequential(nn.Linear(embedding, _HIDDEN), nn.ReLU(inplace=True), nn.Linear(_HIDDEN, 6))
        self._variance = (bias_sigma * USUAL_S) ** 2
        self._memory = memory

    def begin(self, like: Tensor, sequences: int) -> Bias:
        """What is known before anything was seen."""
        zero = torch.zeros(sequences, 3, dtype=torch.float32, device=like.device)
        return Bias(zero, zero + self._variance)

    def see(self, embedding: Tensor) -> Sight:
        """The rotations of (B, S, D)."""
        numbers = self.sight(embedding).float()
        limited = numbers[..., 3:].clamp(-_LARGEST_LOG_VARIANCE, _LARGEST_LOG_VARIANCE)
        unit = torch.full_like(limited, _SIGHT_UNIT)
        return Sight(_SIGHT_UNIT * numbers[..., :3], limited + 2.0 * unit.log())

    def forward(
        self, turns: Tensor, sight: Sight, checked: Tensor, duration_s: Tensor, bias: Bias
    ) -> tuple[Tensor, Tensor, Bias]:
        """What is to be added to the gyro's rotations.

        Args:
            turns: (B, S, 3, 3) of the gyro.
            sight: of the same pairs.
            checked: (B, S) bool, whether there are samples and both images.
            duration_s: (B, S).
            bias: known before.

        Returns:
            (B, S, 3) rad, to be multiplied from the right as Exp; its variance (B, S, 3), rad²; and what is known now.
        """
        usual = (duration_s / USUAL_S)[..., None].clamp_min(1e-3)
        lacking = log_so3(product(turns.transpose(-1, -2), exp_so3(sight.vector))) / usual
        # How far sight is to be believed is learned from its errors, not from what it does to the bias.
        noise = sight.log_variances.detach().exp() / usual**2
        means, variances = [], []
        for k in range(turns.shape[1]):
            fresh = checked[:, k, None]
            # Forgetting: what was known is worth less with each pair, but never less than nothing.
            variance = (bias.variance * (1.0 + 1.0 / self._memory)).clamp_max(self._variance)
            gain = torch.where(fresh, variance / (variance + noise[:, k]), torch.zeros_like(variance))
            bias = Bias(bias.mean + gain * (lacking[:, k] - bias.mean), (1.0 - gain) * variance)
            means.append(bias.mean)
            variances.append(bias.variance)
        return torch.stack(means, dim=1) * usual, torch.stack(variances, dim=1) * usual**2, bias
