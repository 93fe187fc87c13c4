"""One pose of a rig from known points: robust Levenberg–Marquardt on the reprojection errors."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vioframe.checks import Array
from vioframe.geometry import se3, so3
from vioframe_geometric.rays import Rays, residuals

_CONVERGED = 1e-6
# Robust cost of a point behind the camera: that of a gross outlier.
_BEHIND = 8.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """What one camera of the rig saw of M points: ``rays`` of all of them, meaningless where not ``seen`` (M,)."""

    rays: Rays
    seen: np.ndarray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoseFit:
    """A refined pose.

    Attributes:
        T_ref_cam: (4, 4).
        information: (6, 6) of a right perturbation (rotation, translation).
        errors: (M,) root of the squared whitened error a degree of freedom; infinite behind a camera.
        cost: mean robust cost.
    """

    T_ref_cam: Array
    information: Array
    errors: Array
    cost: float


def cauchy_weights(squared: Array, scale: float) -> Array:
    """Weights (...) of squared normalised errors under the Cauchy loss ``c²/2 ln(1 + e²/c²)``."""
    weights: Array = 1.0 / (1.0 + squared / scale**2)
    return weights


def pose_jacobian(points_cam: Array) -> Array:
    """∂p_cam/∂ξ (..., 3, 6) for ``T_ref_cam Exp(ξ)``: ``[hat(p), −I]``."""
    out = np.zeros((*points_cam.shape, 6))
    out[..., :3] = so3.hat(points_cam)
    out[..., [0, 1, 2], [3, 4, 5]] = -1.0
    return out


def fit_pose(
    T_ref_cam: Array,
    points_ref: Array,
    views: Sequence[View],
    *,
    sigma_px: float,
    point_root: Array | None = None,
    robust_scale: float = 2.0,
    iterations: int = 10,
) -> PoseFit:
    """Minimise the Cauchy cost of the whitened reprojection errors over the pose.

    The errors of a point in all views are whitened together with ``σ² I + J P Jᵀ``: a point of unknown depth still
    tells rotation as long as it shows no parallax.

    Args:
        T_ref_cam: (4, 4) start, of camera 0.
        points_ref: (M, 3).
        views: of the cameras of the rig.
        sigma_px: standard deviation of a pixel coordinate.
        point_root: S (M, 3, 3) with P = S Sᵀ the covariance of the points in the reference frame, or None for points
            known exactly.
        robust_scale: of the Cauchy loss, in standard deviations a degree of freedom.
        iterations: at most.
    """
    seen = np.stack([view.seen for view in views])
    freedom = 2.0 * np.maximum(seen.sum(axis=0), 1)
    counted = seen.any(axis=0)
    T = T_ref_cam
    best: PoseFit | None = None
    damping = 1e-6
    gradient = np.zeros(6)
    whitening = None
    for _ in range(iterations):
        points_cam = (points_ref - T[:3, 3]) @ T[:3, :3]
        error, slope, ahead = stack_residuals(views, points_cam)
        if whitening is None:
            whitening = whiten(slope @ T[:3, :3].T, sigma_px, point_root)
        error = (whitening @ error[..., None])[..., 0]
        squared = np.sum(error * error, axis=-1) / freedom
        used = ahead & counted
        # Points behind the camera and points not seen at all pull at nothing; only the former cost.
        cost = float(np.mean(np.where(ahead, np.log1p(squared / robust_scale**2), _BEHIND)[counted]))
        if best is None or cost < best.cost:
            weight = np.where(used, cauchy_weights(squared, robust_scale), 0.0)
            jacobian = whitening @ (slope @ pose_jacobian(points_cam))
            flat = jacobian.reshape(-1, 6)
            weighted = (jacobian * weight[:, None, None]).reshape(-1, 6)
            gain = np.inf if best is None else best.cost - cost
            best = PoseFit(
                T_ref_cam=T,
                information=weighted.T @ flat,
                errors=np.where(ahead, np.sqrt(squared), np.inf),
                cost=cost,
            )
            gradient = weighted.T @ error.ravel()
            damping = max(damping * 0.1, 1e-9)
            if gain < _CONVERGED:
                break
        else:
            if damping > 1e3:
                break
            damping = max(damping * 100.0, 1e-3)
        diagonal = np.diag(best.information)
        step = np.linalg.solve(best.information + np.diag(damping * diagonal + 1e-9), -gradient)
        T = best.T_ref_cam @ se3.exp(step)
        T[:3, :3] = so3.normalise(T[:3, :3])
    if best is None:
        return PoseFit(T_ref_cam=T_ref_cam, information=np.zeros((6, 6)), errors=np.zeros(0), cost=np.inf)
    return best


def stack_residuals(views: Sequence[View], points_cam: Array) -> tuple[Array, Array, np.ndarray]:
    """Errors (M, 2V) px of points (M, 3) in all V views, zero where not seen; ∂/∂p_cam (M, 2V, 3); ahead (M,)."""
    errors, slopes = [], []
    ahead = np.ones(len(points_cam), dtype=bool)
    for view in views:
        error, slope, before = residuals(view.rays, points_cam)
        live = view.seen & before
        errors.append(np.where(live[:, None], error, 0.0))
        slopes.append(np.where(live[:, None, None], slope, 0.0))
        ahead &= before | ~view.seen
    return np.concatenate(errors, axis=-1), np.concatenate(slopes, axis=-2), ahead


def whiten(slope_ref: Array, sigma_px: float, point_root: Array | None) -> Array:
    """W (M, N, N) with ``Wᵀ W = (σ² I + (J S)(J S)ᵀ)⁻¹``, for J (M, N, 3) and S (M, 3, 3).

    The covariance of a far point is huge along its ray, where J is almost zero: only the product of roots stays
    positive definite in floating point.
    """
    count, size = slope_ref.shape[:2]
    if point_root is None:
        return np.broadcast_to(np.eye(size) / sigma_px, (count, size, size))
    half = slope_ref @ point_root
    covariance = half @ np.swapaxes(half, -1, -2) + sigma_px**2 * np.eye(size)
    inverse: Array = np.linalg.inv(np.linalg.cholesky(covariance))
    return inverse
