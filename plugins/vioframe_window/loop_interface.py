"""What a fixed-lag smoother and a loop closer say to each other.

Two frames: ``world`` is the smoother's own odometry frame, which drifts and never jumps; ``map`` is the frame in
which places are consistent. They differ by a yaw and a translation, because gravity is known in both. Without
a loaded map the two begin as one.

The smoother's side, once a keyframe::

    match = loop.add_keyframe(keyframe)        # poses in ``world``
    if match is not None:                      # relocalisation into the window, optional:
        ...                                    # a pose for the old camera starting at match.T_world_loop, projection
                                               # factors of match.landmark_ids seen at match.bearings from there
        loop.refine(match.match_id, T_world_loop, T_world_body)   # both as re-estimated, as often as it likes
    loop.settle(stamps_ns, T_world_body)       # keyframes whose estimate has moved since they were added

States are given out as ``loop.T_map_world @ T_world_body`` (velocities and covariances turn with it), and the final
trajectory is ``loop.correct(causal trajectory in world)``.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass

from vioframe.checks import Array, Stamps
from vioframe.types import Image, SensorRig, Tracks, Trajectory
from vioframe.vision.keypoints import Keypoints


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopKeyframe:
    """One keyframe of the smoother, as it is estimated now.

    Attributes:
        stamp_ns: IMU clock; increases from keyframe to keyframe.
        T_world_body: (4, 4) in the odometry frame.
        image: (H, W) or (H, W, 3) of camera 0.
        tracks: points of camera 0 in this image, descriptors included where the front end has them.
        landmark_ids: (L,) track ids of the points that the smoother holds in three dimensions; those that are not
            among ``tracks.ids`` are not used.
        landmarks_world: (L, 3) m, the same points in the odometry frame.
        T_body_cam: (4, 4) of camera 0 as estimated, or None for the rig's.
        untracked: points of the image beside the tracks, of the same kind of descriptors, or None.
    """

    stamp_ns: int
    T_world_body: Array
    image: Image
    tracks: Tracks
    landmark_ids: Stamps
    landmarks_world: Array
    T_body_cam: Array | None = None
    untracked: Keypoints | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopMatch:
    """An old keyframe that sees the same place as the newest one, geometrically verified.

    Attributes:
        match_id: names this match to :meth:`LoopCloser.refine`.
        stamp_ns: of the newest keyframe.
        loop_stamp_ns: of the old keyframe; of a loaded map, the stamp it had there.
        T_world_loop: (4, 4) body of the old keyframe in the *present* odometry frame, as the newest keyframe sees it.
        landmark_ids: (N,) landmarks of the newest keyframe that were found in the old image.
        pixels: (N, 2) px where they were found in the old image of camera 0, raw (distorted).
        bearings: (N, 3) unit vectors of those pixels in the old camera 0.
    """

    match_id: int
    stamp_ns: int
    loop_stamp_ns: int
    T_world_loop: Array
    landmark_ids: Stamps
    pixels: Array
    bearings: Array


class LoopCloser(ABC):
    """Recognises places seen before and keeps the keyframes' trajectory consistent with that."""

    @abstractmethod
    def setup(self, rig: SensorRig) -> None:
        """Forget the last sequence and take the next one's calibration; load the map to start in, if any.

        Raises:
            DataError: the map cannot be read, or is of another rig.
        """

    @abstractmethod
    def add_keyframe(self, keyframe: LoopKeyframe) -> LoopMatch | None:
        """Take the next keyframe; a match, if it sees a known place, is already part of the correction."""

    @abstractmethod
    def settle(self, stamps_ns: Stamps, T_world_body: Array) -> None:
        """Take better estimates (N, 4, 4), in the odometry frame, of keyframes added before; unknown stamps pass."""

    @abstractmethod
    def refine(self, match_id: int, T_world_loop: Array, T_world_body: Array) -> None:
        """Take a better relative pose of a match.

        Args:
            match_id: of the match.
            T_world_loop: (4, 4) body of the old keyframe in the odometry frame, as the smoother estimates it now.
            T_world_body: (4, 4) body of the keyframe that matched, likewise; both from the same estimate.
        """

    @abstractmethod
    def interrupt(self) -> None:
        """The smoother started again: the step from the last keyframe to the next is not to be trusted."""

    @property
    @abstractmethod
    def T_map_world(self) -> Array:
        """Correction (4, 4), yaw and position only, of the present odometry frame."""

    @abstractmethod
    def correct(self, trajectory: Trajectory) -> Trajectory:
        """The final trajectory, in the map (``causal=False``), of one in the odometry frame.

        Poses between keyframes take the correction in between; those after the last keyframe, the present one.
        """

    @abstractmethod
    def finish(self) -> None:
        """The recording has ended: save the map, where this is wanted."""

    @abstractmethod
    def counters(self) -> Mapping[str, int]:
        """What a user should read in the table, such as ``{"loop closures": 3}``."""
