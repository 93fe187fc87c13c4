"""The front end: points followed from a reference image, checked there and back."""

import logging
from collections.abc import Mapping
from typing import ClassVar

import cv2
import numpy as np

from vioframe.checks import Array
from vioframe.errors import ConfigError, DataError, ShapeError, StateError
from vioframe.geometry import camera as projection
from vioframe.interfaces import IMAGES, STEREO, STEREO_TRACKS, TRACKS, Frontend
from vioframe.types import Camera, Frame, Image, SensorRig, Tracks, VisualFeatures
from vioframe_klt.detector import CornerDetector
from vioframe_klt.outliers import epipolar_inliers
from vioframe_klt.stereo import StereoMatcher

log = logging.getLogger(__name__)

_TARGET_MEAN, _TARGET_DEVIATION = 118.0, 52.0
# More contrast than this would turn sensor noise of a dark or empty image into texture.
_MAX_GAIN = 4.0
_LEVELS_BACK = 1
# The reference image is also renewed when fewer than this share of its points is left, and, where the image has
# few corners, every so many images in the hope of more.
_MIN_KEPT = 0.85
_SPARSE = 0.5
_RETRY_IMAGES = 10
_INVERTIBLE_PX = 0.5


class KltFrontend(Frontend):
    """Shi-Tomasi corners followed by pyramidal Lucas–Kanade (Bouguet 2001), with lasting ids.

    A point is searched for in the new image as it looked in a *reference* image a few frames back, which is
    renewed when the view has moved; frame-to-frame tracking is the special case ``reference_flow_px=0``.

    Args:
        stereo: also find the points in camera 1.
        min_depth: nearer points are not looked for there, m.
        max_points: most points followed at once.
        min_distance_px: between points, when new ones are taken.
        quality: fraction of the strongest corner's smaller eigenvalue a corner needs.
        min_gradient: square root of that eigenvalue a corner needs at least, grey levels a pixel.
        detection_scale: 1, or 2 to look for corners in the half-size image.
        window_px: odd side of the patch.
        levels: pyramid levels above the full image.
        max_steps: of Lucas–Kanade, a level.
        step_px: shorter steps end the search.
        forward_backward_px: largest distance of a point followed there and back from its start.
        reference_flow_px: median displacement at which the reference image is renewed.
        predict_rotation: start the search where the gyro's rotation puts the point.
        reject_outliers: by the epipolar geometry of this image and the one before.
        outlier_px: distance from the epipolar line that contradicts it.
        normalise_exposure: bring every image to one mean and contrast.
        clahe: equalise contrast locally.
        clahe_clip: its limit.
        clahe_tiles: along each side.
        border_px: no points nearer to the edge of the image.
        max_angle_deg: no points further from the optical axis, or None.

    Raises:
        ConfigError: an option outside its range.
    """

    provides: ClassVar[frozenset[str]] = frozenset({TRACKS})

    def __init__(
        self,
        *,
        stereo: bool = False,
        min_depth: float = 0.4,
        max_points: int = 180,
        min_distance_px: float = 22.0,
        quality: float = 0.01,
        min_gradient: float = 1.0,
        detection_scale: int = 2,
        window_px: int = 21,
        levels: int = 3,
        max_steps: int = 20,
        step_px: float = 0.02,
        forward_backward_px: float = 0.7,
        reference_flow_px: float = 20.0,
        predict_rotation: bool = True,
        reject_outliers: bool = True,
        outlier_px: float = 1.5,
        normalise_exposure: bool = True,
        clahe: bool = False,
        clahe_clip: float = 3.0,
        clahe_tiles: int = 8,
        border_px: int = 8,
        max_angle_deg: float | None = None,
    ) -> None:
        _require("min_depth", min_depth, min_depth > 0.0, "positive")
        _require("max_points", max_points, max_points >= 1, "at least 1")
        _require("min_distance_px", min_distance_px, min_distance_px >= 2.0, "at least 2")
        _require("quality", quality, 0.0 < quality < 1.0, "between 0 and 1")
        _require("min_gradient", min_gradient, min_gradient >= 0.0, "not negative")
        _require("detection_scale", detection_scale, detection_scale in (1, 2), "1 or 2")
        _require("window_px", window_px, window_px >= 5 and window_px % 2 == 1, "odd and at least 5")
        _require("levels", levels, 0 <= levels <= 8, "from 0 to 8")
        _require("max_steps", max_steps, max_steps >= 1, "at least 1")
        _require("step_px", step_px, step_px > 0.0, "positive")
        _require("forward_backward_px", forward_backward_px, forward_backward_px > 0.0, "positive")
        _require("reference_flow_px", reference_flow_px, reference_flow_px >= 0.0, "not negative")
        _require("outlier_px", outlier_px, outlier_px > 0.0, "positive")
        _require("clahe_clip", clahe_clip, clahe_clip > 0.0, "positive")
        _require("clahe_tiles", clahe_tiles, clahe_tiles >= 1, "at least 1")
        _require("border_px", border_px, border_px >= 1, "at least 1")
        if max_angle_deg is not None:
            _require("max_angle_deg", max_angle_deg, 0.0 < max_angle_deg < 90.0, "between 0 and 90, or null")
        if stereo:
            # What it needs and gives depends on its options, so the instance says it, not the class.
            self.requires = frozenset({IMAGES, STEREO})  # type: ignore[misc]
            self.provides = frozenset({TRACKS, STEREO_TRACKS})  # type: ignore[misc]
        self._stereo = stereo
        self._min_depth = min_depth
        self._max_points = max_points
        self._min_distance = min_distance_px
        self._quality = quality
        self._min_gradient = min_gradient
        self._detection_scale = detection_scale
        self._window = (window_px, window_px)
        self._levels = levels
        self._criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, max_steps, step_px)
        self._back_px = forward_backward_px
        self._reference_flow = reference_flow_px
        self._predict = predict_rotation
        self._reject = reject_outliers
        self._outlier_px = outlier_px
        self._normalise = normalise_exposure
        self._clahe = cv2.createCLAHE(clahe_clip, (clahe_tiles, clahe_tiles)) if clahe else None
        self._border = border_px
        self._max_angle_deg = max_angle_deg
        self._camera: Camera | None = None

    def setup(self, rig: SensorRig) -> None:
        """Forget all points; ids start again at 0.

        Raises:
            DataError: the rig has no camera, or one where stereo needs two; or ``border_px`` leaves nothing of its
                image.
        """
        if not rig.cameras:
            raise DataError("frontend=klt needs a camera, but the recording's calibration has none")
        camera = rig.cameras[0]
        width, height = camera.size_px
        if min(width, height) <= 2 * self._border + self._window[0]:
            raise DataError(
                f"frontend.border_px={self._border} and window_px={self._window[0]} leave nothing of images of "
                f"{width}×{height} px: make them smaller"
            )
        self._camera = camera
        self._matcher = self._stereo_matcher(rig) if self._stereo else None
        allowed = np.zeros((height, width), np.uint8)
        inner = slice(self._border, height - self._border), slice(self._border, width - self._border)
        allowed[inner] = 255
        self._invertible = cv2.resize(self._usable(camera), (width, height), interpolation=cv2.INTER_NEAREST)
        allowed &= self._invertible
        self._detector = CornerDetector(
            min_distance_px=self._min_distance,
            quality=self._quality,
            min_gradient=self._min_gradient,
            scale=self._detection_scale,
            allowed=allowed,
        )
        self._next_id = 0
        self._images = 0
        self._lost_all = 0
        self._reference_age = 0
        self._reference_count = 0
        self._reference: Image | None = None
        self._points = _Points.none()

    def counters(self) -> Mapping[str, int]:
        """How often every point was lost at once."""
        return {"lost all tracks": self._lost_all} if self._camera is not None and self._lost_all else {}

    def process(self, frame: Frame, R_prev_cur: Array | None = None) -> VisualFeatures:
        """Follow the points into the next image of camera 0, and take new ones where there is room.

        Scores are the number of images a point has been seen in.

        Raises:
            StateError: called before ``setup``.
            DataError: the frame has no image, or one that does not fit the calibration.
        """
        if self._camera is None:
            raise StateError("KltFrontend.process was called before setup(rig): set it up first")
        gray = self._prepare(frame, 0, self._camera)
        points = self._points
        if self._reference is not None and len(points):
            points = self._follow(self._reference, gray, points, R_prev_cur, self._camera)
            if len(points) == 0:
                self._lost_all += 1
                log.warning("KLT: all points were lost at stamp %d ns", frame.stamp_ns)
        room = self._max_points - len(points)
        flow = float(np.median(np.linalg.norm(points.pixels - points.reference, axis=-1))) if len(points) else np.inf
        # Losing many points is a change of view even where the median hardly moved.
        self._reference_age += 1
        worn = len(points) < _MIN_KEPT * self._reference_count
        sparse = len(points) < _SPARSE * self._max_points and self._reference_age >= _RETRY_IMAGES
        if self._reference is None or flow > self._reference_flow or worn or sparse:
            self._reference = gray
            points = self._renew(gray, points, room)
            self._reference_age, self._reference_count = 0, len(points)
        self._points = points
        tracks = Tracks(
            ids=points.ids,
            pixels=points.pixels,
            bearings=projection.bearings(self._camera, points.pixels),
            scores=points.ages.astype(float),
        )
        if self._matcher is None:
            return VisualFeatures(frame=frame, tracks=tracks)
        right = self._prepare(frame, 1, self._matcher.right)
        return VisualFeatures(frame=frame, tracks=tracks, stereo=self._matcher.match(gray, right, tracks))

    def _stereo_matcher(self, rig: SensorRig) -> StereoMatcher:
        if len(rig.cameras) < 2:
            raise DataError(
                f"frontend.stereo=true needs two cameras, but the recording's calibration has {len(rig.cameras)}: use "
                "rig=stereo where it has them, or frontend.stereo=false"
            )
        return StereoMatcher(
            rig.cameras[0],
            rig.cameras[1],
            window_px=self._window[0],
            levels=self._levels,
            criteria=self._criteria,
            forward_backward_px=self._back_px,
            epipolar_px=self._outlier_px,
            min_depth=self._min_depth,
            border_px=self._border,
        )

    def _usable(self, camera: Camera) -> np.ndarray:
        """Every fourth pixel (H/4, W/4) uint8: 255 where the camera model can be inverted and the angle is allowed."""
        width, height = camera.size_px
        columns, rows = np.meshgrid(np.arange(0, width, 4.0), np.arange(0, height, 4.0))
        pixels = np.stack([columns, rows], axis=-1)
        # Beyond the range of its polynomial, a radial-tangential model folds back: its inverse then diverges.
        with np.errstate(all="ignore"):
            rays = projection.bearings(camera, pixels)
            back, _ = projection.project(camera, rays)
            usable = np.linalg.norm(back - pixels, axis=-1) < _INVERTIBLE_PX
        if self._max_angle_deg is not None:
            usable &= rays[..., 2] >= np.cos(np.radians(self._max_angle_deg))
        mask: np.ndarray = usable.astype(np.uint8) * 255
        return mask

    def _prepare(self, frame: Frame, index: int, camera: Camera) -> Image:
        if len(frame.images) <= index:
            raise DataError(
                f"frame at {frame.stamp_ns} ns has no image of camera {index}, and frontend=klt needs "
                f"{'one' if index == 0 else 'both where stereo=true'}"
            )
        image = frame.images[index]
        if image.shape[:2] != camera.size_px[::-1]:
            raise ShapeError(
                f"image of camera {index} at {frame.stamp_ns} ns is {image.shape[1]}×{image.shape[0]} px, but its "
                f"calibration says {camera.size_px[0]}×{camera.size_px[1]}: correct the calibration or the images"
            )
        gray = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        if self._clahe is not None:
            gray = self._clahe.apply(gray)
        if self._normalise:
            mean, deviation = (float(v[0, 0]) for v in cv2.meanStdDev(gray))
            gain = min(_TARGET_DEVIATION / max(deviation, 1e-3), _MAX_GAIN)
            levels = np.arange(256.0)
            table = np.clip(np.rint(_TARGET_MEAN + gain * (levels - mean)), 0, 255).astype(np.uint8)
            gray = cv2.LUT(gray, table)
        return np.ascontiguousarray(gray)

    def _follow(
        self,
        reference: Image,
        gray: Image,
        points: "_Points",
        R_prev_cur: Array | None,
        camera: Camera,
    ) -> "_Points":
        """The points that are found again in the image ``gray``."""
        R_cam = None
        expected = points.pixels
        bearings = projection.bearings(camera, points.pixels)
        if R_prev_cur is not None and self._predict:
            R_body_cam = camera.T_body_cam[:3, :3]
            R_cam = R_body_cam.T @ R_prev_cur @ R_body_cam
            turned, visible = projection.project(camera, bearings @ R_cam)
            expected = np.where(visible[:, None], turned, points.pixels)
        start = points.reference.astype(np.float32)
        # OpenCV's Python binding takes no pyramid built before (cv2.buildOpticalFlowPyramid), only images.
        found, status, _ = cv2.calcOpticalFlowPyrLK(
            reference,
            gray,
            start,
            expected.astype(np.float32),
            winSize=self._window,
            maxLevel=self._levels,
            criteria=self._criteria,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        # Starting at the reference position would hide a search that ran away by little; starting where the
        # whole way back is asked of it would fail on large motion. One level up bridges both.
        back, back_status, _ = cv2.calcOpticalFlowPyrLK(
            gray,
            reference,
            found,
            start.copy(),
            winSize=self._window,
            maxLevel=min(_LEVELS_BACK, self._levels),
            criteria=self._criteria,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        width, height = camera.size_px
        low = self._border - 0.5
        keep = (
            (status[:, 0] > 0)
            & (back_status[:, 0] > 0)
            & (np.linalg.norm(back - start, axis=-1) < self._back_px)
            & (found[:, 0] > low)
            & (found[:, 1] > low)
            & (found[:, 0] < width - 1 - low)
            & (found[:, 1] < height - 1 - low)
        )
        column = np.clip(np.rint(found[:, 0]), 0, width - 1).astype(int)
        row = np.clip(np.rint(found[:, 1]), 0, height - 1).astype(int)
        keep &= self._invertible[row, column] > 0
        followed = points.select(keep).moved(found[keep].astype(float))
        if self._reject and len(followed) >= 8:
            focal = float(np.mean(camera.intrinsics_px[:2]))
            inliers = epipolar_inliers(
                bearings[keep],
                projection.bearings(camera, followed.pixels),
                R_cam,
                self._outlier_px / focal,
                seed=self._images,
            )
            followed = followed.select(inliers)
        self._images += 1
        return followed

    def _renew(self, gray: Image, points: "_Points", room: int) -> "_Points":
        """Make this image the reference, and take new corners."""
        crowded = _too_close(points, 0.5 * self._min_distance)
        points = points.select(~crowded)
        corners = self._detector.detect(gray, points.pixels, room + int(crowded.sum()))
        ids = np.arange(self._next_id, self._next_id + len(corners), dtype=np.int64)
        self._next_id += len(corners)
        pixels = np.concatenate([points.pixels, corners])
        return _Points(
            ids=np.concatenate([points.ids, ids]),
            pixels=pixels,
            reference=pixels,
            ages=np.concatenate([points.ages, np.ones(len(corners), dtype=np.int64)]),
        )


class _Points:
    """Parallel arrays: ids (M,), pixels in the last image and in the reference (M, 2), images seen in (M,)."""

    __slots__ = ("ages", "ids", "pixels", "reference")

    def __init__(self, *, ids: np.ndarray, pixels: Array, reference: Array, ages: np.ndarray) -> None:
        self.ids = ids
        self.pixels = pixels
        self.reference = reference
        self.ages = ages

    def __len__(self) -> int:
        return len(self.ids)

    @staticmethod
    def none() -> "_Points":
        empty = np.zeros(0, dtype=np.int64)
        return _Points(ids=empty, pixels=np.zeros((0, 2)), reference=np.zeros((0, 2)), ages=empty)

    def select(self, keep: np.ndarray) -> "_Points":
        return _Points(
            ids=self.ids[keep], pixels=self.pixels[keep], reference=self.reference[keep], ages=self.ages[keep]
        )

    def moved(self, pixels: Array) -> "_Points":
        return _Points(ids=self.ids, pixels=pixels, reference=self.reference, ages=self.ages + 1)


def _too_close(points: _Points, distance: float) -> np.ndarray:
    """Mark the younger of two points that have run together (M,)."""
    count = len(points)
    if count < 2:
        return np.zeros(count, dtype=bool)
    offsets = points.pixels[:, None] - points.pixels[None]
    near = (offsets * offsets).sum(axis=-1) < distance * distance
    older = (points.ages[None] > points.ages[:, None]) | (
        (points.ages[None] == points.ages[:, None]) & (points.ids[None] < points.ids[:, None])
    )
    crowded: np.ndarray = (near & older).any(axis=1)
    return crowded


def _require(option: str, value: object, good: bool, rule: str) -> None:
    if not good:
        raise ConfigError(f"frontend.{option} must be {rule}, got {value}")
