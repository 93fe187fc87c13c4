"""Relative pose of two views up to the length of the translation."""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from vioframe.checks import Array
from vioframe.geometry import so3
from vioframe.geometry.triangulation import triangulate
from vioframe.types import Camera
from vioframe_geometric.pose import cauchy_weights
from vioframe_geometric.rays import distortion_slope

_ITERATIONS = 12
_ROBUST = 2.0
_DIRECTIONS = 150
_STARTS = 4
_SHORT = 8
_APART = 0.92
_MIN_AHEAD = 0.5
_SAME_COST = 1.0
_AS_GOOD = 0.95
_OTHER_DIRECTION = 0.97
_SHIFT = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TwoViewFit:
    """A motion ``p_prev = R p_cur + t`` with ``|t| = 1``.

    Attributes:
        R_prev_cur: (3, 3).
        t: (3,) unit, in the previous camera.
        covariance: (5, 5) of (rotation on the right, two tangents of t along ``tangents``).
        tangents: (3, 2) orthonormal, orthogonal to t.
        errors: (M,) Sampson distances over σ.
        cost: mean robust cost.
        ambiguous: another direction fits as well (points on one plane).
    """

    R_prev_cur: Array
    t: Array
    covariance: Array
    tangents: Array
    errors: Array
    cost: float
    ambiguous: bool = False


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pairs:
    """Points seen twice: homogeneous normalised coordinates (M, 3), and ∂(normalised)/∂(pixel) (M, 2, 2), in each."""

    prev: Array
    cur: Array
    slope_prev: Array
    slope_cur: Array

    def __len__(self) -> int:
        return len(self.prev)


def pair(camera: Camera, bearings_prev: Array, bearings_cur: Array) -> Pairs:
    """Prepare bearings (M, 3) of the same points in two images of one camera."""
    prev = bearings_prev / np.maximum(bearings_prev[:, 2:], 1e-3)
    cur = bearings_cur / np.maximum(bearings_cur[:, 2:], 1e-3)
    return Pairs(
        prev=prev,
        cur=cur,
        slope_prev=np.linalg.inv(distortion_slope(camera, prev[:, :2])),
        slope_cur=np.linalg.inv(distortion_slope(camera, cur[:, :2])),
    )


def fit_two_view(pairs: Pairs, *, focal_px: float, sigma_px: float, threshold_px: float) -> TwoViewFit | None:
    """The motion with the least robust Sampson cost that puts the points before both cameras.

    Starts from OpenCV's USAC five-point solution and from the rotation alone; both are refined. None where
    neither gives a solution.
    """
    starts: list[tuple[Array, Array]] = []
    essential, _ = cv2.findEssentialMat(
        np.ascontiguousarray(pairs.prev[:, :2]),
        np.ascontiguousarray(pairs.cur[:, :2]),
        np.eye(3),
        method=cv2.USAC_MAGSAC,
        prob=0.999,
        threshold=threshold_px / focal_px,
        maxIters=300,
    )
    if essential is not None and essential.shape == (3, 3):
        # OpenCV's E maps cur ← prev: x_cur = R x_prev + t.
        first, second, t_cur = cv2.decomposeEssentialMat(essential)
        for R_cur_prev in (first, second):
            starts.append((R_cur_prev.T, -R_cur_prev.T @ t_cur[:, 0]))
    R_only = fit_rotation(pairs)
    starts += _search_directions(pairs, R_only, sigma_px)
    fits = []
    for R, t in starts:
        fit = _refine(pairs, R, t / np.linalg.norm(t), sigma_px, iterations=_SHORT)
        one, other = _ahead(pairs, fit.R_prev_cur, fit.t), _ahead(pairs, fit.R_prev_cur, -fit.t)
        if max(one, other) >= _MIN_AHEAD:
            fits.append((max(one, other), fit.R_prev_cur, fit.t if one >= other else -fit.t, fit.cost))
    if not fits:
        return None
    # Points on one plane fit two motions equally well; mostly only one of them puts all points before the cameras.
    limit = min(fit[3] for fit in fits) + _SAME_COST / len(pairs)
    level = [fit for fit in fits if fit[3] <= limit]
    ahead, R, t, _ = max(level, key=lambda fit: (round(fit[0], 3), -fit[3]))
    ambiguous = any(fit[0] > _AS_GOOD * ahead and float(fit[2] @ t) < _OTHER_DIRECTION for fit in level)
    return replace(_refine(pairs, R, t, sigma_px, exact=True), ambiguous=ambiguous)


