"""``vo=local_map``: monocular motion in one unit, against a local map."""

import logging
from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

import numpy as np

from vioframe.checks import Array
from vioframe.errors import ConfigError, StateError
from vioframe.geometry import se3
from vioframe.interfaces import CONSISTENT_SCALE, RELATIVE_POSE, TRACKS, VOEstimator
from vioframe.types import Camera, RelativePose, SensorRig, Tracks, VisualFeatures
from vioframe_geometric.map_start import MapStart
from vioframe_geometric.map_state import LocalMap
from vioframe_geometric.map_window import KeyframeWindow
from vioframe_geometric.tracking import Fix, PixelNoise, relative_covariance, select_view
from vioframe_geometric.two_view import first_camera, require_positive

log = logging.getLogger(__name__)

# Images that may be bridged while points are still followed.
_MAX_MISSED = 10


class LocalMapVO(VOEstimator):
    """Locates every image in a map of landmarks, and keeps the map by small bundle adjustments at keyframes.

    The unit of length is the median depth of the first map. It is kept until all points are lost at once; a map begun
    after that takes over the median depth of the last one, and ``counters`` tells how often. No motion is given
    before two views are far enough apart, nor while lost.

    Args:
        sigma_px: standard deviation of a tracked point's coordinate.
        adapt_sigma: learn it from the errors, beginning with ``sigma_px``.
        min_points: fewer agreeing points give no motion.
        start_parallax_px: upper quartile of the displacement beyond rotation at which a map is begun.
        start_points: fewest points of a first map.
        keyframe_parallax_px: median displacement beyond rotation since the last keyframe that asks for a new one.
        keyframe_share: share of points in common with the last keyframe below which there is a new one.
        window: keyframes adjusted together.
        fixed: of them, the oldest, that stay where they are once the window is full.
        drift_px: how far the patch of a point slides over the scene from image to image.
        covariance_scale: by which the covariance from the errors is multiplied.

    Raises:
        ConfigError: an option outside its range.
    """

    requires: ClassVar[frozenset[str]] = frozenset({TRACKS})
    provides: ClassVar[frozenset[str]] = frozenset({RELATIVE_POSE, CONSISTENT_SCALE})

    def __init__(
        self,
        *,
        sigma_px: float = 0.5,
        adapt_sigma: bool = True,
        min_points: int = 12,
        start_parallax_px: float = 15.0,
        start_points: int = 30,
        keyframe_parallax_px: float = 10.0,
        keyframe_share: float = 0.7,
        window: int = 8,
        fixed: int = 2,
        drift_px: float = 0.05,
        covariance_scale: float = 0.7,
    ) -> None:
        require_positive(
            sigma_px=sigma_px,
            start_parallax_px=start_parallax_px,
            keyframe_parallax_px=keyframe_parallax_px,
            covariance_scale=covariance_scale,
        )
        if min_points < 6:
            raise ConfigError(f"vo.min_points must be at least 6, got {min_points}")
        if start_points < min_points:
            raise ConfigError(f"vo.start_points must be at least min_points={min_points}, got {start_points}")
        if not 0.0 < keyframe_share < 1.0:
            raise ConfigError(f"vo.keyframe_share must be between 0 and 1, got {keyframe_share}")
        if not 3 <= window <= 30:
            raise ConfigError(f"vo.window must be from 3 to 30, got {window}")
        if not 1 <= fixed < window:
            raise ConfigError(f"vo.fixed must be from 1 to window - 1 = {window - 1}, got {fixed}")
        if drift_px < 0.0:
            raise ConfigError(f"vo.drift_px must not be negative, got {drift_px}")
        self._start_sigma = sigma_px
        self._adapt = adapt_sigma
        self._min_points = min_points
        self._start_parallax = start_parallax_px
        self._start_points = start_points
        self._window_size = window
        self._drift = drift_px
        self._covariance_scale = covariance_scale
        self._window = KeyframeWindow(size=window, fixed=fixed, parallax_px=keyframe_parallax_px, share=keyframe_share)
        self._camera: Camera | None = None

    def setup(self, rig: SensorRig) -> None:
        """Forget the map and take the calibration of camera 0."""
        self._camera = first_camera(rig, "local_map")
        self._noise = PixelNoise(self._start_sigma)
        self._maps_lost = 0
        self._stamp_ns: int | None = None
        self._begin(self._camera, unit=1.0)

    def counters(self) -> Mapping[str, int]:
        """How often the map was lost; the unit of length after that is a guess."""
        return {"maps lost": self._maps_lost} if self._camera is not None and self._maps_lost else {}

    def estimate(self, previous: VisualFeatures, current: VisualFeatures) -> RelativePose:
        """Motion of camera 0 in the unit of the map; invalid where there is no map yet, or none any more.

        Raises:
            StateError: called before ``setup``.
        """
        if self._camera is None:
            raise StateError("LocalMapVO.estimate was called before setup(rig): set it up first")
        if previous.tracks is None or current.tracks is None:
            return RelativePose.invalid()
        if self._stamp_ns != previous.frame.stamp_ns:
            self._advance(previous.tracks, None)
        before, after = self._advance(current.tracks, previous.tracks)
        self._stamp_ns = current.frame.stamp_ns
        if before is None or after is None:
            return RelativePose.invalid()
        T_prev_cur = se3.inverse(before.T_map_cam) @ after.T_map_cam
        covariance = self._covariance_scale * relative_covariance(before.covariance, after.covariance, T_prev_cur)
        return RelativePose(T_prev_cur=T_prev_cur, covariance=covariance, valid=True, inliers=after.inliers)

    def _begin(self, camera: Camera, *, unit: float) -> None:
        """Forget everything but the noise; the next map has a median depth of ``unit``."""
        self._map = LocalMap(camera, self._noise, min_points=self._min_points)
        self._start = MapStart(
            parallax_px=self._start_parallax, points=self._start_points, window=self._window_size, unit=unit
        )
        self._unit = unit
        self._fix: Fix | None = None
        self._T_map_cam: Array = np.eye(4)
        self._motion: Array = np.eye(4)
        self._missed = 0

    def _advance(self, tracks: Tracks, previous: Tracks | None) -> tuple[Fix | None, Fix | None]:
        """Take the next view; return where the one before and this one were found."""
        before = self._fix
        if len(self._map.landmarks) == 0:
            if not self._start.take(tracks, self._map):
                return None, None
            self._window.adjust(self._map)
            self._T_map_cam = self._map.keyframes[-1].T_map_cam
            before = None if previous is None else self._map.locate(previous, [self._T_map_cam, np.eye(4)])
            if before is not None:
                self._motion = se3.inverse(before.T_map_cam) @ self._T_map_cam
        fix = self._map.locate(tracks, [self._T_map_cam @ self._motion, self._T_map_cam])
        if fix is None:
            self._miss(tracks)
            return before, None
        told = self._track(tracks, fix)
        self._motion = se3.inverse(before.T_map_cam) @ told.T_map_cam if before is not None else np.eye(4)
        self._fix = replace(fix, T_map_cam=self._T_map_cam)
        return before, told

    def _track(self, tracks: Tracks, fix: Fix) -> Fix:
        """Teach the map what a located view saw; return the fix with the pose that a new keyframe was given."""
        if self._adapt:
            self._noise.learn(fix.errors)
        self._missed = 0
        self._T_map_cam = fix.T_map_cam
        view = self._map.view(tracks)
        self._map.landmarks.update(
            fix.index,
            fix.T_map_cam,
            [select_view(view, fix.rows)],
            sigma_px=self._noise.sigma_px,
            pose_covariance=fix.covariance,
        )
        self._map.extend(tracks, view, self._T_map_cam, drift_px=self._drift)
        if not self._window.is_due(self._map, tracks, self._T_map_cam):
            return fix
        self._window.add(self._map, tracks, view, self._T_map_cam)
        self._T_map_cam = self._map.keyframes[-1].T_map_cam
        return _corrected(fix, self._T_map_cam)

    def _miss(self, tracks: Tracks) -> None:
        """No pose was found: wait for better images while points are still followed, else begin anew."""
        self._fix = None
        self._motion = np.eye(4)
        self._missed += 1
        _, known = self._map.landmarks.find(tracks.ids)
        if known.sum() >= self._min_points and self._missed <= _MAX_MISSED:
            return
        self._maps_lost += 1
        depth = self._map.depths(self._T_map_cam)
        log.warning("local_map: the map was lost; the next one takes over its median depth as a guess of the scale")
        self._begin(self._map.camera, unit=float(np.median(depth)) if len(depth) else self._unit)
        self._start.take(tracks, self._map)


def _corrected(fix: Fix, T_map_cam: Array) -> Fix:
    """A fix moved by a bundle adjustment.

    The correction makes good the errors of earlier steps, and so is itself an error of this one: its mean square is
    added to the covariance.
    """
    jump = se3.log(se3.inverse(fix.T_map_cam) @ T_map_cam)
    spread = np.repeat([np.mean(jump[:3] ** 2), np.mean(jump[3:] ** 2)], 3)
    return replace(fix, T_map_cam=T_map_cam, covariance=fix.covariance + np.diag(spread))
