"""``vo=stereo``: metric motion from two overlapping cameras."""

import logging
from collections.abc import Mapping
from typing import ClassVar

import cv2
import numpy as np

from vioframe.checks import Array
from vioframe.errors import ConfigError, DataError, ShapeError, StateError
from vioframe.geometry import camera as projection
from vioframe.geometry import se3
from vioframe.interfaces import METRIC_SCALE, RELATIVE_POSE, STEREO, TRACKS, VOEstimator
from vioframe.types import Camera, Frame, Image, RelativePose, SensorRig, Tracks, VisualFeatures
from vioframe_geometric.landmarks import Landmarks
from vioframe_geometric.pose import View
from vioframe_geometric.rays import Rays, observe
from vioframe_geometric.tracking import PixelNoise, locate, relative_covariance, select_view
from vioframe_geometric.two_view import require_positive

log = logging.getLogger(__name__)

_MIN_INVERSE_DEPTH = 1e-4
_HYPOTHESIS_PX = 50.0
_MAX_STRIKES = 2


class StereoVO(VOEstimator):
    """Reprojection errors in both images of a rig, against landmarks that stereo and motion keep refining.

    Args:
        sigma_px: standard deviation of a tracked point's coordinate.
        adapt_sigma: learn it from the errors, beginning with ``sigma_px``.
        min_points: fewer agreeing points give no motion.
        min_depth: nearer points are not matched, m.
        window_px: odd side of the patch matched between the images.
        levels: pyramid levels above the full image.
        epipolar_px: largest distance of a match from the epipolar line.
        forward_backward_px: largest distance of a match there and back.
        drift_px: how far the patch of a point slides over the scene from image to image.
        covariance_scale: by which the covariance from the residuals is multiplied.

    Raises:
        ConfigError: an option outside its range.
    """

    requires: ClassVar[frozenset[str]] = frozenset({TRACKS, STEREO})
    provides: ClassVar[frozenset[str]] = frozenset({RELATIVE_POSE, METRIC_SCALE})

    def __init__(
        self,
        *,
        sigma_px: float = 0.5,
        adapt_sigma: bool = True,
        min_points: int = 12,
        min_depth: float = 0.4,
        window_px: int = 15,
        levels: int = 3,
        epipolar_px: float = 1.5,
        forward_backward_px: float = 0.7,
        drift_px: float = 0.1,
        covariance_scale: float = 1.0,
    ) -> None:
        require_positive(
            sigma_px=sigma_px,
            min_depth=min_depth,
            epipolar_px=epipolar_px,
            forward_backward_px=forward_backward_px,
            covariance_scale=covariance_scale,
        )
        if min_points < 6:
            raise ConfigError(f"vo.min_points must be at least 6, got {min_points}")
        if drift_px < 0.0:
            raise ConfigError(f"vo.drift_px must not be negative, got {drift_px}")
        if window_px < 5 or window_px % 2 == 0:
            raise ConfigError(f"vo.window_px must be odd and at least 5, got {window_px}")
        if not 0 <= levels <= 8:
            raise ConfigError(f"vo.levels must be from 0 to 8, got {levels}")
        self._start_sigma = sigma_px
        self._adapt = adapt_sigma
        self._min_points = min_points
        self._min_depth = min_depth
        self._window = window_px
        self._levels = levels
        self._epipolar = epipolar_px
        self._back = forward_backward_px
        self._drift = drift_px
        self._covariance_scale = covariance_scale
        self._camera: Camera | None = None
        self._T_map_cam: Array
        self._motion: Array
        self._pose_covariance: Array

    def setup(self, rig: SensorRig) -> None:
        """Forget the map and take the calibration of cameras 0 and 1.

        Raises:
            DataError: there are not two cameras, or they sit at the same place.
        """
        if len(rig.cameras) < 2:
            raise DataError(f"vo=stereo needs two cameras, but the recording's calibration has {len(rig.cameras)}")
        self._camera = rig.cameras[0]
        self._matcher = StereoMatcher(
            rig.cameras[0],
            rig.cameras[1],
            min_depth=self._min_depth,
            window_px=self._window,
            levels=self._levels,
            epipolar_px=self._epipolar,
            forward_backward_px=self._back,
        )
        self._resets = 0
        self._stamp_ns: int | None = None
        self._noise = PixelNoise(self._start_sigma)
        self._restart()

    def counters(self) -> Mapping[str, int]:
        """How often the map was lost and begun anew."""
        return {"stereo restarts": self._resets} if self._camera is not None and self._resets else {}

    def estimate(self, previous: VisualFeatures, current: VisualFeatures) -> RelativePose:
        """Motion of camera 0 in metres.

        Raises:
            StateError: called before ``setup``.
            DataError: a frame without its second image, or of another size than calibrated.
        """
        if self._camera is None:
            raise StateError("StereoVO.estimate was called before setup(rig): set it up first")
        if previous.tracks is None or current.tracks is None:
            return RelativePose.invalid()
        if self._stamp_ns != previous.frame.stamp_ns:
            self._restart()
            self._extend(previous.frame, previous.tracks, self._see(previous.frame, previous.tracks))
            self._stamp_ns = previous.frame.stamp_ns
        views = self._see(current.frame, current.tracks)
        fix = locate(
            self._landmarks,
            current.tracks.ids,
            views,
            [self._T_map_cam @ self._motion, self._T_map_cam],
            sigma_px=self._noise.sigma_px,
            min_inliers=self._min_points,
        )
        if fix is None:
            self._resets += 1
            log.warning("stereo: lost at stamp %d ns; a new map begins there", current.frame.stamp_ns)
            self._restart()
            self._extend(current.frame, current.tracks, views)
            self._stamp_ns = current.frame.stamp_ns
            return RelativePose.invalid()
        if self._adapt:
            self._noise.learn(fix.errors)
        T_prev_cur = se3.inverse(self._T_map_cam) @ fix.T_map_cam
        covariance = relative_covariance(self._pose_covariance, fix.covariance, T_prev_cur)
        self._T_map_cam, self._motion, self._pose_covariance = fix.T_map_cam, T_prev_cur, fix.covariance
        self._landmarks.update(
            fix.index,
            fix.T_map_cam,
            [select_view(view, fix.rows) for view in views],
            sigma_px=self._noise.sigma_px,
            pose_covariance=fix.covariance,
        )
        self._extend(current.frame, current.tracks, views)
        self._stamp_ns = current.frame.stamp_ns
        return RelativePose(
            T_prev_cur=T_prev_cur,
            covariance=self._covariance_scale * covariance,
            valid=True,
            inliers=fix.inliers,
        )

    def _restart(self) -> None:
        self._landmarks = Landmarks(_MIN_INVERSE_DEPTH)
        self._T_map_cam = np.eye(4)
        self._motion = np.eye(4)
        self._pose_covariance = np.zeros((6, 6))

    def _see(self, frame: Frame, tracks: Tracks) -> tuple[View, View]:
        """The tracks in both images."""
        left = observe(self._matcher.left, tracks.bearings)
        index, known = self._landmarks.find(tracks.ids)
        inverse_depth = np.full(len(tracks), np.nan)
        if known.any():
            where = self._T_map_cam @ self._motion
            depth = (self._landmarks.points(index[known]) - where[:3, 3]) @ where[:3, 2]
            inverse_depth[known] = np.where(depth > 0.5 * self._min_depth, 1.0 / np.maximum(depth, 1e-3), np.nan)
        bearings, found = self._matcher.match(frame, tracks, inverse_depth)
        right = observe(self._matcher.right, bearings, self._matcher.T_left_right)
        return View(rays=left, seen=np.ones(len(tracks), dtype=bool)), View(rays=right, seen=found)

    def _extend(self, frame: Frame, tracks: Tracks, views: tuple[View, View]) -> None:
        """Drop points that ended or failed, let the others drift, and add new ones with their stereo depth."""
        landmarks = self._landmarks
        landmarks.keep(np.isin(landmarks.ids, tracks.ids) & (landmarks.strikes < _MAX_STRIKES))
        slide = (self._drift / float(np.mean(self._matcher.left.intrinsics_px[:2]))) ** 2
        landmarks.covariance[:, 0, 0] += slide
        landmarks.covariance[:, 1, 1] += slide
        landmarks.covariance[:, 2, 2] *= 1.0 + 0.01
        _, known = landmarks.find(tracks.ids)
        rows = np.flatnonzero(~known & views[1].seen)
        if len(rows) == 0:
            return
        left, right = views[0].rays.select(rows), views[1].rays.select(rows)
        depth = left.axes[:, 2:]
        ideal = left.axes[:, :2] / depth
        inverse_depth = np.maximum(stereo_inverse_depth(left, right), _MIN_INVERSE_DEPTH)
        slope = left.rows[:, :, :2] * depth[..., None]
        covariance = np.zeros((len(rows), 3, 3))
        inverse_slope = np.linalg.inv(slope)
        covariance[:, :2, :2] = self._noise.sigma_px**2 * inverse_slope @ np.swapaxes(inverse_slope, -1, -2)
        covariance[:, 2, 2] = (1.0 / self._min_depth) ** 2
        ids = tracks.ids[rows]
        landmarks.add(ids, self._T_map_cam, ideal, inverse_depth, covariance)
        index, _ = landmarks.find(ids)
        nothing = np.zeros(len(rows), dtype=bool)
        landmarks.update(
            index,
            self._T_map_cam,
            [View(rays=left, seen=nothing), View(rays=right, seen=~nothing)],
            sigma_px=self._noise.sigma_px,
        )


