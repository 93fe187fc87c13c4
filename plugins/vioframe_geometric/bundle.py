"""A small bundle adjustment: some keyframes, their landmarks, dense arrays, Schur complement.

Observations fill a grid (K keyframes × M points) with holes. Levenberg–Marquardt on the Cauchy cost; the points,
which are 3×3 blocks, are eliminated first (Triggs et al. 2000, section 6), which leaves a system of the free poses.
"""

from dataclasses import dataclass

import numpy as np

from vioframe.checks import Array
from vioframe.geometry import se3, so3
from vioframe_geometric.pose import cauchy_weights, pose_jacobian
from vioframe_geometric.rays import Rays, residuals

_CONVERGED = 1e-5
_BEHIND = 8.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BundleProblem:
    """What is adjusted.

    Attributes:
        T_map_cam: (K, 4, 4) poses.
        free: (K,) which of them may move.
        origins, rotations, q: (M, 3), (M, 3, 3), (M, 3) of the landmarks.
        prior_q, prior_information: (M, 3), (M, 3, 3) what is known of q besides the observations.
        rays: K·M observations, row k·M + m, of camera 0.
        seen: (K, M).
        sigma_px: of a pixel coordinate.
        min_inverse_depth: smallest ρ.
    """

    T_map_cam: Array
    free: np.ndarray
    origins: Array
    rotations: Array
    q: Array
    prior_q: Array
    prior_information: Array
    rays: Rays
    seen: np.ndarray
    sigma_px: float
    min_inverse_depth: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BundleResult:
    """Adjusted poses (K, 4, 4) and points (M, 3) with their covariances.

    Attributes:
        T_map_cam, q: adjusted.
        q_covariance: (M, 3, 3), the uncertainty of the poses included.
        pose_covariance: (6F, 6F) of the F free poses in order.
        errors: (K, M) length of the error over σ a degree of freedom; infinite behind the camera, 0 where not seen.
        cost_before, cost: mean robust cost.
    """

    T_map_cam: Array
    q: Array
    q_covariance: Array
    pose_covariance: Array
    errors: Array
    cost_before: float
    cost: float


def linearise(problem: BundleProblem, T_map_cam: Array, q: Array) -> tuple[Array, Array, Array, np.ndarray]:
    """Whitened errors (K, M, 2), slopes by the poses (K, M, 2, 6) and by q (K, M, 2, 3), and ahead (K, M)."""
    views, count = problem.seen.shape
    inverse = 1.0 / q[:, 2]
    ray = np.concatenate([q[:, :2], np.ones((count, 1))], axis=-1) * inverse[:, None]
    points = problem.origins + (problem.rotations @ ray[..., None])[..., 0]
    slope_q = np.zeros((count, 3, 3))
    slope_q[:, 0, 0] = slope_q[:, 1, 1] = inverse
    slope_q[:, :, 2] = -ray * inverse[:, None]
    slope_q = problem.rotations @ slope_q
    R = T_map_cam[:, :3, :3]
    points_cam = (points[None] - T_map_cam[:, None, :3, 3]) @ R
    flat = points_cam.reshape(-1, 3)
    error, slope, ahead = residuals(problem.rays, flat)
    live = (ahead & problem.seen.ravel()) / problem.sigma_px
    error = (error * live[:, None]).reshape(views, count, 2)
    slope = slope * live[:, None, None]
    by_pose = (slope @ pose_jacobian(flat)).reshape(views, count, 2, 6)
    by_q = slope.reshape(views, count, 2, 3) @ (np.swapaxes(R, -1, -2)[:, None] @ slope_q[None])
    return error, by_pose, by_q, ahead.reshape(views, count)


