"""What VINet is trained by: each motion, and the poses that the motions compose to since the window began.

Gradients pass through the composition, so that an early motion is taught by all that follows from it.
"""

import math

import torch
from torch import Tensor, nn

from vioframe.learning.losses import GaussianLikelihood, LearnedWeights
from vioframe.learning.motion import compose, covariance_from_log_variances, exp_so3, hat, inverse, log_so3, product
from vioframe_vinet.net.core import CoreAnswer
from vioframe_vinet.net.gyro import Sight

# Least standard deviation that the error of a pose is measured against, in units of the output.
_LEAST_SIGMA = 1e-3
# rad: what images show of rotation is weighed as if it erred by this.
_SIGHT_UNIT = 0.005


class PoseErrors(nn.Module):
    """Errors of motions and poses, weighed by variances that are learned with the net (see LearnedWeights)."""

    def __init__(
        self, *, log_variance_rotation: float, log_variance_translation: float, window: int, pose_weight: float
    ) -> None:
        """Start from these log-variances of motions.

        Args:
            log_variance_rotation, log_variance_translation: ln rad² and ln m².
            window: pairs of a window, of whose poses the variances start as if all errors were one.
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
        self._pose_weight = pose_weight

    def forward(self, answer: CoreAnswer, T_prev_cur: Tensor, log_variances: Tensor | None) -> dict[str, Tensor]:
        """``loss``, which is minimised, and what it is made of.

        Args:
            answer: of the net.
            T_prev_cur: (B, S, 4, 4) true motions.
            log_variances: not used.
        """
        motions = self.motions(motion_errors(answer.T_prev_cur, T_prev_cur), torch.zeros_like(answer.vector))
        if not self._pose_weight:
            return dict(motions)
        errors = motion_errors(compose(answer.T_prev_cur)[:, 1:], compose(T_prev_cur)[:, 1:])
        poses = self.poses(errors, torch.zeros_like(errors))
        return _sum(motions, poses, self._pose_weight)


class PoseLikelihood(nn.Module):
    """Motions are taught as by :class:`PoseErrors`, and variances by how likely they make the errors that are left.

    Taught by the likelihood too, motions would learn slowly where the net says of itself that it knows little, which is
    what it says first. The likelihood is that of the motions and of the poses that they compose to: in these it shows
    that errors of consecutive motions resemble each other, so that the variances are right for the sum.
    """

    def __init__(
        self, means: PoseErrors, *, rotation_unit_rad: float, translation_unit_m: float, pose_weight: float
    ) -> None:
        """Take what teaches the motions, the units in which errors are of the order of 1, and the poses' weight."""
        super().__init__()
        self.means = means
        self.motions = GaussianLikelihood()
        self._units = (rotation_unit_rad, translation_unit_m)
        self._pose_weight = pose_weight

    def forward(self, answer: CoreAnswer, T_prev_cur: Tensor, log_variances: Tensor | None) -> dict[str, Tensor]:
        """``loss``, which is minimised, and what it is made of.

        Args:
            answer: of the net.
            T_prev_cur: (B, S, 4, 4) true motions.
            log_variances: (B, S, 6), ln rad² and ln m².

        Raises:
            ValueError: no variances.
        """
        if log_variances is None:
            raise ValueError("a likelihood needs variances")
        losses: dict[str, Tensor] = self.means(answer, T_prev_cur, None)
        found, vector = answer.T_prev_cur.detach(), answer.vector.detach()
        unit = vector.new_tensor([self._units[0]] * 3 + [self._units[1]] * 3)
        errors = motion_errors(found, T_prev_cur) / unit
        scaled = log_variances - 2.0 * unit.log()
        likelihood = self.motions(errors, torch.zeros_like(errors), scaled)["loss"]
        if self._pose_weight:
            stated = composed_covariance(found, covariance_from_log_variances(vector, log_variances))
            errors = tangent_errors(compose(found)[:, 1:], compose(T_prev_cur)[:, 1:])
            likelihood = likelihood + self._pose_weight * negative_log_likelihood(errors, stated, unit).mean()
        return {**losses, "loss": losses["loss"] + likelihood, "likelihood": likelihood.detach()}


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
    return (errors / _SIGHT_UNIT).square().sum(-1).mean() + likelihood


def motion_errors(T_found: Tensor, T_true: Tensor) -> Tensor:
    """(..., 6): Log(R_trueᵀ R_found) in rad and p_found − p_true in metres."""
    turned = product(T_true[..., :3, :3].transpose(-1, -2), T_found[..., :3, :3])
    return torch.cat([log_so3(turned), T_found[..., :3, 3] - T_true[..., :3, 3]], dim=-1)


def tangent_errors(T_found: Tensor, T_true: Tensor) -> Tensor:
    """ξ (..., 6) with T_true ≈ T_found Exp(ξ), to first order in the translation."""
    between = product(inverse(T_found), T_true)
    return torch.cat([log_so3(between[..., :3, :3]), between[..., :3, 3]], dim=-1)


def composed_covariance(T_prev_cur: Tensor, covariance: Tensor) -> Tensor:
    """Covariance (B, S, 6, 6) of the poses after each motion, when errors are independent.

    Args:
        T_prev_cur: (B, S, 4, 4).
        covariance: (B, S, 6, 6) of each motion, right perturbation, order (rotation, translation).
    """
    # A step changes the perturbation by the adjoint of its inverse: P ← Ad(T⁻¹) P Ad(T⁻¹)ᵀ + Q.
    back = adjoint(inverse(T_prev_cur))
    found = [covariance[:, 0]]
    for k in range(1, covariance.shape[1]):
        step = back[:, k]
        found.append(product(product(step, found[-1]), step.transpose(-1, -2)) + covariance[:, k])
    return torch.stack(found, dim=1)


def adjoint(T: Tensor) -> Tensor:
    """Ad (..., 6, 6) of T (..., 4, 4): ``T Exp(ξ) T⁻¹ = Exp(Ad ξ)``, order (rotation, translation)."""
    R = T[..., :3, :3]
    top = torch.cat([R, torch.zeros_like(R)], dim=-1)
    bottom = torch.cat([product(hat(T[..., :3, 3]), R), R], dim=-1)
    return torch.cat([top, bottom], dim=-2)


def negative_log_likelihood(errors: Tensor, covariance: Tensor, unit: Tensor) -> Tensor:
    """½ (ξᵀ P⁻¹ ξ + log det P) of ξ (..., 6), both in ``unit`` (6,)."""
    # Rotations of 1e-4 rad beside metres: what is inverted is brought to one size, and in double precision.
    scale = unit.double()
    floor = _LEAST_SIGMA**2 * torch.eye(6, dtype=scale.dtype, device=scale.device)
    factor = torch.linalg.cholesky(covariance.double() / (scale[:, None] * scale) + floor)
    white = torch.linalg.solve_triangular(factor, (errors.double() / scale)[..., None], upper=False)[..., 0]
    log_det = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    likelihood: Tensor = 0.5 * white.square().sum(-1) + log_det
    return likelihood.to(errors.dtype)


def _sum(motions: dict[str, Tensor], poses: dict[str, Tensor], pose_weight: float) -> dict[str, Tensor]:
    named = {f"pose_{name}": value.detach() for name, value in poses.items() if name != "loss"}
    return {**motions, **named, "loss": motions["loss"] + pose_weight * poses["loss"]}
