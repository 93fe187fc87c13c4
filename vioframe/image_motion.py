"""How far the images move: what a camera knows of rest that an inertial sensor cannot."""

from collections import deque

import numpy as np

from vioframe.checks import Array
from vioframe.conventions import NANOSECONDS
from vioframe.types import Tracks, VisualFeatures

# Fewer points in common say nothing of the scene as a whole.
_FEWEST = 10


class ImageMotion:
    """Measures the angle by which points have moved over the last ``duration_s``.

    Over a stretch, since a steady motion adds up, whatever the frame rate, while idling motors only shake. The
    median, so that what moves by itself before a camera at rest does not count while it covers less than half.

    Args:
        duration_s: length of the stretch, s.
    """

    def __init__(self, duration_s: float) -> None:
        self._duration_ns = round(duration_s * NANOSECONDS)
        self._past: deque[tuple[int, Tracks]] = deque()

    def push(self, features: VisualFeatures | None) -> tuple[float, float] | None:
        """Take the next frame's features.

        Returns:
            Median angle, degrees, and the seconds in which the points moved by it: since the oldest frame of the
            stretch that has points enough in common with this one. None where vision says nothing.
        """
        if features is None or features.tracks is None:
            return None
        stamp_ns, tracks = features.frame.stamp_ns, features.tracks
        while self._past and self._past[0][0] < stamp_ns - self._duration_ns:
            self._past.popleft()
        moved = None
        for before_ns, before in self._past:
            _, old, new = np.intersect1d(before.ids, tracks.ids, assume_unique=True, return_indices=True)
            if len(old) >= _FEWEST:
                angles = _angles(before.bearings[old], tracks.bearings[new])
                moved = float(np.degrees(np.median(angles))), (stamp_ns - before_ns) / NANOSECONDS
                break
        self._past.append((stamp_ns, tracks))
        return moved


def _angles(a: Array, b: Array) -> Array:
    """Angles (N,) rad between unit vectors (N, 3); exact for small ones, unlike the arc cosine."""
    angles: Array = np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.einsum("ni,ni->n", a, b))
    return angles
