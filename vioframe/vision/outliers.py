"""Points whose motion contradicts that of the rest."""

import cv2
import numpy as np

from vioframe.checks import Array

_HYPOTHESES = 40
# A gyro whose bias is not yet known turns the rays too far; then the five-point solution judges instead.
_TRUSTED_SHARE = 0.7
_CONFIDENCE = 0.999
_MAX_ITERATIONS = 200


def epipolar_inliers(
    bearings_prev: Array, bearings_cur: Array, R_prev_cur: Array | None, threshold: float, *, seed: int
) -> np.ndarray:
    """Mark the points (M,) that lie near their epipolar planes.

    Args:
        bearings_prev: (M, 3) unit vectors in the camera before, M of at least 5.
        bearings_cur: (M, 3) in the camera now.
        R_prev_cur: (3, 3) rotation of the camera by the gyro, or None.
        threshold: angle in rad (pixels over the focal length).
        seed: of the hypotheses.
    """
    if R_prev_cur is not None:
        inliers = _two_point(bearings_prev @ R_prev_cur, bearings_cur, threshold, np.random.default_rng(seed))
        if inliers.mean() >= _TRUSTED_SHARE:
            return inliers
    return _five_point(bearings_prev, bearings_cur, threshold)


def _two_point(turned: Array, current: Array, threshold: float, random: np.random.Generator) -> np.ndarray:
    """With the rotation known, two points give the direction of translation: t ∝ (a₁ × b₁) × (a₂ × b₂)."""
    still: np.ndarray = np.linalg.norm(turned - current, axis=-1) < threshold
    if still.mean() > 0.95:
        # Nothing but rotation: any direction of translation fits what does not move.
        return still
    normals = np.cross(turned, current)
    pairs = random.integers(0, len(turned), size=(_HYPOTHESES, 2))
    directions = np.cross(normals[pairs[:, 0]], normals[pairs[:, 1]])
    length = np.linalg.norm(directions, axis=-1)
    directions = directions[length > 1e-12] / length[length > 1e-12, None]
    if len(directions) == 0:
        return still
    # The angle of b from the plane of t and a; that plane is undefined where a points along t.
    volume = np.abs(normals @ directions.T)
    plane = np.linalg.norm(np.cross(turned[:, None], directions[None]), axis=-1)
    near = volume < threshold * np.maximum(plane, 1e-3)
    best: np.ndarray = near[:, int(np.argmax(near.sum(axis=0)))] | still
    return best


def _five_point(previous: Array, current: Array, threshold: float) -> np.ndarray:
    """USAC's five-point essential matrix on the plane at depth 1, for rays well in front of both cameras."""
    ahead = (previous[:, 2] > 0.1) & (current[:, 2] > 0.1)
    keep = np.ones(len(previous), dtype=bool)
    if ahead.sum() < 8:
        return keep
    a = previous[ahead, :2] / previous[ahead, 2:]
    b = current[ahead, :2] / current[ahead, 2:]
    essential, mask = cv2.findEssentialMat(
        a, b, np.eye(3), method=cv2.USAC_FAST, prob=_CONFIDENCE, threshold=threshold, maxIters=_MAX_ITERATIONS
    )
    if essential is None or mask is None:
        return keep
    keep[ahead] = mask.ravel() > 0
    return keep
