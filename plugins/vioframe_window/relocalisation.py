"""What the smoother tells a loop closer, and what it makes of the answer."""

from dataclasses import replace

import numpy as np

from vioframe.checks import Array
from vioframe.geometry import se3
from vioframe.types import Image, NavState, Tracks
from vioframe.vision.keypoints import Keypoints
from vioframe_window.loop_interface import LoopCloser, LoopKeyframe
from vioframe_window.smoother import Smoother


class Relocalisation:
    """Gives keyframes to a loop closer, takes what it recognises into the window, and reads back how that settles.

    Args:
        closer: recognises places.
        smoother: the window.
    """

    def __init__(self, closer: LoopCloser, smoother: Smoother) -> None:
        self._closer = closer
        self._smoother = smoother
        self._open: dict[int, int] = {}

    def interrupt(self) -> None:
        """The window began anew."""
        self._open.clear()
        self._closer.interrupt()

    def take_keyframe(self, image: Image, tracks: Tracks, untracked: Keypoints | None) -> None:
        """Hand over the newest keyframe, and what the window now thinks of those before.

        Args:
            image: of camera 0 at the newest keyframe.
            tracks: of the same.
            untracked: described points of the same beside them, or None.
        """
        smoother = self._smoother
        by_stamp = {keyframe.stamp_ns: keyframe.T_world_body for keyframe in smoother.keyframes}
        self._closer.settle(np.array(list(by_stamp), dtype=np.int64), np.array(list(by_stamp.values())))
        T_cam_body = se3.inverse(smoother.T_body_cam)
        for match_id, stamp_ns in list(self._open.items()):
            T_world_cam = smoother.loop_cameras.get(match_id)
            if T_world_cam is None or stamp_ns not in by_stamp:
                del self._open[match_id]
                continue
            self._closer.refine(match_id, T_world_cam @ T_cam_body, by_stamp[stamp_ns])
        match = self._closer.add_keyframe(
            LoopKeyframe(
                stamp_ns=smoother.newest.stamp_ns,
                T_world_body=smoother.newest.T_world_body,
                image=image,
                tracks=tracks,
                untracked=untracked,
                landmark_ids=smoother.point_ids,
                landmarks_world=smoother.points_world,
                T_body_cam=smoother.T_body_cam,
            )
        )
        if match is None:
            return
        points = match.bearings[:, :2] / match.bearings[:, 2:]
        T_world_cam = match.T_world_loop @ smoother.T_body_cam
        if smoother.see_again(match.match_id, T_world_cam, match.landmark_ids, points):
            self._open[match.match_id] = match.stamp_ns


def in_map(state: NavState, T_map_world: Array) -> NavState:
    """A state of the odometry frame, brought into the map: position, velocity and their covariance turn."""
    R = T_map_world[:3, :3]
    covariance = state.covariance
    if covariance is not None:
        turned = np.eye(15)
        turned[3:6, 3:6] = turned[6:9, 6:9] = R
        covariance = turned @ covariance @ turned.T
    return replace(
        state,
        T_world_body=T_map_world @ state.T_world_body,
        v_world_body=R @ state.v_world_body,
        covariance=covariance,
    )
