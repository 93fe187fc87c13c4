"""Keyframes and what they saw, in arrays sorted by point."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from vioframe.checks import Array, Mask, Stamps
from vioframe.types import Camera, ImuBias, Tracks

if TYPE_CHECKING:
    import gtsam

# Past about 78° off the axis the image plane at depth 1 stretches an error of one pixel over the whole image.
_MIN_COSINE = 0.2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """Points that one camera of the rig saw at a keyframe.

    Attributes:
        ids: (M,) increasing.
        points: (M, 2) normalised coordinates, at depth 1.
        bearings: (M, 3) unit vectors in the camera.
    """

    ids: Stamps
    points: Array
    bearings: Array

    @staticmethod
    def of(tracks: Tracks | None) -> "View":
        """The view of a camera's tracks; empty where there is no such camera."""
        tracks = Tracks.none() if tracks is None else tracks
        usable = np.flatnonzero(tracks.bearings[:, 2] > _MIN_COSINE)
        order = usable[np.argsort(tracks.ids[usable], kind="stable")]
        bearings = tracks.bearings[order]
        return View(ids=tracks.ids[order], points=bearings[:, :2] / bearings[:, 2:], bearings=bearings)

    def find(self, ids: Stamps) -> tuple[Stamps, Mask]:
        """Where points are in this view: rows (N,), meaningless where ``seen`` (N,) is False."""
        if not len(self.ids):
            return np.zeros(len(ids), dtype=np.int64), np.zeros(len(ids), dtype=bool)
        rows = np.minimum(np.searchsorted(self.ids, ids), len(self.ids) - 1)
        return rows, self.ids[rows] == ids


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Turn:
    """What two views of points without parallax say: how camera 0 has turned, and nothing else.

    Attributes:
        R_past_cam: (3, 3) from the newer camera into the older.
        sigma: rad an axis.
        agreeing: points that moved as the turn says.
    """

    R_past_cam: Array
    sigma: float
    agreeing: int


@dataclass(slots=True, kw_only=True, eq=False)
class Keyframe:
    """One keyframe of the window; its estimates are refreshed after every solution.

    Attributes:
        index: counts keyframes since the start; names its variables.
        stamp_ns: IMU clock.
        views: of camera 0 and, with two cameras, of camera 1.
        increment: gtsam's preintegrated samples since the keyframe before, None at the first.
        at_rest: the body has not moved since the keyframe before.
        delay_s: camera delay that the stamp contains.
        turn: since the keyframe before, where there are too few points in the window to tell it.
        rate: (3,) rad/s, of the gyro at the stamp, bias included.
        T_world_body: (4, 4); v_world_body: (3,); bias...
        T_world_cam: (4, 4) of camera 0.
    """

    index: int
    stamp_ns: int
    views: tuple[View, ...]
    increment: "gtsam.PreintegratedCombinedMeasurements | None"
    at_rest: bool
    delay_s: float
    rate: Array
    T_world_body: Array
    v_world_body: Array
    bias: ImuBias
    turn: Turn | None = None
    T_world_cam: Array = field(default_factory=lambda: np.eye(4))


def focal_length(camera: Camera) -> float:
    """Pixels a unit of normalised coordinates, near the axis."""
    return float(0.5 * (camera.intrinsics_px[0] + camera.intrinsics_px[1]))
