"""What the residual head has learned: corrections of motions, what they are worth, and the bias of gyros."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from vioframe.learning.likelihood import accumulated_likelihood
from vioframe_lstm.features import FEATURES
from vioframe_lstm.net.causal import CausalNet, Memory
from vioframe_lstm.net.gyros import GyroRecord

ANSWERS = 12
"""Numbers that the net answers: gains of the three components of a shift, additions to them, ln of variances."""
# A factor of 150 on a standard deviation: what is worse than that carries no weight any more.
_MOST_LOG_VARIANCE = 10.0
# What an output of one means: a share of each component, a share of the speed unit, and ln of a variance.
_GAIN, _SPEED, _DOUBT = 0.3, 0.02, 2.0


class ResidualNet(nn.Module):
    """Corrects the motions of a VO and states what they are worth; untrained, it leaves both as they are.

    Args:
        frames: pairs that an answer looks at, two or more: the features of a pair look at the one before too.
        channels: width.
        dropout: in training.
        speed_unit: m/s, of size one.

    Attributes:
        interval_s: from image to image in the training recordings, s; zero before any.
        gyros: what gyros were off by.
    """

    interval_s: Tensor

    def __init__(self, *, frames: int, channels: int, dropout: float, speed_unit: float) -> None:
        super().__init__()
        self.causal = CausalNet(FEATURES, ANSWERS, channels=channels, frames=frames - 1, dropout=dropout)
        self._speed = _SPEED * speed_unit
        self.gyros = GyroRecord()
        self.register_buffer("interval_s", torch.zeros((), dtype=torch.float64))

    def forward(self, features: Tensor) -> Tensor:
        """Answers (B, S, ANSWERS) to features (B, S, FEATURES): shares, m/s, and ln of factors on variances."""
        return self._in_units(self.causal(features).float())

    def step(self, features: Tensor, memory: Memory) -> Tensor:
        """The same for one more pair of a stream: (ANSWERS,) of (FEATURES,)."""
        return self._in_units(self.causal.step(features, memory).float())

    def _in_units(self, answers: Tensor) -> Tensor:
        half = _MOST_LOG_VARIANCE / _DOUBT
        parts = [
            _GAIN * answers[..., :3],
            self._speed * answers[..., 3:6],
            _DOUBT * answers[..., 6:].clamp(-half, half),
        ]
        return torch.cat(parts, dim=-1)


def likelihoods(
    errors: Tensor, log_variances: Tensor, R_first_cur: Tensor, counted: Tensor, horizons: Sequence[int]
) -> dict[str, Tensor]:
    """``rotation`` and ``translation``: negative log-likelihoods of the accumulated errors; and mean squared errors.

    Args:
        errors: (B, S, 6) rad and m, in the body at the later image.
        log_variances: (B, S, 6).
        R_first_cur: (B, S, 3, 3) true attitude there.
        counted: (B, S) bool, those of which there was something to correct.
        horizons: see :func:`accumulated_likelihood`.
    """
    variances = log_variances.exp()
    squared = (errors.detach().square() * counted[..., None]).sum((0, 1)) / counted.sum().clamp_min(1)
    return {
        **{
            name: accumulated_likelihood(errors[..., part], variances[..., part], R_first_cur, counted, horizons)
            for name, part in (("rotation", slice(0, 3)), ("translation", slice(3, 6)))
        },
        "squared_rotation": squared[:3].sum(),
        "squared_translation": squared[3:].sum(),
    }
