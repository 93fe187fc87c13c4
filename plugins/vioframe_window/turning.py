"""The turn of a camera from points that show no parallax."""

import numpy as np

from vioframe.geometry import so3
from vioframe_window.keyframes import Turn, View

# Fewer points, or fewer of them in agreement, do not speak for the scene.
_FEWEST = 12
_SHARE = 0.6
# The wider of this and the points' own scatter is their uncertainty, rad; what parallax is left is in it.
_FLOOR = 5e-4


def find_turn(past: View, view: View, limit: float) -> Turn | None:
    """Turn the points of one view onto another.

    The rotation that brings most bearings together in the least-squares sense (Kabsch 1976), twice: first of all
    points, then of those that agree with it.

    Args:
        past: earlier view of camera 0.
        view: later view of camera 0.
        limit: rad, by which a point may be off.

    Returns:
        None where too few points are seen in both, or they have moved otherwise than by a turn.
    """
    rows, seen = view.find(past.ids)
    before, after = past.bearings[seen], view.bearings[rows[seen]]
    agrees = np.ones(len(before), dtype=bool)
    for _ in range(2):
        if agrees.sum() < max(_FEWEST, _SHARE * len(before)):
            return None
        u, _, vt = np.linalg.svd(before[agrees].T @ after[agrees])
        R_past_cam = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        off = np.linalg.norm(before - after @ R_past_cam.T, axis=1)
        agrees = off < limit
    if agrees.sum() < max(_FEWEST, _SHARE * len(before)):
        return None
    scatter = float(np.sqrt(np.mean(off[agrees] ** 2)))
    return Turn(R_past_cam=so3.normalise(R_past_cam), sigma=max(scatter, _FLOOR), agreeing=int(agrees.sum()))
