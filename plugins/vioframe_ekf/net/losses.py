"""How far the filter's motions and poses are from the truth, and whether its covariance says so."""

from dataclasses import dataclass

import torch
from torch import Tensor

from vioframe.learning.motion import log_so3
from vioframe_ekf.net.robocentric import apply


@dataclass(frozen=True, slots=True, kw_only=True)
class LossWeights:
    """Weights of the terms of :func:`filter_losses`.

    Attributes:
        relative, absolute, likelihood: of the three.
        relative_rotation: κ1, m²/rad² a pair.
        absolute_rotation: κ2, m² for the squared Frobenius norm of a rotation's error.
    """

    relative: float
    absolute: float
    likelihood: float
    relative_rotation: float
    absolute_rotation: float


def filter_losses(poses: Tensor, covariances: Tensor, truth: Tensor, weights: LossWeights) -> dict[str, Tensor]:
    """``loss``, which is minimised, and what it is made of.

    With E_k the error of the motion over pair k and of the pose at its end (Li & Waslander 2020, section III-D, with
    squares so that neither has a kink where it is to end)::

        C1 = mean_k (κ1 |Log E_R|² + |E_t|²)
        C2 = mean_k (κ2 ‖E_R − I‖²_F + |E_t|²) / k        what white errors add up to grows with k
        C3 = mean_k ½ (ζᵀ P⁻¹ ζ + ln det P) / 6            ζ: error of the pose, P: what the filter says of it

    and the loss is ``w1 ln C1 + w2 ln C2 + w3 C3``. The logarithms make errors of a car and of a hand weigh the same;
    it is what variances learned for C1 and C2 come to (Kendall & Cipolla, CVPR 2017). C1 and C2 only see ratios of
    variances, on which gains depend, and C3 their common size too; errors that last make C3 alone trust the odometry
    more than is good for the poses.

    Args:
        poses: (B, S + 1, 4, 4) T_world_body of the filter.
        covariances: (B, S, 6, 6) of ζ, see :mod:`vioframe_ekf.net.robocentric`.
        truth: (B, S + 1, 4, 4).
        weights: of the terms.
    """
    motion, true_motion = _motions(poses), _motions(truth)
    turns = log_so3(motion[0].transpose(-1, -2) @ true_motion[0]).square().sum(-1)
    shifts = (true_motion[1] - motion[1]).square().sum(-1)
    relative = (weights.relative_rotation * turns + shifts).mean()

    R, p = poses[:, 1:, :3, :3], poses[:, 1:, :3, 3]
    R_true, p_true = truth[:, 1:, :3, :3], truth[:, 1:, :3, 3]
    error = R_true @ R.transpose(-1, -2)
    eye = torch.eye(3, dtype=R.dtype, device=R.device)
    pairs = torch.arange(1, R.shape[1] + 1, dtype=R.dtype, device=R.device)
    frobenius = (error - eye).square().sum((-2, -1))
    away = (p_true - p).square().sum(-1)
    absolute = ((weights.absolute_rotation * frobenius + away) / pairs).mean()

    zeta = torch.cat([log_so3(error), p_true - apply(error, p)], dim=-1)
    L, _ = torch.linalg.cholesky_ex(covariances)
    white = torch.linalg.solve_triangular(L, zeta[..., None], upper=False)[..., 0]
    chi_square = white.square().sum(-1)
    spread = 2.0 * L.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    likelihood = 0.5 * (chi_square + spread).mean() / 6.0

    total = weights.relative * relative.log() + weights.absolute * absolute.log() + weights.likelihood * likelihood
    return {
        "loss": total,
        "relative": relative.detach(),
        "absolute": absolute.detach(),
        "likelihood": likelihood.detach(),
        "anees": chi_square.detach().mean() / 6.0,
        "rotation": turns.detach().mean(),
        "translation": shifts.detach().mean(),
    }


def _motions(poses: Tensor) -> tuple[Tensor, Tensor]:
    """Rotation (B, S, 3, 3) and translation (B, S, 3) from each pose to the next, in the former."""
    back = poses[:, :-1, :3, :3].transpose(-1, -2)
    return back @ poses[:, 1:, :3, :3], apply(back, poses[:, 1:, :3, 3] - poses[:, :-1, :3, 3])
