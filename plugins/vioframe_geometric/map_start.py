"""Beginning a local map: two views far enough apart, their motion, the first landmarks and keyframes."""

import numpy as np

from vioframe.checks import Array
from vioframe.geometry import se3
from vioframe.geometry.triangulation import triangulate
from vioframe.types import Tracks
from vioframe_geometric.epipolar import Pairs, fit_rotation, fit_two_view, pair, parallax_px
from vioframe_geometric.map_state import LocalMap, make_keyframe
from vioframe_geometric.rays import observe
from vioframe_geometric.tracking import INLIER, select_view
from vioframe_geometric.two_view import common_points

# A first map with a more uncertain direction of motion is not begun.
_MAX_DIRECTION = np.radians(6.0)
# Share of the common points that the two views must put before both cameras.
_MIN_AHEAD = 0.6
# Share of points that the oldest view kept must have in common with the present one.
_MIN_COMMON = 0.5
_MAX_EARLIER = 12
# Growth of the parallax since the last failure that is worth another fit.
_RETRY = 1.15
# Multiple of the least parallax at which waiting no longer tells the two motions of a plane apart.
_SETTLED = 3.0
# Share of the least parallax below which a view is too near the last one kept to be kept as well.
_STILL = 0.15


class MapStart:
    """Keeps views until the present one makes a map with the oldest.

    Args:
        parallax_px: upper quartile of the displacement beyond rotation at which a map is tried.
        points: fewest points of it.
        window: most keyframes it begins with.
        unit: its median depth.
    """

    def __init__(self, *, parallax_px: float, points: int, window: int, unit: float) -> None:
        self._parallax = parallax_px
        self._points = points
        self._window = window
        self._unit = unit
        self._earlier: list[Tracks] = []
        self._tried_px = 0.0

    def take(self, tracks: Tracks, into: LocalMap) -> bool:
        """Take the next view; fill the empty map ``into`` (True) once two views are far enough apart.

        The last keyframe is then this view. The map is not adjusted yet.
        """
        first = second = np.zeros(0, dtype=np.int64)
        while self._earlier:
            first, second = common_points(self._earlier[0], tracks)
            if len(first) >= max(self._points, _MIN_COMMON * min(len(self._earlier[0]), len(tracks))):
                break
            self._earlier.pop(0)
            self._tried_px = 0.0
        if self._earlier:
            pairs = pair(into.camera, self._earlier[0].bearings[first], tracks.bearings[second])
            parallax = float(np.percentile(parallax_px(pairs, fit_rotation(pairs), into.focal_px), 75.0))
            if parallax > max(self._parallax, _RETRY * self._tried_px):
                self._tried_px = parallax
                settled = parallax > _SETTLED * self._parallax
                T_map_cam = self._make_landmarks(into, pairs, first, tracks, second, settled=settled)
                if T_map_cam is not None:
                    self._make_keyframes(into, tracks, T_map_cam)
                    self._earlier = []
                    return True
            last, now = common_points(self._earlier[-1], tracks)
            moved = np.linalg.norm(self._earlier[-1].pixels[last] - tracks.pixels[now], axis=-1)
            if len(moved) and np.median(moved) < _STILL * self._parallax:
                return False
        self._earlier.append(tracks)
        if len(self._earlier) > _MAX_EARLIER:
            # The oldest stays: it has the longest baseline.
            del self._earlier[1]
        return False

    def _make_landmarks(
        self, into: LocalMap, pairs: Pairs, first: np.ndarray, tracks: Tracks, second: np.ndarray, *, settled: bool
    ) -> Array | None:
        """Make landmarks from the oldest view kept and this one, if their motion is certain.

        Args:
            into: the map.
            pairs: the points seen in both.
            first, second: their rows in either.
            tracks: this view.
            settled: take the likelier of two motions that a single plane allows; waiting longer would not help.

        Returns:
            T_map_cam (4, 4) of this view, the oldest being the origin; None where no map was made.
        """
        sigma = into.noise.sigma_px
        fit = fit_two_view(pairs, focal_px=into.focal_px, sigma_px=sigma, threshold_px=2.0 * sigma)
        # A rotation, or points on one plane, leave the direction open.
        if fit is None or (fit.ambiguous and not settled):
            return None
        if np.linalg.eigvalsh(fit.covariance[3:, 3:])[-1] > _MAX_DIRECTION**2:
            return None
        earlier = self._earlier[0]
        T_map_cam = se3.from_parts(fit.R_prev_cur, fit.t)
        rays = np.stack([earlier.bearings[first], tracks.bearings[second]])
        _, depths = triangulate(np.stack([np.eye(4), T_map_cam]), rays)
        good = (fit.errors < INLIER) & (np.nan_to_num(depths, nan=-1.0) > 0.0).all(axis=0)
        if good.sum() < max(self._points, _MIN_AHEAD * len(first)):
            return None
        scale = self._unit / float(np.median(depths[0][good]))
        T_map_cam[:3, 3] *= scale
        rows = np.flatnonzero(good)
        ids = tracks.ids[second[rows]]
        seen_before = observe(into.camera, earlier.bearings[first[rows]])
        into.add(ids, np.eye(4), seen_before, 1.0 / (scale * depths[0][rows]), 1.0 / self._unit)
        index, _ = into.landmarks.find(ids)
        into.landmarks.update(index, T_map_cam, [select_view(into.view(tracks), second[rows])], sigma_px=sigma)
        return T_map_cam

    def _make_keyframes(self, into: LocalMap, tracks: Tracks, T_map_cam: Array) -> None:
        """Make keyframes of the first view, of some between, and of this one."""
        located: list[tuple[Tracks, Array]] = [(self._earlier[0], np.eye(4))]
        spaced = np.unique(np.linspace(1, len(self._earlier) - 1, self._window - 2).astype(int))
        for k in spaced[(spaced > 0) & (spaced < len(self._earlier))]:
            fix = into.locate(self._earlier[k], [T_map_cam, np.eye(4)])
            if fix is not None:
                located.append((self._earlier[k], fix.T_map_cam))
        located.append((tracks, T_map_cam))
        into.keyframes = [make_keyframe(view, into.view(view).rays, pose) for view, pose in located]