def _search_directions(pairs: Pairs, R_start: Array, sigma_px: float) -> list[tuple[Array, Array]]:
    """The best few of a grid of directions, each with the small rotation that fits it best.

    At video rate the Sampson cost has many minima; given t, the error is linear in a small rotation, so that
    the whole half sphere can be searched at once (variable projection).
    """
    index = np.arange(_DIRECTIONS) + 0.5
    height = 1.0 - index / _DIRECTIONS
    azimuth = np.pi * (1.0 + 5.0**0.5) * index
    radius = np.sqrt(1.0 - height**2)
    directions = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), height], axis=-1)
    turned = pairs.cur @ R_start.T
    across = np.cross(pairs.prev[None], directions[:, None])
    error = np.sum(across * turned, axis=-1)
    across_cur = across @ R_start
    slope = np.cross(pairs.cur[None], across_cur)
    line_prev = np.cross(directions[:, None], turned[None])
    length = np.sqrt(
        np.sum(np.einsum("dmi,mij->dmj", line_prev[..., :2], pairs.slope_prev) ** 2, axis=-1)
        + np.sum(np.einsum("dmi,mij->dmj", across_cur[..., :2], pairs.slope_cur) ** 2, axis=-1)
    )
    scale = 1.0 / (np.maximum(length, 1e-9) * sigma_px)
    error, slope = error * scale, slope * scale[..., None]
    turn = np.zeros((_DIRECTIONS, 3))
    for _ in range(4):
        left = error + np.einsum("dmi,di->dm", slope, turn)
        weighted = slope * cauchy_weights(left * left, _ROBUST)[..., None]
        normal = np.swapaxes(weighted, -1, -2) @ slope + 1e-9 * np.eye(3)
        turn = -np.linalg.solve(normal, np.swapaxes(weighted, -1, -2) @ error[..., None])[..., 0]
    left = error + np.einsum("dmi,di->dm", slope, turn)
    cost = np.mean(np.log1p((left / _ROBUST) ** 2), axis=-1)
    chosen: list[int] = []
    for candidate in np.argsort(cost):
        if all(abs(float(directions[candidate] @ directions[other])) < _APART for other in chosen):
            chosen.append(int(candidate))
        if len(chosen) == _STARTS:
            break
    return [(R_start @ so3.exp(turn[k]), directions[k]) for k in chosen]


def _exact_slope(pairs: Pairs, R: Array, t: Array, tangents: Array, error_px: Array) -> Array:
    """∂(Sampson distance)/∂(θ, tangents of t) (M, 5) by forward differences, its denominator included."""
    out = np.empty((len(pairs), 5))
    for k, shift in enumerate(_SHIFT * np.eye(5)):
        raw, _, length = sampson(pairs, R @ so3.exp(shift[:3]), t + tangents @ shift[3:])
        out[:, k] = (raw / length - error_px) / _SHIFT
    return out


def fit_rotation(pairs: Pairs, rounds: int = 4) -> Array:
    """R_prev_cur (3, 3) that best turns the rays of one view into those of the other (Kabsch, reweighted)."""
    a = pairs.prev / np.linalg.norm(pairs.prev, axis=-1, keepdims=True)
    b = pairs.cur / np.linalg.norm(pairs.cur, axis=-1, keepdims=True)
    weight = np.ones(len(a))
    R = np.eye(3)
    for _ in range(rounds):
        u, _, vt = np.linalg.svd((a * weight[:, None]).T @ b)
        R = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        distance = np.linalg.norm(a - b @ R.T, axis=-1)
        weight = 1.0 / (distance + 0.5 * np.median(distance) + 1e-6)
    return R


def parallax_px(pairs: Pairs, R_prev_cur: Array, focal_px: float) -> Array:
    """Displacement (M,) px, as an angle times the focal length, that the rotation does not explain."""
    a = pairs.prev / np.linalg.norm(pairs.prev, axis=-1, keepdims=True)
    b = pairs.cur @ R_prev_cur.T / np.linalg.norm(pairs.cur, axis=-1, keepdims=True)
    distance: Array = np.linalg.norm(a - b, axis=-1)
    return distance * focal_px


def sampson(pairs: Pairs, R: Array, t: Array) -> tuple[Array, Array, Array]:
    """Epipolar error ``prevᵀ [t]× R cur`` (M,), its slope by (θ, t) (M, 6), and its Sampson length in px (M,).

    θ perturbs R on the right. Dividing error and slope by the length gives pixels.
    """
    turned = pairs.cur @ R.T
    across = np.cross(pairs.prev, t)
    error = np.sum(across * turned, axis=-1)
    slope = np.concatenate([np.cross(pairs.cur, across @ R), np.cross(turned, pairs.prev)], axis=-1)
    line_prev = np.cross(t, turned)
    line_cur = across @ R
    gradient_prev = (line_prev[:, None, :2] @ pairs.slope_prev)[:, 0]
    gradient_cur = (line_cur[:, None, :2] @ pairs.slope_cur)[:, 0]
    length = np.sqrt(np.sum(gradient_prev**2, axis=-1) + np.sum(gradient_cur**2, axis=-1))
    # The line is undefined where the ray is the translation itself; such a point says nothing.
    return error, slope, np.maximum(length, 1e-9)


