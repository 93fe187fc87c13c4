"""Points of the newest keyframe for telling where an old camera stood: the smoother's, and all others that are seen."""

from collections import deque
from dataclasses import dataclass

import numpy as np

from vioframe.checks import Array, Stamps
from vioframe_window.keyframes import View
from vioframe_window.loop_interface import LoopKeyframe
from vioframe_window.options import LandmarkOptions
from vioframe_window.triangulation import find_new_points

_GATES = LandmarkOptions(min_views=3, min_parallax_deg=0.7, max_error_px=2.5)
_NO_LIMIT = 10_000


@dataclass(slots=True, kw_only=True, eq=False)
class _View:
    stamp_ns: int
    T_world_body: Array
    T_body_cam: Array
    view: View


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
                view=View.of(keyframe.tracks),
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
        newest = self._views[-1].view.ids
        others = newest[~np.isin(newest, ids)]
        T_world_cam = np.array([view.T_world_body @ view.T_body_cam for view in self._views])
        # Around the newest camera: a triangulation far from the origin loses digits.
        origin = T_world_cam[-1, :3, 3].copy()
        T_world_cam[:, :3, 3] -= origin
        found = find_new_points(
            T_world_cam,
            [view.view for view in self._views],
            others,
            _GATES,
            most=_NO_LIMIT,
            focal_px=self._focal_px,
            slack=1.0,
        )
        return np.concatenate([ids, found.ids]), np.concatenate([points, found.points_world + origin])
