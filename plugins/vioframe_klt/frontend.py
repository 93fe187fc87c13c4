"""The front end: corners followed from image to image, held by the patch they began with."""

import logging
from collections.abc import Mapping
from typing import ClassVar

import cv2
import numpy as np

from vioframe.checks import Array, Mask
from vioframe.errors import ConfigError, DataError, StateError
from vioframe.geometry import camera as projection
from vioframe.interfaces import IMAGES, STEREO, STEREO_TRACKS, TRACKS, Frontend
from vioframe.types import Camera, Frame, Image, SensorRig, Tracks, VisualFeatures
from vioframe.vision.anchors import Anchors
from vioframe.vision.corners import CornerDetector
from vioframe.vision.gray import gray_image, normalise_exposure
from vioframe.vision.outliers import epipolar_inliers
from vioframe.vision.spread import crowded
from vioframe.vision.two_cameras import TwoCameras
from vioframe_klt.points import Points, inside
from vioframe_klt.search import Search
from vioframe_klt.stereo import StereoMatcher

log = logging.getLogger(__name__)

# New corners are taken when fewer than this share of the points is left; where the image has few corners, every so
# many images in the hope of more; and where there is next to nothing, at once.
_MIN_KEPT = 0.9
_SCARCE = 0.3
_RETRY_IMAGES = 5
_INVERTIBLE_PX = 0.5
# A template bent by more than this in any direction no longer shows what the image can.
_MAX_STRETCH = 2.0
_FEWEST_JUDGED = 8
# With so many lost for each that is left, what is left is most likely chance, unless it is as many as this.
_MANY_LOST = 5
_ENOUGH = 20