def tangents_of(t: Array) -> Array:
    """Two orthonormal vectors (3, 2) orthogonal to the unit vector t."""
    helper = np.eye(3)[int(np.argmin(np.abs(t)))]
    first = np.cross(t, helper)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(t, first)], axis=-1)


def _refine(
    pairs: Pairs, R: Array, t: Array, sigma_px: float, iterations: int = _ITERATIONS, *, exact: bool = False
) -> TwoViewFit:
    best: TwoViewFit | None = None
    damping = 1e-4
    normal, gradient = np.eye(5), np.zeros(5)
    for _ in range(iterations):
        raw, slope, length = sampson(pairs, R, t)
        error = raw / (length * sigma_px)
        cost = float(np.mean(np.log1p((error / _ROBUST) ** 2)))
        if best is None or cost < best.cost:
            gain = np.inf if best is None else best.cost - cost
            tangents = tangents_of(t)
            if exact:
                jacobian = _exact_slope(pairs, R, t, tangents, raw / length) / sigma_px
            else:
                jacobian = np.concatenate([slope[:, :3], slope[:, 3:] @ tangents], axis=-1)
                jacobian = jacobian / (length * sigma_px)[:, None]
            weighted = jacobian * cauchy_weights(error * error, _ROBUST)[:, None]
            normal = weighted.T @ jacobian
            gradient = weighted.T @ error
            best = TwoViewFit(R_prev_cur=R, t=t, covariance=normal, tangents=tangents, errors=np.abs(error), cost=cost)
            damping *= 0.1
            if gain < 1e-7:
                break
        else:
            damping *= 30.0
            if damping > 1e4:
                break
        step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)) + 1e-9 * np.eye(5), -gradient)
        R = so3.normalise(best.R_prev_cur @ so3.exp(step[:3]))
        t = best.t + best.tangents @ step[3:]
        t = t / np.linalg.norm(t)
    if best is None:
        raise ValueError("iterations must be at least 1")
    return TwoViewFit(
        R_prev_cur=best.R_prev_cur,
        t=best.t,
        covariance=_covariance(pairs, best, sigma_px) if exact else best.covariance,
        tangents=best.tangents,
        errors=best.errors,
        cost=best.cost,
    )


def _covariance(pairs: Pairs, fit: TwoViewFit, sigma_px: float) -> Array:
    """(5, 5): inverse of the information at the fit, without the part that is only noise.

    What a point says about the direction grows with its parallax d, and noise lengthens d as well:
    E|d|² = |d_true|² + 4σ². Points whose parallax is within the noise say nothing about direction.
    """
    raw, slope, length = sampson(pairs, fit.R_prev_cur, fit.t)
    error = raw / (length * sigma_px)
    turned = pairs.cur @ fit.R_prev_cur.T
    shift = np.linalg.solve(pairs.slope_prev, (turned[:, :2] / turned[:, 2:] - pairs.prev[:, :2])[..., None])[..., 0]
    real = np.sqrt(np.clip(1.0 - 4.0 * sigma_px**2 / np.maximum(np.sum(shift * shift, axis=-1), 1e-12), 0.0, 1.0))
    jacobian = np.concatenate([slope[:, :3], (slope[:, 3:] @ fit.tangents) * real[:, None]], axis=-1)
    jacobian = jacobian / (length * sigma_px)[:, None]
    weighted = jacobian * cauchy_weights(error * error, _ROBUST)[:, None]
    covariance: Array = np.linalg.inv(weighted.T @ jacobian + 1e-9 * np.eye(5))
    return covariance


def _ahead(pairs: Pairs, R: Array, t: Array) -> float:
    """Share of the points, weighted by parallax, that lie before both cameras."""
    T_prev_views = np.stack([np.eye(4), np.eye(4)])
    T_prev_views[1, :3, :3], T_prev_views[1, :3, 3] = R, t
    prev = pairs.prev / np.linalg.norm(pairs.prev, axis=-1, keepdims=True)
    cur = pairs.cur / np.linalg.norm(pairs.cur, axis=-1, keepdims=True)
    _, depths = triangulate(T_prev_views, np.stack([prev, cur]))
    weight = np.linalg.norm(np.cross(prev, cur @ R.T), axis=-1)
    before = np.all(np.nan_to_num(depths, nan=1.0) > 0.0, axis=0)
    return float(np.sum(weight * before) / max(np.sum(weight), 1e-12))