def stereo_inverse_depth(left: Rays, right: Rays) -> Array:
    """1/z (M,) in camera 0 of points seen in both: least squares of ``b₁ × (h₀ − ρ c) = 0``; may come out negative."""
    ray = left.axes / left.axes[:, 2:]
    across_ray = np.cross(right.axes, ray)
    across_base = np.cross(right.axes, right.origins)
    length = np.maximum(np.sum(across_base**2, axis=-1), 1e-18)
    inverse_depth: Array = np.sum(across_ray * across_base, axis=-1) / length
    return inverse_depth


class StereoMatcher:
    """Finds the points of camera 0 in the image of camera 1, of any rig whose views overlap (not rectified).

    Lucas–Kanade started on the epipolar line at the known depth, or at several depths where none is known.
    """

    def __init__(
        self,
        left: Camera,
        right: Camera,
        *,
        min_depth: float,
        window_px: int,
        levels: int,
        epipolar_px: float,
        forward_backward_px: float,
    ) -> None:
        self.left, self.right = left, right
        self.T_left_right = se3.inverse(left.T_body_cam) @ right.T_body_cam
        self._T_right_left = se3.inverse(self.T_left_right)
        baseline = float(np.linalg.norm(self.T_left_right[:3, 3]))
        if baseline < 1e-4:
            raise DataError(f"vo=stereo needs two cameras apart from each other, but theirs is {baseline:.2g} m")
        focal = float(np.mean(left.intrinsics_px[:2]))
        steps = max(2, int(np.ceil(focal * baseline / min_depth / _HYPOTHESIS_PX)))
        self._guesses = (np.arange(min(steps, 4)) + 0.3) / min(steps, 4) / min_depth
        self._max_inverse_depth = 1.0 / min_depth
        self._threshold = epipolar_px / focal
        self._back = forward_backward_px
        self._window = (window_px, window_px)
        self._levels = levels
        self._criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.02)

    def match(self, frame: Frame, tracks: Tracks, inverse_depth: Array) -> tuple[Array, np.ndarray]:
        """Bearings (M, 3) in camera 1, and found (M,).

        Args:
            frame: with both images.
            tracks: M points of camera 0.
            inverse_depth: (M,) 1/z in camera 0, 1/m; NaN where unknown.
        """
        left, right = self._images(frame)
        count = len(tracks)
        pixels = np.zeros((count, 2), np.float32)
        found = np.zeros(count, dtype=bool)
        error = np.full(count, np.inf)
        unknown = np.isnan(inverse_depth)
        if not unknown.all():
            self._search(left, right, tracks, inverse_depth, np.flatnonzero(~unknown), 1, pixels, found, error)
        rows = np.flatnonzero(~found)
        for guess in self._guesses:
            if len(rows):
                depths = np.full(count, guess)
                self._search(left, right, tracks, depths, rows, self._levels, pixels, found, error)
        bearings = projection.bearings(self.right, pixels.astype(float))
        # Distance from the epipolar plane, as an angle.
        ray = tracks.bearings @ self._T_right_left[:3, :3].T
        base = self._T_right_left[:3, 3]
        normal = np.cross(ray, base)
        normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
        found &= np.abs(np.sum(normal * bearings, axis=-1)) < self._threshold
        axes = bearings @ self.T_left_right[:3, :3].T
        ahead = tracks.bearings / np.maximum(tracks.bearings[:, 2:], 1e-3)
        across_base = np.cross(axes, self.T_left_right[:3, 3])
        depth = np.sum(np.cross(axes, ahead) * across_base, axis=-1) / np.maximum(
            np.sum(across_base**2, axis=-1), 1e-18
        )
        tolerance = 2.0 * self._threshold / float(np.linalg.norm(base))
        found &= (depth > -tolerance) & (depth < self._max_inverse_depth)
        return bearings, found

    def _search(
        self,
        left: Image,
        right: Image,
        tracks: Tracks,
        inverse_depth: Array,
        rows: np.ndarray,
        levels: int,
        pixels: np.ndarray,
        found: np.ndarray,
        error: np.ndarray,
    ) -> None:
        """Match ``rows`` from a depth, and keep what fits better than before."""
        ray = tracks.bearings[rows] / np.maximum(tracks.bearings[rows, 2:], 1e-3)
        expected, visible = projection.project(
            self.right, ray @ self._T_right_left[:3, :3].T + inverse_depth[rows, None] * self._T_right_left[:3, 3]
        )
        start = tracks.pixels[rows].astype(np.float32)
        guess = np.where(visible[:, None], expected, start).astype(np.float32)
        there, status, difference = cv2.calcOpticalFlowPyrLK(
            left,
            right,
            start,
            guess,
            winSize=self._window,
            maxLevel=levels,
            criteria=self._criteria,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        back, status_back, _ = cv2.calcOpticalFlowPyrLK(
            right,
            left,
            there,
            start.copy(),
            winSize=self._window,
            maxLevel=1,
            criteria=self._criteria,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        width, height = self.right.size_px
        inside = (there > 0.0).all(axis=-1) & (there[:, 0] < width - 1) & (there[:, 1] < height - 1)
        good = (status[:, 0] > 0) & (status_back[:, 0] > 0) & inside
        good &= np.linalg.norm(back - start, axis=-1) < self._back
        better = good & (difference[:, 0] < error[rows])
        pixels[rows[better]] = there[better]
        error[rows[better]] = difference[better, 0]
        found[rows[better]] = True

    def _images(self, frame: Frame) -> tuple[Image, Image]:
        if len(frame.images) < 2:
            raise DataError(f"frame at {frame.stamp_ns} ns has {len(frame.images)} image(s), and vo=stereo needs two")
        gray = []
        for index, camera in enumerate((self.left, self.right)):
            image = frame.images[index]
            if image.shape[:2] != camera.size_px[::-1]:
                raise ShapeError(
                    f"image of camera {index} at {frame.stamp_ns} ns is {image.shape[1]}×{image.shape[0]} px, but its "
                    f"calibration says {camera.size_px[0]}×{camera.size_px[1]}: correct the calibration or the images"
                )
            gray.append(image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
        left, right = gray
        # The two cameras expose for themselves.
        mean, deviation = (float(v[0, 0]) for v in cv2.meanStdDev(left))
        mean_right, deviation_right = (float(v[0, 0]) for v in cv2.meanStdDev(right))
        gain = min(max(deviation / max(deviation_right, 1e-3), 0.2), 5.0)
        table = np.clip(np.rint(mean + gain * (np.arange(256.0) - mean_right)), 0, 255).astype(np.uint8)
        return left, cv2.LUT(right, table)