def adjust(problem: BundleProblem, *, iterations: int = 6, robust_scale: float = 2.0) -> BundleResult:
    """Run Levenberg–Marquardt; the result is never worse than the start."""
    T, q = problem.T_map_cam, problem.q
    free = np.flatnonzero(problem.free)
    count = problem.seen.shape[1]
    observations = max(int(problem.seen.sum()), 1)
    damping = 1e-4
    best_cost = cost_before = np.inf
    state = None
    for _ in range(iterations):
        error, by_pose, by_q, ahead = linearise(problem, T, q)
        squared = 0.5 * np.sum(error * error, axis=-1)
        off = q - problem.prior_q
        pull = (problem.prior_information @ off[..., None])[..., 0]
        cost = float(
            np.sum(np.where(ahead, np.log1p(squared / robust_scale**2), _BEHIND) * problem.seen)
            + 0.5 * np.sum(off * pull) / robust_scale**2
        )
        if cost < best_cost:
            gain = best_cost - cost
            if not np.isfinite(best_cost):
                cost_before = cost
            best_cost = cost
            weight = cauchy_weights(squared, robust_scale)[..., None, None]
            weighted_pose = by_pose[free] * weight[free]
            weighted_q = by_q * weight
            transposed_pose = np.swapaxes(weighted_pose, -1, -2)
            Hcc = np.sum(transposed_pose @ by_pose[free], axis=1)
            Hcq = transposed_pose @ by_q[free]
            Hqq = np.sum(np.swapaxes(weighted_q, -1, -2) @ by_q, axis=0) + problem.prior_information
            bc = np.sum(transposed_pose @ error[free][..., None], axis=1)[..., 0]
            bq = np.sum(np.swapaxes(weighted_q, -1, -2) @ error[..., None], axis=0)[..., 0] + pull
            state = (T, q, Hcc, Hcq, Hqq, bc, bq, np.where(ahead, np.sqrt(squared), np.inf))
            damping = max(0.1 * damping, 1e-8)
            if gain < _CONVERGED * observations:
                break
        else:
            damping *= 50.0
            if damping > 1e4:
                break
        if state is None:
            break
        T0, q0, Hcc, Hcq, Hqq, bc, bq, _ = state
        step_c, step_q, _, _ = _solve(Hcc, Hcq, Hqq, bc, bq, damping)
        T = T0.copy()
        moved = T0[free] @ se3.exp(step_c)
        moved[:, :3, :3] = so3.normalise(moved[:, :3, :3])
        T[free] = moved
        q = q0 + step_q
        q[:, 2] = np.maximum(q[:, 2], problem.min_inverse_depth)
    if state is None:
        raise ValueError("iterations must be at least 1")
    T, q, Hcc, Hcq, Hqq, bc, bq, errors = state
    _, _, V, schur_inverse = _solve(Hcc, Hcq, Hqq, bc, bq, 1e-9)
    VW = V[None] @ np.swapaxes(Hcq, -1, -2)
    VW = VW.transpose(1, 2, 0, 3).reshape(count, 3, -1)
    q_covariance = V + VW @ schur_inverse @ np.swapaxes(VW, -1, -2)
    return BundleResult(
        T_map_cam=T,
        q=q,
        q_covariance=q_covariance,
        pose_covariance=schur_inverse,
        errors=np.where(problem.seen, errors, 0.0),
        cost_before=cost_before / observations,
        cost=best_cost / observations,
    )


def _solve(
    Hcc: Array, Hcq: Array, Hqq: Array, bc: Array, bq: Array, damping: float
) -> tuple[Array, Array, Array, Array]:
    """Steps of the poses (F, 6) and points (M, 3); inverses of the damped point blocks and of the Schur complement."""
    views, count = Hcq.shape[:2]
    size = 6 * views
    diagonal = np.einsum("mii->mi", Hqq)
    V = np.linalg.inv(Hqq + (damping * diagonal + 1e-9)[..., None] * np.eye(3))
    WV = Hcq @ V
    flat = WV.transpose(0, 2, 1, 3).reshape(size, 3 * count)
    schur = -flat @ Hcq.transpose(0, 2, 1, 3).reshape(size, 3 * count).T
    for k in range(views):
        block = slice(6 * k, 6 * k + 6)
        schur[block, block] += Hcc[k] + np.diag(damping * np.diag(Hcc[k]) + 1e-9)
    right = bc.reshape(size) - flat @ bq.reshape(3 * count)
    inverse = np.linalg.inv(0.5 * (schur + schur.T)) if size else np.zeros((0, 0))
    step_c = -(inverse @ right)
    back = (np.swapaxes(Hcq, -1, -2) @ step_c.reshape(views, 1, 6, 1)).sum(axis=0)[..., 0]
    step_q = -(V @ (bq + back)[..., None])[..., 0]
    return step_c.reshape(views, 6), step_q, V, inverse
