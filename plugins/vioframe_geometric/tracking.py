"""Finding the rig in a map of landmarks, one image after the other: what ``local_map`` and ``stereo`` share."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from vioframe.checks import Array, Stamps
from vioframe.geometry import se3
from vioframe_geometric.landmarks import Landmarks
from vioframe_geometric.pose import PoseFit, View, fit_pose

INLIER = 3.0
# A pose that less than this share of the points agrees with is not believed.
MIN_SHARE = 0.5
# Median of √(χ²/2) with two degrees of freedom: √(ln 2).
_MEDIAN_ERROR = float(np.sqrt(np.log(2.0)))
_LEARN_RATE = 0.1
_MIN_LEARN = 20


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fix:
    """The rig found in the map.

    Attributes:
        T_map_cam: (4, 4) of camera 0.
        covariance: (6, 6), right perturbation (rotation, translation).
        index: (M,) of the landmarks seen.
        rows: (M,) of their observations.
        errors: (M,) normalised.
        inliers: number of errors below 3.
    """

    T_map_cam: Array
    covariance: Array
    index: np.ndarray
    rows: np.ndarray
    errors: Array
    inliers: int


def select_view(view: View, rows: np.ndarray) -> View:
    """Some rows of a view."""
    return View(rays=view.rays.select(rows), seen=view.seen[rows])


def locate(
    landmarks: Landmarks,
    ids: Stamps,
    views: Sequence[View],
    starts: Sequence[Array],
    *,
    sigma_px: float,
    min_inliers: int,
) -> Fix | None:
    """Fit the pose to the landmarks among ``ids``, or None where too few agree.

    Args:
        landmarks: the map.
        ids: (M,) of the observations.
        views: M rays in each camera; the first is camera 0.
        starts: poses to start from, the likeliest first; the next is tried when the last was not convincing,
            and a P3P inside USAC in the end.
        sigma_px: of a pixel coordinate.
        min_inliers: that must agree.
    """
    index, known = landmarks.find(ids)
    rows = np.flatnonzero(known)
    if len(rows) < min_inliers:
        return None
    index = index[rows]
    points = landmarks.points(index)
    root = landmarks.point_root(index)
    seen = [select_view(view, rows) for view in views]

    def fit(start: Array) -> PoseFit:
        return fit_pose(start, points, seen, sigma_px=sigma_px, point_root=root)

    best: PoseFit | None = None
    for start in starts:
        found = fit(start)
        if best is None or found.cost < best.cost:
            best = found
        if _convincing(best, min_inliers):
            break
    else:
        start_pnp = _solve_pnp(points, root, seen[0], sigma_px)
        if start_pnp is not None:
            found = fit(start_pnp)
            if best is None or found.cost < best.cost:
                best = found
    if best is None or not _convincing(best, min_inliers):
        return None
    information = best.information
    if not np.isfinite(information).all() or np.linalg.cond(information) > 1e14:
        return None
    return Fix(
        T_map_cam=best.T_ref_cam,
        covariance=np.linalg.inv(information),
        index=index,
        rows=rows,
        errors=best.errors,
        inliers=int((best.errors < INLIER).sum()),
    )


def _convincing(fit: PoseFit, min_inliers: int) -> bool:
    agreeing = int((fit.errors < INLIER).sum())
    return agreeing >= min_inliers and agreeing >= MIN_SHARE * len(fit.errors)


def _solve_pnp(points: Array, root: Array, view: View, sigma_px: float) -> Array | None:
    """A rough T_map_cam (4, 4) from the better-known half of the points."""
    depth_spread = np.sum(root * root, axis=(1, 2))
    rows = np.flatnonzero(view.seen & (depth_spread <= np.median(depth_spread)))
    if len(rows) < 6:
        return None
    axes = view.rays.axes[rows]
    ideal = axes[:, :2] / axes[:, 2:]
    focal = float(np.median(np.linalg.norm(view.rays.rows[rows, 0], axis=-1)))
    centre = points[rows].mean(axis=0)
    found, turn, shift, _ = cv2.solvePnPRansac(
        np.ascontiguousarray(points[rows] - centre),
        np.ascontiguousarray(ideal),
        np.eye(3),
        None,
        iterationsCount=200,
        reprojectionError=4.0 * sigma_px / focal,
        confidence=0.999,
        flags=cv2.SOLVEPNP_P3P,
    )
    if not found:
        return None
    R_cam_map, _ = cv2.Rodrigues(turn)
    T_map_cam = se3.inverse(se3.from_parts(R_cam_map, shift[:, 0]))
    T_map_cam[:3, 3] += centre
    return T_map_cam if np.isfinite(T_map_cam).all() else None


class PixelNoise:
    """Running estimate of the standard deviation of a pixel coordinate, from the errors of located images.

    Args:
        sigma_px: where it starts.
        smallest_px, largest_px: its bounds.
    """

    def __init__(self, sigma_px: float, smallest_px: float = 0.1, largest_px: float = 2.0) -> None:
        self._bounds = (min(smallest_px, sigma_px), max(largest_px, sigma_px))
        self.sigma_px = sigma_px

    def learn(self, errors: Array) -> None:
        """Take the errors (M,) a degree of freedom of one image, normalised with the present estimate."""
        if len(errors) < _MIN_LEARN:
            return
        ratio = float(np.median(errors)) / _MEDIAN_ERROR
        # Slow, and limited a step, so that a few bad images change little.
        change = np.clip(ratio, 0.5, 2.0) ** _LEARN_RATE
        self.sigma_px = float(np.clip(self.sigma_px * change, *self._bounds))


def relative_covariance(covariance_prev: Array, covariance_cur: Array, T_prev_cur: Array) -> Array:
    """(6, 6) of ``T_prev⁻¹ T_cur`` for independent right perturbations of both."""
    back = se3.adjoint(se3.inverse(T_prev_cur))
    total: Array = covariance_cur + back @ covariance_prev @ back.T
    return 0.5 * (total + total.T)
