"""Shi-Tomasi corners, spread over the image and away from points already followed."""

import cv2
import numpy as np

from vioframe.checks import Array
from vioframe.vision.spread import choose_spread

# OpenCV's cornerMinEigenVal (3×3 Sobel, image in [0, 1]) returns four times the smaller eigenvalue of the mean
# of ∇I∇Iᵀ over the block, measured against finite differences.
_EIGENVALUE_UNIT = 4.0
_BLOCK = 3


class CornerDetector:
    """Finds new corners.

    Args:
        min_distance_px: between any two points.
        quality: fraction of the strongest corner's eigenvalue.
        min_gradient: square root of the smaller eigenvalue, grey levels a pixel.
        scale: 1, or 2 to look in the half-size image.
        allowed: (H, W) uint8, zero where no corner may be taken.
    """

    def __init__(
        self, *, min_distance_px: float, quality: float, min_gradient: float, scale: int, allowed: np.ndarray
    ) -> None:
        self._distance = min_distance_px / scale
        self._quality = quality
        self._floor = (min_gradient / 255.0) ** 2
        self._scale = scale
        self._allowed = allowed[::scale, ::scale] > 0

    def detect(self, gray: np.ndarray, taken: Array, count: int) -> tuple[Array, Array]:
        """Return up to ``count`` corners (K, 2) px, away from the points ``taken`` (M, 2) px, and their strengths (K,).

        Args:
            gray: (H, W) uint8.
            taken: points already followed.
            count: of corners wanted.
        """
        scale = self._scale
        small = gray if scale == 1 else cv2.resize(gray, self._allowed.shape[::-1], interpolation=cv2.INTER_AREA)
        strength = cv2.cornerMinEigenVal(small, _BLOCK, ksize=3)
        # The gradient of the half-size image is twice as steep a pixel.
        strength *= np.float32(1.0 / (_EIGENVALUE_UNIT * scale**2))
        peak = float(strength.max())
        local_maximum = strength >= cv2.dilate(strength, np.ones((3, 3), np.uint8))
        free = self._free_space(taken / scale)
        candidates = local_maximum & free & (strength > max(self._quality * peak, self._floor))
        rows, columns = np.nonzero(candidates)
        if len(rows) == 0 or count <= 0:
            return np.zeros((0, 2)), np.zeros(0)
        points = np.stack([columns, rows], axis=-1)
        height, width = strength.shape
        chosen = choose_spread(
            points,
            strength[rows, columns],
            taken / scale,
            size_px=(width, height),
            distance=self._distance,
            count=count,
        )
        points = points[chosen]
        refined = refine_peaks(strength, points)
        # The centre of pixel x of the half-size image lies at 2x + 0.5 of the full one.
        return refined * scale + 0.5 * (scale - 1), strength[points[:, 1], points[:, 0]].astype(float)

    def _free_space(self, taken: Array) -> np.ndarray:
        if len(taken) == 0:
            return self._allowed
        height, width = self._allowed.shape
        marks = np.full((height, width), 255, np.uint8)
        column = np.clip(np.rint(taken[:, 0]).astype(int), 0, width - 1)
        row = np.clip(np.rint(taken[:, 1]).astype(int), 0, height - 1)
        marks[row, column] = 0
        free: np.ndarray = self._allowed & (cv2.distanceTransform(marks, cv2.DIST_L2, 3) >= self._distance)
        return free


def refine_peaks(strength: np.ndarray, points: np.ndarray) -> Array:
    """Sub-pixel maximum (K, 2) of a parabola through ``strength`` (H, W) at each pixel (K, 2) and its neighbours."""
    height, width = strength.shape
    column = np.clip(points[:, 0], 1, width - 2)
    row = np.clip(points[:, 1], 1, height - 2)
    centre = strength[row, column].astype(float)

    def shift(before: np.ndarray, after: np.ndarray) -> Array:
        curvature = before + after - 2.0 * centre
        flat = curvature > -1e-12
        step = 0.5 * (before - after) / np.where(flat, -1.0, curvature)
        return np.where(flat, 0.0, np.clip(step, -0.5, 0.5))

    x = column + shift(strength[row, column - 1].astype(float), strength[row, column + 1].astype(float))
    y = row + shift(strength[row - 1, column].astype(float), strength[row + 1, column].astype(float))
    return np.stack([x, y], axis=-1)


def place_corners(gray: np.ndarray, pixels: Array, half_side: int) -> Array:
    """Corners (M, 2) px moved to where the gradients around them meet; one that would leave its window stays.

    Args:
        gray: (H, W) uint8.
        pixels: (M, 2) px.
        half_side: of the window, px; 0 moves nothing.
    """
    if half_side == 0 or len(pixels) == 0:
        return pixels
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 10, 0.01)
    start = np.ascontiguousarray(pixels, np.float32)
    placed = cv2.cornerSubPix(gray, start, (half_side, half_side), (-1, -1), criteria).reshape(-1, 2)
    near = np.linalg.norm(placed - pixels, axis=-1) < half_side
    refined: Array = np.where(near[:, None], placed, pixels).astype(float)
    return refined
