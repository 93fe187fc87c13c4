"""Whether two keyframes see the same place: points of one, found in the other, must give one rigid pose."""

from dataclasses import dataclass

import cv2
import numpy as np

from vioframe.checks import Array
from vioframe.geometry import se3, so3
from vioframe_window.loop_appearance import Appearance
from vioframe_window.loop_options import Verification
from vioframe_window.loop_vocabulary import as_lanes, hamming

# Rays further off the axis have no place on the image plane.
_MIN_COSINE = 0.2
_CONFIDENCE = 0.999
_FEWEST_FOR_POSE = 6
_REFINE_ROUNDS = 2
# A corner is never known better than this.
_NOISE_PX = 0.7


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Found:
    """The other camera, located by points.

    Attributes:
        T_points_cam: (4, 4) pose of the other camera in the frame of the points.
        points: (N,) rows of the points that agree, and corners: (N,) rows of the other's corners they were found at.
        sigma_m, sigma_rad: standard deviation of the pose, an axis, as far as the corners' scatter tells.
    """

    T_points_cam: Array
    points: np.ndarray
    corners: np.ndarray
    sigma_m: float
    sigma_rad: float


def locate(
    points: Array, descriptors: np.ndarray, other: Appearance, focal_px: float, options: Verification, seed: int
) -> Found | None:
    """Find the camera that took ``other`` among points, or None where too few agree.

    Args:
        points: (L, 3) m.
        descriptors: (L, 32) of the points.
        other: corners of the other image.
        focal_px: pixels a unit of normalised coordinates.
        options: gates.
        seed: of the random samples.
    """
    ahead = np.flatnonzero(other.bearings[:, 2] > _MIN_COSINE)
    if len(points) < options.min_matches or len(ahead) < options.min_matches:
        return None
    distance = hamming(as_lanes(descriptors)[:, None], as_lanes(other.descriptors[ahead])[None])
    rows, columns = _mutual(distance, options.sure_distance)
    if len(rows) < max(options.sure_share * options.min_matches, _FEWEST_FOR_POSE):
        return None
    image = focal_px * other.bearings[ahead, :2] / other.bearings[ahead, 2:]
    T_cam_points = _pose_by_samples(points[rows], image[columns], focal_px, options, seed)
    if T_cam_points is None:
        return None
    # With a pose at hand, a point's corner is looked for near its projection only: more of them, and sounder.
    for _ in range(_REFINE_ROUNDS):
        apart, depth = _errors(T_cam_points, points, image, focal_px)
        near = np.where((apart < options.search_px) & (depth[:, None] > 0.0), distance, 8 * descriptors.shape[1] + 1)
        rows, columns = _mutual(near, options.max_distance)
        if len(rows) < _FEWEST_FOR_POSE:
            return None
        good = apart[rows, columns] < 2.0 * options.inlier_px
        if good.sum() < _FEWEST_FOR_POSE:
            return None
        T_cam_points = _refined(T_cam_points, points[rows[good]], image[columns[good]], focal_px)
    apart, depth = _errors(T_cam_points, points, image, focal_px)
    agree = (apart[rows, columns] < options.inlier_px) & (depth[rows] > 0.0)
    if agree.sum() < options.min_matches:
        return None
    rows, columns = rows[agree], columns[agree]
    sigma_rad, sigma_m = _sigmas(se3.transform(T_cam_points, points[rows]), apart[rows, columns], focal_px)
    return Found(
        T_points_cam=se3.inverse(T_cam_points),
        points=rows,
        corners=ahead[columns],
        sigma_m=sigma_m,
        sigma_rad=sigma_rad,
    )


def _mutual(distance: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of pairs that are each other's nearest, near enough."""
    best = distance.argmin(axis=1)
    rows = np.arange(len(distance))
    mutual = distance.argmin(axis=0)[best] == rows
    close = distance[rows, best] <= most
    chosen = np.flatnonzero(mutual & close)
    return chosen, best[chosen]


def _errors(T_cam_points: Array, points: Array, image: Array, focal_px: float) -> tuple[Array, Array]:
    """Distance (L, C) px of every corner from every point's projection, and the points' depth (L,)."""
    seen = se3.transform(T_cam_points, points)
    depth = seen[:, 2]
    projected = focal_px * seen[:, :2] / np.where(np.abs(depth) < 1e-6, 1e-6, depth)[:, None]
    return np.linalg.norm(projected[:, None] - image[None], axis=2), depth


def _sigmas(seen: Array, errors_px: Array, focal_px: float) -> tuple[float, float]:
    """Standard deviations, rad and m an axis, of a camera that sees points (N, 3) at these distances (N,) px."""
    x, y, depth = seen.T
    zero = np.zeros_like(depth)
    by_point = (focal_px / depth)[:, None, None] * np.stack(
        [np.stack([zero + 1.0, zero, -x / depth], axis=1), np.stack([zero, zero + 1.0, -y / depth], axis=1)], axis=1
    )
    # A turn of the camera about itself moves a point by −[q]×, a step by the step.
    jacobian = np.concatenate([-by_point @ so3.hat(seen), by_point], axis=2).reshape(-1, 6)
    noise_px = max(float(np.sqrt(0.5 * np.mean(errors_px**2))), _NOISE_PX)
    covariance = noise_px**2 * np.linalg.pinv(jacobian.T @ jacobian, hermitian=True)
    spread = np.sqrt(np.diag(covariance).reshape(2, 3).mean(axis=1))
    return float(spread[0]), float(spread[1])


def _pose_by_samples(points: Array, image: Array, focal_px: float, options: Verification, seed: int) -> Array | None:
    K = np.diag([focal_px, focal_px, 1.0])
    cv2.setRNGSeed(seed)
    found, rotation, translation, _ = cv2.solvePnPRansac(
        points,
        image,
        K,
        None,
        iterationsCount=options.samples,
        reprojectionError=options.inlier_px,
        confidence=_CONFIDENCE,
        flags=cv2.SOLVEPNP_AP3P,
    )[:4]
    if not found or rotation is None or not np.isfinite(rotation).all() or not np.isfinite(translation).all():
        return None
    return se3.from_parts(so3.exp(rotation[:, 0]), translation[:, 0])


def _refined(T_cam_points: Array, points: Array, image: Array, focal_px: float) -> Array:
    K = np.diag([focal_px, focal_px, 1.0])
    rotation, translation = cv2.solvePnPRefineLM(
        points,
        image,
        K,
        None,
        so3.log(T_cam_points[:3, :3]).reshape(3, 1).copy(),
        T_cam_points[:3, 3].reshape(3, 1).copy(),
    )
    return se3.from_parts(so3.exp(rotation[:, 0]), translation[:, 0])
