"""``vo=local_map``: monocular motion in one unit, against a local map of landmarks."""

import logging
from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from vioframe.checks import Array
from vioframe.errors import ConfigError, StateError
from vioframe.geometry import se3
from vioframe.geometry.triangulation import triangulate
from vioframe.interfaces import CONSISTENT_SCALE, RELATIVE_POSE, TRACKS, VOEstimator
from vioframe.types import Camera, RelativePose, SensorRig, Tracks, VisualFeatures
from vioframe_geometric.epipolar import fit_rotation, fit_two_view, pair, parallax_px
from vioframe_geometric.landmarks import Landmarks
from vioframe_geometric.pose import View
from vioframe_geometric.rays import observe
from vioframe_geometric.tracking import Fix, locate, relative_covariance, select_view
from vioframe_geometric.two_view import common_points, first_camera, require_positive

log = logging.getLogger(__name__)

# The unit of length of a map is the median depth of its first points; nothing is further than a thousand of them.
_MIN_INVERSE_DEPTH = 1e-3
_MAX_STRIKES = 2
_MAX_DIRECTION = np.radians(6.0)
_INLIER = 3.0


class LocalMapVO(VOEstimator):
    """Monocular: map, locate, extend."""

    requires: ClassVar[frozenset[str]] = frozenset({TRACKS})
    provides: ClassVar[frozenset[str]] = frozenset({RELATIVE_POSE, CONSISTENT_SCALE})

    def __init__(
        self,
        *,
        sigma_px: float = 0.5,
        min_points: int = 12,
        start_parallax_px: float = 20.0,
        start_points: int = 30,
        drift_px: float = 0.05,
        covariance_scale: float = 1.0,
    ) -> None:
        require_positive(sigma_px=sigma_px, start_parallax_px=start_parallax_px, covariance_scale=covariance_scale)
        self._sigma = sigma_px
        self._min_points = min_points
        self._start_parallax = start_parallax_px
        self._start_points = start_points
        self._drift = drift_px
        self._covariance_scale = covariance_scale
        self._camera: Camera | None = None

    def setup(self, rig: SensorRig) -> None:
        self._camera = first_camera(rig, "local_map")
        self._focal = float(np.mean(self._camera.intrinsics_px[:2]))
        self._unit = 1.0
        self._stamp_ns: int | None = None
        self._forget()

    def _forget(self) -> None:
        self._landmarks = Landmarks(_MIN_INVERSE_DEPTH)
        self._reference: Tracks | None = None
        self._fix: Fix | None = None
        self._motion = np.eye(4)
        self._missed = 0

    def estimate(self, previous: VisualFeatures, current: VisualFeatures) -> RelativePose:
        if self._camera is None:
            raise StateError("LocalMapVO.estimate was called before setup(rig): set it up first")
        if previous.tracks is None or current.tracks is None:
            return RelativePose.invalid()
        if self._stamp_ns != previous.frame.stamp_ns:
            self._advance(previous.tracks)
        before = self._fix
        after = self._advance(current.tracks, previous.tracks)
        self._stamp_ns = current.frame.stamp_ns
        if before is None:
            before = self._fix_before
        if before is None or after is None:
            return RelativePose.invalid()
        T_prev_cur = se3.inverse(before.T_map_cam) @ after.T_map_cam
        self._motion = T_prev_cur
        covariance = self._covariance_scale * relative_covariance(before.covariance, after.covariance, T_prev_cur)
        return RelativePose(T_prev_cur=T_prev_cur, covariance=covariance, valid=True, inliers=after.inliers)

    def _advance(self, tracks: Tracks, previous: Tracks | None = None) -> Fix | None:
        self._fix_before = None
        if len(self._landmarks) == 0:
            self._start(tracks)
            if len(self._landmarks) == 0:
                return None
            if previous is not None:
                self._fix_before = self._locate(previous, [self._T_map_cam, np.eye(4)])
                if self._fix_before is not None:
                    self._motion = se3.inverse(self._fix_before.T_map_cam) @ self._T_map_cam
        fix = self._locate(tracks, [self._T_map_cam @ self._motion, self._T_map_cam])
        self._fix = fix
        if fix is None:
            self._missed += 1
            self._motion = np.eye(4)
            if self._missed > 10:
                self._forget()
            return None
        self._missed = 0
        self._T_map_cam = fix.T_map_cam
        view = self._view(tracks)
        self._landmarks.update(
            fix.index, fix.T_map_cam, [select_view(view, fix.rows)], sigma_px=self._sigma, pose_covariance=fix.covariance
        )
        self._extend(tracks, view)
        return fix

    def _view(self, tracks):
        return View(rays=observe(self._camera, tracks.bearings), seen=np.ones(len(tracks), dtype=bool))

    def _locate(self, tracks: Tracks, starts: list[Array]) -> Fix | None:
        return locate(
            self._landmarks, tracks.ids, [self._view(tracks)], starts, sigma_px=self._sigma, min_inliers=self._min_points
        )

    def _start(self, tracks: Tracks) -> None:
        if self._reference is None:
            self._reference = tracks
            return
        first, second = common_points(self._reference, tracks)
        if len(first) < self._start_points or len(first) < 0.4 * len(self._reference):
            self._reference = tracks
            return
        pairs = pair(self._camera, self._reference.bearings[first], tracks.bearings[second])
        if np.median(parallax_px(pairs, fit_rotation(pairs), self._focal)) < self._start_parallax:
            return
        fit = fit_two_view(pairs, focal_px=self._focal, sigma_px=self._sigma, threshold_px=2.0 * self._sigma)
        if fit is None or np.linalg.eigvalsh(fit.covariance[3:, 3:])[-1] > _MAX_DIRECTION**2:
            return
        T_ref_cur = se3.from_parts(fit.R_prev_cur, fit.t)
        rays = np.stack([self._reference.bearings[first], tracks.bearings[second]])
        points, depths = triangulate(np.stack([np.eye(4), T_ref_cur]), rays)
        good = (fit.errors < _INLIER) & np.nan_to_num(depths > 0.0).all(axis=0)
        if good.sum() < max(self._start_points, 0.6 * len(first)):
            return
        scale = self._unit / float(np.median(depths[0][good]))
        T_ref_cur[:3, 3] *= scale
        rows = np.flatnonzero(good)
        view = self._view(tracks)
        ids = tracks.ids[second[rows]]
        reference = observe(self._camera, self._reference.bearings[first[rows]])
        self._add(ids, np.eye(4), reference, 1.0 / (scale * depths[0][rows]), 1.0 / self._unit)
        index, _ = self._landmarks.find(ids)
        self._landmarks.update(index, T_ref_cur, [select_view(view, second[rows])], sigma_px=self._sigma)
        self._T_map_cam = T_ref_cur

    def _add(self, ids, T_map_cam, rays, inverse_depth, spread):
        depth = rays.axes[:, 2:]
        inverse_slope = np.linalg.inv(rays.rows[:, :, :2] * depth[..., None])
        covariance = np.zeros((len(ids), 3, 3))
        covariance[:, :2, :2] = self._sigma**2 * inverse_slope @ np.swapaxes(inverse_slope, -1, -2)
        covariance[:, 2, 2] = spread**2
        self._landmarks.add(ids, T_map_cam, rays.axes[:, :2] / depth, np.maximum(inverse_depth, _MIN_INVERSE_DEPTH), covariance)

    def _extend(self, tracks: Tracks, view: View) -> None:
        landmarks = self._landmarks
        landmarks.keep(np.isin(landmarks.ids, tracks.ids) & (landmarks.strikes < _MAX_STRIKES))
        slide = (self._drift / self._focal) ** 2
        landmarks.covariance[:, 0, 0] += slide
        landmarks.covariance[:, 1, 1] += slide
        index, known = landmarks.find(tracks.ids)
        T = self._T_map_cam
        depth = (landmarks.points(index[known]) - T[:3, 3]) @ T[:3, 2]
        depth = depth[depth > 0]
        if len(depth):
            typical = float(np.median(1.0 / depth))
            rows = np.flatnonzero(~known)
            self._add(tracks.ids[rows], T, view.rays.select(rows), np.full(len(rows), typical), typical)
