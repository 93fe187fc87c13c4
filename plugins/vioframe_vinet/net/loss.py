"""What VINet is trained by: each motion, and the poses that the motions compose to since the window began.

Gradients pass through the composition, so that an early motion is taught by all that follows from it.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from vioframe.learning.likelihood import accumulated_likelihood
from vioframe.learning.losses import LearnedWeights
from vioframe.learning.motion import compose, exp_so3, log_so3, product
from vioframe_vinet.net.core import CoreAnswer
from vioframe_vinet.net.gyro import Sight

# (rad/s)² and squared shares: the root of nothing has no gradient.
_LEAST_VARIANCE = 1e-14
# Variances learn from their likelihood alone, and an optimiser such as Adam minds no factor. But the gradients of all
# are clipped together, and that of a likelihood may for once be larger than all others by far.
_LIKELIHOOD_WEIGHT = 0.01
# rad: what images show of rotation is weighed as if it erred by this.
_SIGHT_UNIT = 0.002


class PoseErrors(nn.Module):
    """Errors of motions and poses, weighed by variances that are learned with the net (see LearnedWeights)."""

    def __init__(
        self, *, log_variance_rotation: float, log_variance_translation: float, window: int, pose_weight: float
    ) -> None:
        """Start from these log-variances of motions.

        Args:
            log_variance_rotation, log_variance_translation: ln rad² and ln m².
            window: pairs over which poses are composed, whose variances start as if all errors were one.
            pose_weight: of the poses' term.
        """
        super().__init__()
        # Mean of k² over the window.
        grown = math.log((window + 1) * (2 * window + 1) / 6.0)
        self.motions = LearnedWeights(
            log_variance_rotation=log_variance_rotation, log_variance_translation=log_variance_translation
        )
        self.poses = LearnedWeights(
            log_variance_rotation=log_variance_rotation + grown,
            log_variance_translation=log_variance_translation + grown,
        )
        self._window = window
        self._pose_weight = pose_weight

    def forward(self, answer: CoreAnswer, T_prev_cur: Tensor, duration_s: Tensor) -> dict[str, Tensor]:
        """``loss``, which is minimised, and what it is made of.

        Args:
            answer: of the net.
            T_prev_cur: (B, S, 4, 4) true motions.
            duration_s: not used.
        """
        motions = self.motions(motion_errors(answer.T_prev_cur, T_prev_cur), torch.zeros_like(answer.vector))
        if not self._pose_weight:
            return dict(motions)
        errors = motion_errors(*(compose(_cut(each, self._window))[:, 1:] for each in (answer.T_prev_cur, T_prev_cur)))
        poses = self.poses(errors, torch.zeros_like(errors))
        return _sum(motions, poses, self._pose_weight)


class AccumulatedLikelihood(nn.Module):
    """Motions are taught as by :class:`PoseErrors`, and variances by how likely they make the errors that add up.

    Taught by the likelihood too, motions would learn slowly where the net says of itself that it knows little, which is
    what it says first. The likelihood is that of errors summed over stretches of some length
    (:func:`vioframe.learning.likelihood.accumulated_likelihood`), with what lasts stated as such, so that what a chain
    of motions states in the end holds.
    """

    def __init__(self, means: PoseErrors, *, horizons: Sequence[int], scale_memory: int) -> None:
        """Take what teaches the motions, lengths of stretches in pairs, and how long an error of scale lasts."""
        super().__init__()
        self.means = means
        self._horizons = tuple(horizons)
        self._memory = scale_memory

    def forward(self, answer: CoreAnswer, T_prev_cur: Tensor, duration_s: Tensor) -> dict[str, Tensor]:
        """``loss``, which is minimised, and what it is made of.

        Args:
            answer: of the net, with variances.
            T_prev_cur: (B, S, 4, 4) true motions.
            duration_s: (B, S) of each.

        Raises:
            ValueError: no variances.
        """
        if answer.log_variances is None or answer.lasting is None:
            raise ValueError("a likelihood needs variances")
        losses: dict[str, Tensor] = self.means(answer, T_prev_cur, duration_s)
        lasting = answer.lasting.variance
        if lasting.shape[1] < min(self._horizons):
            # So short a stretch does not show what lasts.
            lasting = lasting.detach()
        errors = motion_errors(answer.T_prev_cur.detach(), T_prev_cur)
        variances = answer.log_variances.exp()
        sigmas = lasting.clamp_min(_LEAST_VARIANCE).sqrt()
        R = compose(T_prev_cur)[..., :3, :3]
        counted = torch.ones_like(duration_s, dtype=torch.bool)
        # A rotation's error is in the axes at the pair's end, a translation's in those at its beginning.
        turned = accumulated_likelihood(
            errors[..., :3],
            variances[..., :3],
            R[:, 1:],
            counted,
            self._horizons,
            lasting=torch.diag_embed(sigmas[..., :3] * duration_s[..., None]),
        )
        moved = accumulated_likelihood(
            errors[..., 3:],
            variances[..., 3:],
            R[:, :-1],
            counted,
            self._horizons,
            lasting=(answer.T_prev_cur.detach()[..., :3, 3] * sigmas[..., 3:])[..., None],
            memory=self._memory,
        )
        likelihood = turned + moved
        named = {"likelihood_rotation": turned.detach(), "likelihood_translation": moved.detach()}
        return {**losses, **named, "loss": losses["loss"] + _LIKELIHOOD_WEIGHT * likelihood}


def sight_loss(sight: Sight, visible: Tensor, T_prev_cur: Tensor) -> Tensor:
    """How wrong the rotations are that images show, and how unlikely that is by the variances stated with them.

    Args:
        sight: of (B, S) pairs.
        visible: (B, S) bool, of which there are images.
        T_prev_cur: (B, S, 4, 4) true motions.
    """
    R_true = T_prev_cur[..., :3, :3]
    errors = log_so3(product(R_true.transpose(-1, -2), exp_so3(sight.vector)))[visible]
    spread = sight.log_variances[visible]
    if not len(errors):
        return sight.vector.sum() * 0.0
    likelihood = 0.5 * (errors.detach().square() * torch.exp(-spread) + spread).sum(-1).mean()
    return (errors / _SIGHT_UNIT).square().sum(-1).mean() + _LIKELIHOOD_WEIGHT * likelihood


def motion_errors(T_found: Tensor, T_true: Tensor) -> Tensor:
    """(..., 6): Log(R_trueᵀ R_found) in rad and p_found − p_true in metres."""
    turned = product(T_true[..., :3, :3].transpose(-1, -2), T_found[..., :3, :3])
    return torch.cat([log_so3(turned), T_found[..., :3, 3] - T_true[..., :3, 3]], dim=-1)


def _cut(motions: Tensor, pairs: int) -> Tensor:
    """Motions (B, S, 4, 4) in pieces of so many pairs, or of S where that is less; what is left over is not used."""
    length = min(pairs, motions.shape[1])
    whole = motions.shape[1] // length
    return motions[:, : whole * length].reshape(-1, length, 4, 4)


def _sum(motions: dict[str, Tensor], poses: dict[str, Tensor], pose_weight: float) -> dict[str, Tensor]:
    named = {f"pose_{name}": value.detach() for name, value in poses.items() if name != "loss"}
    return {**motions, **named, "loss": motions["loss"] + pose_weight * poses["loss"]}
