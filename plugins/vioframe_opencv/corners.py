"""Detectors without descriptors: Shi-Tomasi's corners and FAST's."""

import cv2
import numpy as np

from vioframe.checks import check_not_negative, check_positive
from vioframe.types import Image
from vioframe.vision.corners import refine_peaks
from vioframe.vision.keypoints import Keypoints
from vioframe.vision.suppression import strongest

_NO_DESCRIPTORS = 0
_BLOCK = 3


class ShiTomasiExtractor:
    """Maxima of the smaller eigenvalue of the gradients' second moments (Shi and Tomasi 1994).

    Args:
        count: most points, the strongest.
        suppression_px: half side of the square in which a point gives way to a stronger one.
        subpixel: place a point at the maximum of a parabola, not at a whole pixel.
    """

    def __init__(self, *, count: int, suppression_px: int, subpixel: bool) -> None:
        check_positive("feature", count=count)
        check_not_negative("feature", suppression_px=suppression_px)
        self._count = count
        self._suppression = suppression_px
        self._subpixel = subpixel

    def extract(self, gray: Image, allowed: np.ndarray) -> Keypoints:
        """The strongest corners where ``allowed`` is not 0; scores are eigenvalues."""
        strength = cv2.cornerMinEigenVal(gray, _BLOCK, ksize=3)
        peaks = (strength >= cv2.dilate(strength, np.ones((3, 3), np.uint8))) & (strength > 0.0) & (allowed > 0)
        rows, columns = np.nonzero(peaks)
        peaks_px = np.stack([columns, rows], axis=-1)
        pixels = peaks_px.astype(float)
        scores = strength[rows, columns].astype(float)
        kept = strongest(pixels, scores, radius_px=self._suppression, count=self._count)
        places = refine_peaks(strength, peaks_px[kept]) if self._subpixel else pixels[kept]
        return _bare(places, scores[kept])


class FastExtractor:
    """Corners by the segment test on a circle of 16 pixels (Rosten and Drummond 2006), at whole pixels.

    Args:
        count: most points, the strongest.
        suppression_px: half side of the square in which a point gives way to a stronger one.
        threshold: least difference from the centre of 9 pixels of the circle in a row, grey levels.
    """

    def __init__(self, *, count: int, suppression_px: int, threshold: int) -> None:
        check_positive("feature", count=count, threshold=threshold)
        check_not_negative("feature", suppression_px=suppression_px)
        self._count = count
        self._suppression = suppression_px
        self._detector = cv2.FastFeatureDetector.create(threshold=threshold, nonmaxSuppression=True)

    def extract(self, gray: Image, allowed: np.ndarray) -> Keypoints:
        """The strongest corners where ``allowed`` is not 0; scores are the largest thresholds they would pass."""
        found = self._detector.detect(gray, allowed)
        pixels = np.array([point.pt for point in found]).reshape(-1, 2)
        scores = np.array([point.response for point in found])
        kept = strongest(pixels, scores, radius_px=self._suppression, count=self._count)
        return _bare(pixels[kept], scores[kept])


def _bare(pixels: np.ndarray, scores: np.ndarray) -> Keypoints:
    return Keypoints(pixels=pixels, scores=scores, descriptors=np.zeros((len(pixels), _NO_DESCRIPTORS), np.float32))
