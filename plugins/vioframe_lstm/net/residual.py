"""From pairs to corrected motions and what they are worth: the whole of the residual head that is learned."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from vioframe.learning.motion import exp_so3, log_so3, product
from vioframe_lstm.net.causal import CausalNet
from vioframe_lstm.net.features import FEATURES, features
from vioframe_lstm.net.likelihood import accumulated_likelihood, attitudes
from vioframe_lstm.net.pairs import Pairs, disagreement

# A factor of 150 on a standard deviation: what is worse than that carries no weight any more.
_MOST_LOG_VARIANCE = 10.0
# What an output of one means: the part of a component of the motion, of the speed unit and of the rate unit.
_GAIN, _SPEED, _RATE = 0.3, 0.02, 0.02


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Corrected:
    """Motions (B, S) of the body with the variances of their errors, in its axes.

    Attributes:
        R_body: (B, S, 3, 3), t_body: (B, S, 3) m.
        variances: (B, S, 6) rad² and m², of the right perturbation.
    """

    R_body: Tensor
    t_body: Tensor
    variances: Tensor


class ResidualNet(nn.Module):
    """Corrects the motions of a VO and states what they are worth; untrained, it leaves both as they are.

    Args:
        frames: pairs that an answer looks at, two or more: the features of a pair look at the one before too.
        channels: width.
        dropout: in training.
        speed_unit: m/s and rate_unit: rad/s, of size one.
        corrects_rotation: rotations too, not only their variances.

    Attributes:
        interval_s: from image to image in the training recordings, s; zero before any.
    """

    def __init__(
        self,
        *,
        frames: int,
        channels: int,
        dropout: float,
        speed_unit: float,
        rate_unit: float,
        corrects_rotation: bool,
    ) -> None:
        super().__init__()
        self._speed_unit, self._rate_unit = speed_unit, rate_unit
        self._corrects_rotation = corrects_rotation
        self.interval_s: Tensor
        self.register_buffer("interval_s", torch.zeros(()))
        self.causal = CausalNet(FEATURES, 15, channels=channels, frames=frames - 1, dropout=dropout)

    def features(self, pairs: Pairs) -> Tensor:
        """(B, S, FEATURES); the last depends on the last two pairs alone."""
        return features(pairs, self._speed_unit, self._rate_unit)

    def forward(self, pairs: Pairs) -> Corrected:
        """Answer for all pairs, the first ones from fewer before them."""
        return self.correct(pairs, self.causal(self.features(pairs)))

    def correct(self, pairs: Pairs, answers: Tensor) -> Corrected:
        """Apply the net's answers (B, S, 15) to the motions of the VO."""
        answers = answers.float()
        gain, shift, turn, doubt = answers[..., :3], answers[..., 3:6], answers[..., 6:9], answers[..., 9:]
        seconds = pairs.duration_s[..., None]
        t_body = pairs.t_body() * (1.0 + _GAIN * gain) + shift * (_SPEED * self._speed_unit) * seconds
        R_body = pairs.R_visual
        if self._corrects_rotation:
            R_body = product(R_body, exp_so3(turn * (_RATE * self._rate_unit) * seconds))
        doubted = pairs.log_variances + 2.0 * doubt.clamp(-0.5 * _MOST_LOG_VARIANCE, 0.5 * _MOST_LOG_VARIANCE)
        return Corrected(R_body=R_body, t_body=t_body, variances=doubted.exp())


def likelihoods(
    corrected: Corrected, counted: Tensor, T_prev_cur: Tensor, T_body_cam: Tensor, horizons: Sequence[int]
) -> dict[str, Tensor]:
    """``rotation`` and ``translation``: negative log-likelihoods of the accumulated errors; and mean squared errors.

    Args:
        corrected: motions.
        counted: (B, S) bool, those of which there was something to correct.
        T_prev_cur: (B, S, 4, 4) true motion of the camera.
        T_body_cam: (B, 4, 4).
        horizons: see :func:`accumulated_likelihood`.
    """
    R_true, t_true = true_motion(T_prev_cur, T_body_cam)
    back = corrected.R_body.transpose(-1, -2)
    rotation = log_so3(product(back, R_true))
    translation = product(R_true.transpose(-1, -2), (t_true - corrected.t_body)[..., None])[..., 0]
    R_first_cur = attitudes(R_true)
    heard = counted[..., None].to(rotation.dtype)
    total = heard.sum().clamp_min(1.0)
    return {
        "rotation": accumulated_likelihood(rotation, corrected.variances[..., :3], R_first_cur, counted, horizons),
        "translation": accumulated_likelihood(
            translation, corrected.variances[..., 3:], R_first_cur, counted, horizons
        ),
        "squared_rotation": (rotation.square() * heard).sum().detach() / total,
        "squared_translation": (translation.square() * heard).sum().detach() / total,
    }


def true_motion(T_prev_cur: Tensor, T_body_cam: Tensor) -> tuple[Tensor, Tensor]:
    """Rotation (B, S, 3, 3) and shift (B, S, 3) m of the body of motions (B, S, 4, 4) of a camera at (B, 4, 4)."""
    R_body_cam, p_body_cam = T_body_cam[:, None, :3, :3], T_body_cam[:, None, :3, 3]
    R = product(product(R_body_cam, T_prev_cur[..., :3, :3]), R_body_cam.transpose(-1, -2))
    moved = product(R_body_cam, T_prev_cur[..., :3, 3:])[..., 0]
    return R, moved + p_body_cam - product(R, p_body_cam.expand_as(moved)[..., None])[..., 0]


def states(corrected: Corrected, pairs: Pairs, gyro_bias_sigma: float) -> Tensor:
    """Motions (B, S, 4, 4) of the camera much as the filter will have them, for validation.

    Attitude from the gyro, whose constant bias b is estimated from the VO's rotations so far as the filter does it:
    ``Log(R_gyroᵀ R_vo) ≈ −b T`` with the stated variances, and b ~ N(0, σ²) beforehand. Without samples it is the
    VO's; without a motion of the VO the last speed is held.

    Args:
        corrected: motions.
        pairs: that were corrected.
        gyro_bias_sigma: σ, rad/s.
    """
    both = pairs.visual & pairs.inertial
    weight = both / corrected.variances[..., :3].mean(-1)
    seconds = pairs.duration_s
    # What the pair itself tells comes too late for the bias that its samples are freed from.
    told = (weight * seconds)[..., None] * -disagreement(pairs)
    told, known = told.cumsum(1) - told, (weight * seconds**2).cumsum(1) - weight * seconds**2
    bias = told / (known + gyro_bias_sigma**-2)[..., None]
    R_inertial = exp_so3(pairs.turn - bias * seconds[..., None])
    R_body = torch.where(pairs.inertial[..., None, None], R_inertial, corrected.R_body)
    number = torch.arange(len(pairs), device=seconds.device).expand_as(pairs.visual)
    last = torch.where(pairs.visual, number, torch.zeros_like(number)).cummax(1).values
    speed = corrected.t_body / seconds[..., None]
    held = speed.gather(1, last[..., None].expand_as(speed)) * seconds[..., None]
    return pairs.T_camera(R_body, held)
