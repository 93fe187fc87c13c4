"""Points of the newest keyframe for telling where an old camera stood: the smoother's, and all others that are seen."""

from collections import deque
from dataclasses import dataclass

import numpy as np

from vioframe.checks import Array, Mask, Stamps
from vioframe.geometry import se3
from vioframe.geometry.triangulation import triangulate
from vioframe.types import Tracks
from vioframe_window.loop_interface import LoopKeyframe

# Keyframes that must have seen a point, sine of the angle between its rays, distance of its projections, range.
_MIN_VIEWS = 3
_MIN_PARALLAX = np.sin(np.radians(0.7))
_MAX_ERROR_PX = 2.5
_MIN_DEPTH_M, _MAX_DEPTH_M = 0.2, 60.0
_MIN_COSINE = 0.2


@dataclass(slots=True, kw_only=True, eq=False)
class _View:
    """A keyframe: pose (4, 4) as it is estimated now, place of the camera (4, 4), and its tracks."""

    stamp_ns: int
    T_world_body: Array
    T_body_cam: Array
    tracks: Tracks


class RecentPoints:
    """The last keyframes, and the points that they see together.

    A smoother holds some tens of points, to bound its cost; an old image shows them from elsewhere, so that few of
    them are found again. Tracks outside its window are triangulated here, from its poses.

    Args:
        keyframes: as many are held.
        focal_px: pixels a unit of normalised coordinates.
    """

    def __init__(self, *, keyframes: int, focal_px: float) -> None:
        self._views: deque[_View] = deque(maxlen=keyframes)
        self._focal_px = focal_px

    def forget(self) -> None:
        """Drop all keyframes: the poses to come do not fit them."""
        self._views.clear()

    def push(self, keyframe: LoopKeyframe, T_body_cam: Array) -> None:
        """Take the next keyframe."""
        self._views.append(
            _View(
                stamp_ns=keyframe.stamp_ns,
                T_world_body=keyframe.T_world_body,
                T_body_cam=T_body_cam,
                tracks=keyframe.tracks,
            )
        )

    def settle(self, stamps_ns: Stamps, T_world_body: Array) -> None:
        """Take better poses (N, 4, 4); unknown stamps pass."""
        better = dict(zip(stamps_ns.tolist(), T_world_body, strict=True))
        for held in self._views:
            held.T_world_body = better.get(held.stamp_ns, held.T_world_body)

    def seen_now(self, keyframe: LoopKeyframe) -> tuple[Stamps, Array]:
        """Ids (N,) and points (N, 3) m in the world of the newest keyframe's tracks; the smoother's come first."""
        held = np.isin(keyframe.landmark_ids, keyframe.tracks.ids)
        ids, points = keyframe.landmark_ids[held], keyframe.landmarks_world[held]
        more, more_points = self._triangulated(np.setdiff1d(keyframe.tracks.ids, ids))
        return np.concatenate([ids, more]), np.concatenate([points, more_points])

    def _triangulated(self, ids: Stamps) -> tuple[Stamps, Array]:
        bearings, seen = self._gather(ids)
        enough = seen.sum(axis=0) >= _MIN_VIEWS
        if not enough.any():
            return ids[:0], np.zeros((0, 3))
        ids, bearings, seen = ids[enough], bearings[:, enough], seen[:, enough]
        T_world_cam = np.array([view.T_world_body @ view.T_body_cam for view in self._views])
        # Around the newest camera: a triangulation far from the origin loses digits.
        origin = T_world_cam[-1, :3, 3].copy()
        T_world_cam[:, :3, 3] -= origin
        points, depths = triangulate(T_world_cam, bearings, seen.astype(float))
        good: Mask = np.asarray(np.isfinite(points).all(axis=1))
        points = np.where(good[:, None], points, 0.0)
        good &= ((depths > _MIN_DEPTH_M) & (depths < _MAX_DEPTH_M) | ~seen).all(axis=0)
        good &= self._errors_px(T_world_cam, points, bearings, seen).max(axis=0) < _MAX_ERROR_PX
        rays = bearings @ np.swapaxes(T_world_cam[:, :3, :3], 1, 2)
        parallax = np.where(seen, np.linalg.norm(np.cross(rays, rays[-1]), axis=2), 0.0).max(axis=0)
        good &= parallax > _MIN_PARALLAX
        return ids[good], points[good] + origin

    def _gather(self, ids: Stamps) -> tuple[Array, Mask]:
        """Bearings (V, N, 3) of sorted ids in each view, and where they were seen (V, N)."""
        bearings = np.zeros((len(self._views), len(ids), 3))
        seen = np.zeros((len(self._views), len(ids)), dtype=bool)
        if not len(ids):
            return bearings, seen
        for number, view in enumerate(self._views):
            column = np.minimum(np.searchsorted(ids, view.tracks.ids), len(ids) - 1)
            known = (ids[column] == view.tracks.ids) & (view.tracks.bearings[:, 2] > _MIN_COSINE)
            bearings[number, column[known]] = view.tracks.bearings[known]
            seen[number, column[known]] = True
        return bearings, seen

    def _errors_px(self, T_world_cam: Array, points: Array, bearings: Array, seen: Mask) -> Array:
        """Distance (V, N) between projections and observations; 0 where there is none."""
        local = se3.transform(se3.inverse(T_world_cam), np.broadcast_to(points, (len(T_world_cam), *points.shape)))
        projected = local[..., :2] / np.maximum(local[..., 2:], 1e-6)
        observed = bearings[..., :2] / np.maximum(bearings[..., 2:], _MIN_COSINE)
        errors: Array = self._focal_px * np.where(seen, np.linalg.norm(projected - observed, axis=2), 0.0)
        return errors