class KltFrontend(Frontend):
    """Shi-Tomasi corners followed by pyramidal Lucas–Kanade (Bouguet 2001), with lasting ids.

    Lucas–Kanade from the image before finds a point; aligning the patch it began with, under an affine warp, then
    says where exactly it is, and whether it still is the same point. Errors so do not add up along a track.

    Args:
        stereo: also find the points in camera 1.
        min_depth: nearer points are not looked for there, m.
        max_points: most points followed at once.
        min_distance_px: between points, when new ones are taken.
        quality: fraction of the strongest corner's smaller eigenvalue a corner needs.
        min_gradient: square root of that eigenvalue a corner needs at least, grey levels a pixel.
        detection_scale: 1, or 2 to look for corners in the half-size image.
        window_px: odd side of the patch that is searched for.
        levels: pyramid levels above the full image.
        max_steps: of Lucas–Kanade, a level.
        step_px: shorter steps end the search.
        anchor_window_px: odd side of the patch that a point began with.
        anchor_steps: to align it, an image.
        anchor_reach_px: largest distance of the aligned point from where the search put it.
        min_correlation: of the patch that a point began with and what is seen now.
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
        max_points: int = 150,
        min_distance_px: float = 22.0,
        quality: float = 0.01,
        min_gradient: float = 1.0,
        detection_scale: int = 2,
        window_px: int = 15,
        levels: int = 3,
        max_steps: int = 10,
        step_px: float = 0.03,
        anchor_window_px: int = 19,
        anchor_steps: int = 2,
        anchor_reach_px: float = 2.0,
        min_correlation: float = 0.8,
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
        sound = anchor_window_px >= 7 and anchor_window_px % 2 == 1
        _require("anchor_window_px", anchor_window_px, sound, "odd and at least 7")
        _require("anchor_steps", anchor_steps, anchor_steps >= 1, "at least 1")
        _require("anchor_reach_px", anchor_reach_px, anchor_reach_px > 0.0, "positive")
        _require("min_correlation", min_correlation, 0.0 <= min_correlation < 1.0, "at least 0 and below 1")
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
        self._window = window_px
        self._levels = levels
        self._max_steps = max_steps
        self._step_px = step_px
        self._anchor_window = anchor_window_px
        self._anchor_steps = anchor_steps
        self._anchor_reach = anchor_reach_px
        self._min_correlation = min_correlation
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
        if self._stereo and len(rig.cameras) < 2:
            raise DataError(
                f"frontend.stereo=true needs two cameras, but the recording's calibration has {len(rig.cameras)}: use "
                "rig=stereo where it has them, or frontend.stereo=false"
            )
        camera = rig.cameras[0]
        width, height = camera.size_px
        if min(width, height) <= 2 * self._border + self._anchor_window:
            raise DataError(
                f"frontend.border_px={self._border} and anchor_window_px={self._anchor_window} leave nothing of images "
                f"of {width}×{height} px: make them smaller"
            )
        self._camera = camera
        self._allowed = _usable(camera, self._border, self._max_angle_deg)
        self._detector = CornerDetector(
            min_distance_px=self._min_distance,
            quality=self._quality,
            min_gradient=self._min_gradient,
            scale=self._detection_scale,
            allowed=self._allowed,
        )
        self._search = self._searcher(camera)
        self._matcher = self._stereo_matcher(rig) if self._stereo else None
        self._next_id = 0
        self._images = 0
        self._lost_all = 0
        self._lost_told = False
        self._since_corners = 0
        self._after_corners = 0
        self._before: Image | None = None
        self._points = Points.none()
        self._anchors = Anchors(self._anchor_window)

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
        right = self._prepare(frame, 1, self._matcher.cameras.right) if self._matcher else None
        if self._before is not None and len(self._points):
            self._follow(self._before, gray, R_prev_cur, self._camera)
            if len(self._points):
                self._lost_told = False
            else:
                self._lost_all += 1
                # In the dark it may go on for minutes, image after image.
                if not self._lost_told:
                    log.warning("KLT: all points were lost at stamp %d ns", frame.stamp_ns)
                self._lost_told = True
        self._since_corners += 1
        count = len(self._points)
        worn = count < _MIN_KEPT * self._after_corners
        hopeful = self._since_corners >= _RETRY_IMAGES or count < _SCARCE * self._max_points
        if count < _MIN_KEPT * self._max_points and (worn or hopeful):
            self._take_corners(gray, self._camera)
        self._before = gray
        self._images += 1
        points = self._points
        tracks = Tracks(
            ids=points.ids, pixels=points.pixels, bearings=points.bearings, scores=points.ages.astype(float)
        )
        stereo = None
        if self._matcher is not None and right is not None:
            stereo = self._matcher.match(gray, right, tracks, self._anchors)
        return VisualFeatures(frame=frame, tracks=tracks, stereo=stereo)

    def _searcher(self, camera: Camera) -> Search:
        return Search(
            camera, window_px=self._window, levels=self._levels, max_steps=self._max_steps, step_px=self._step_px
        )

    def _stereo_matcher(self, rig: SensorRig) -> StereoMatcher:
        left, right = rig.cameras[:2]
        return StereoMatcher(
            TwoCameras(left, right, epipolar_px=self._outlier_px, min_depth=self._min_depth),
            self._searcher(right),
            allowed=_usable(right, self._border, self._max_angle_deg),
            anchor_steps=self._anchor_steps,
            anchor_reach_px=self._anchor_reach,
            min_correlation=self._min_correlation,
        )

    def _prepare(self, frame: Frame, index: int, camera: Camera) -> Image:
        gray = gray_image(frame, index, camera, "klt")
        if self._clahe is not None:
            gray = self._clahe.apply(gray)
        return normalise_exposure(gray) if self._normalise else gray

    def _follow(self, before: Image, gray: Image, R_prev_cur: Array | None, camera: Camera) -> None:
        """Keep the points that are found again in the image ``gray``."""
        R_cam = None
        if R_prev_cur is not None and self._predict:
            R_body_cam = camera.T_body_cam[:3, :3]
            R_cam = R_body_cam.T @ R_prev_cur @ R_body_cam
        count = len(self._points)
        found, turn, good = self._search.follow(before, gray, self._points.pixels, self._points.bearings, R_cam)
        good &= inside(self._allowed, found)
        self._keep(good)
        found = found[good]
        bend = self._anchors.bend if turn is None else turn[good] @ self._anchors.bend
        pixels, self._anchors.bend, correlation = self._anchors.align(gray, found, bend, self._anchor_steps)
        good = (
            (correlation > self._min_correlation)
            & (np.linalg.norm(pixels - found, axis=-1) < self._anchor_reach)
            & inside(self._allowed, pixels)
        )
        self._keep(good)
        pixels = pixels[good]
        bearings = projection.bearings(camera, pixels)
        before_bearings = self._points.bearings
        self._points = self._points.moved(pixels, bearings)
        if self._reject:
            self._keep(self._agreeing(before_bearings, bearings, R_cam, camera, lost=count - len(pixels)))
        stretch = np.linalg.svd(self._anchors.bend, compute_uv=False)
        rows = np.flatnonzero((stretch[:, 0] > _MAX_STRETCH) | (stretch[:, 1] < 1.0 / _MAX_STRETCH))
        if len(rows):
            self._anchors.renew(gray, self._points.pixels[rows], rows)

    def _agreeing(self, before: Array, now: Array, R_cam: Array | None, camera: Camera, lost: int) -> Mask:
        """Which points (M,) move as the rest; none where so few are left of many that they cannot be judged."""
        agree = np.ones(len(now), dtype=bool)
        if len(now) >= _FEWEST_JUDGED:
            threshold = self._outlier_px / float(np.mean(camera.intrinsics_px[:2]))
            agree = epipolar_inliers(before, now, R_cam, threshold, seed=self._images)
        left = int(agree.sum())
        return agree & (left >= _ENOUGH or lost + len(now) - left < _MANY_LOST * left)

    def _keep(self, keep: Mask) -> None:
        if not keep.all():
            self._points = self._points.select(keep)
            self._anchors.select(keep)

    def _take_corners(self, gray: Image, camera: Camera) -> None:
        """Thin points that have run together, and take new corners where there is room."""
        points = self._points
        self._keep(~crowded(points.pixels, points.ages, points.ids, 0.5 * self._min_distance))
        corners, _ = self._detector.detect(gray, self._points.pixels, self._max_points - len(self._points))
        ids = np.arange(self._next_id, self._next_id + len(corners), dtype=np.int64)
        self._next_id += len(corners)
        self._points = self._points.joined(ids, corners, projection.bearings(camera, corners))
        self._anchors.add(gray, corners)
        self._since_corners, self._after_corners = 0, len(self._points)


def _usable(camera: Camera, border: int, max_angle_deg: float | None) -> np.ndarray:
    """255 in (H, W) uint8 where points are followed: off the edge, in the range of the camera model, and near enough
    to the optical axis; decided at every fourth pixel."""
    width, height = camera.size_px
    columns, rows = np.meshgrid(np.arange(0, width, 4.0), np.arange(0, height, 4.0))
    pixels = np.stack([columns, rows], axis=-1)
    # Beyond the range of its polynomial, a radial-tangential model folds back: its inverse then diverges.
    with np.errstate(all="ignore"):
        rays = projection.bearings(camera, pixels)
        back, _ = projection.project(camera, rays)
        usable = np.linalg.norm(back - pixels, axis=-1) < _INVERTIBLE_PX
    if max_angle_deg is not None:
        usable &= rays[..., 2] >= np.cos(np.radians(max_angle_deg))
    mask = cv2.resize(usable.astype(np.uint8) * 255, (width, height), interpolation=cv2.INTER_NEAREST)
    allowed = np.zeros((height, width), np.uint8)
    inner = slice(border, height - border), slice(border, width - border)
    allowed[inner] = mask[inner]
    return allowed


def _require(option: str, value: object, good: bool, rule: str) -> None:
    if not good:
        raise ConfigError(f"frontend.{option} must be {rule}, got {value}")
