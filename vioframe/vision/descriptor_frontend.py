"""A front end of any keypoints with descriptors: extract, match, keep."""

from collections.abc import Mapping, Sequence

import cv2
import numpy as np

from vioframe.checks import Array, Mask, Stamps
from vioframe.errors import DataError, StateError
from vioframe.geometry import camera as projection
from vioframe.interfaces import IMAGES, STEREO, STEREO_TRACKS, TRACKS, Frontend
from vioframe.types import Camera, Frame, Image, SensorRig, Tracks, VisualFeatures
from vioframe.vision.gray import gray_image, normalise_exposure
from vioframe.vision.keeper import Follow, KeeperOptions, TrackKeeper
from vioframe.vision.keypoints import Extractor, Keypoints
from vioframe.vision.matching import match
from vioframe.vision.placing import AnchoredPlaces, AnchorOptions
from vioframe.vision.two_cameras import TwoCameras


class DescriptorFrontend(Frontend):
    """Tracks of the keypoints that an extractor finds in each image by itself.

    What is found is the extractor's business; which of them are the same point, the keeper's. A subclass brings
    an extractor and the options of its users.

    Args:
        name: as the user calls it, for messages.
        extractor: of keypoints and descriptors.
        options: of the keeper.
        stereo: also match with camera 1.
        min_depth: nearer points are not matched there, m.
        normalise: bring every image to one mean and contrast.
        border_px: no points nearer to the edge of the image.
        anchors: place matched points by their patches.
    """

    def __init__(
        self,
        *,
        name: str,
        extractor: Extractor,
        options: KeeperOptions,
        stereo: bool,
        min_depth: float,
        normalise: bool,
        border_px: int,
        anchors: AnchorOptions,
    ) -> None:
        # What it needs and gives depends on its options, so the instance says it, not the class.
        self.requires = frozenset({IMAGES, STEREO} if stereo else {IMAGES})  # type: ignore[misc]
        self.provides = frozenset({TRACKS, STEREO_TRACKS} if stereo else {TRACKS})  # type: ignore[misc]
        self._name = name
        self._extractor = extractor
        self._options = options
        self._stereo = stereo
        self._min_depth = min_depth
        self._normalise = normalise
        self._border = border_px
        self._anchors = anchors
        self._camera: Camera | None = None

    def setup(self, rig: SensorRig) -> None:
        """Forget all points; ids start again at 0.

        Raises:
            DataError: the rig has fewer cameras than are looked at, or two at one place.
        """
        needed = 2 if self._stereo else 1
        if len(rig.cameras) < needed:
            raise DataError(
                f"frontend={self._name}{' with stereo=true' * self._stereo} needs {needed} camera"
                f"{'s' * self._stereo}, but the recording's calibration has {len(rig.cameras)}"
            )
        self._camera = rig.cameras[0]
        self._cameras = rig.cameras[:needed]
        self._masks = [_inner(camera, self._border) for camera in self._cameras]
        self._keeper = TrackKeeper(self._camera, self._options)
        self._pair = (
            TwoCameras(*self._cameras, epipolar_px=self._options.outlier_px, min_depth=self._min_depth)
            if self._stereo
            else None
        )
        self._places = AnchoredPlaces(self._anchors) if self._anchors.window_px else None
        self._points = 0
        self._lost_all = 0

    def counters(self) -> Mapping[str, int]:
        """How often every point was lost at once."""
        return {"lost all tracks": self._lost_all} if self._camera is not None and self._lost_all else {}

    def process(self, frame: Frame, R_prev_cur: Array | None = None) -> VisualFeatures:
        """Find the points of the image, and their ids.

        Scores are the number of images a point has been seen in.

        Raises:
            StateError: called before ``setup``.
            DataError: the frame lacks an image, or has one that does not fit the calibration.
        """
        grays = self.gray_images(frame)
        keypoints = [self._extractor.extract(gray, mask) for gray, mask in zip(grays, self.masks, strict=True)]
        return self.follow(frame, grays, keypoints, R_prev_cur)

    @property
    def masks(self) -> list[np.ndarray]:
        """(H, W) uint8 for each camera that is looked at, not 0 where a point may lie.

        Raises:
            StateError: called before ``setup``.
        """
        self._calibrated()
        return self._masks

    def gray_images(self, frame: Frame) -> list[Image]:
        """The image (H, W) uint8 of each camera that is looked at, as the extractor is given it; errors as above."""
        self._calibrated()
        grays = [gray_image(frame, index, camera, self._name) for index, camera in enumerate(self._cameras)]
        return [normalise_exposure(gray) for gray in grays] if self._normalise else grays

    def follow(
        self, frame: Frame, grays: Sequence[Image], keypoints: Sequence[Keypoints], R_prev_cur: Array | None
    ) -> VisualFeatures:
        """What :meth:`process` returns.

        Args:
            frame: the next.
            grays: its images, as :meth:`gray_images` has them.
            keypoints: that were found in the image of each camera.
            R_prev_cur: as of :meth:`process`.
        """
        camera = self._calibrated()
        R_cam = None
        if R_prev_cur is not None:
            R_body_cam = camera.T_body_cam[:3, :3]
            R_cam = R_body_cam.T @ R_prev_cur @ R_body_cam
        kept = self._keeper.keep(keypoints[0], R_cam, self._follower(grays[0]))
        pixels = kept.points.pixels
        if self._places is not None:
            pixels, slipped = self._places.place(grays[0], kept.ids, pixels)
            self._keeper.forget(kept.ids[slipped])
            kept, pixels = kept.select(~slipped), pixels[~slipped]
        self._lost_all += self._points > 0 and not (kept.ages > 1).any()
        self._points = len(kept.ids)
        tracks = Tracks(
            ids=kept.ids,
            pixels=pixels,
            bearings=projection.bearings(camera, pixels),
            scores=kept.ages.astype(float),
            descriptors=kept.points.descriptors,
        )
        stereo = None
        if self._pair is not None:
            stereo = self._match_stereo(tracks, self._pair, kept.points, keypoints[1], grays[1])
        rest = np.setdiff1d(np.arange(len(keypoints[0])), kept.index)
        return VisualFeatures(frame=frame, tracks=tracks, stereo=stereo, untracked=keypoints[0].select(rest))

    def _follower(self, gray: Image) -> Follow | None:
        """What looks in an image for points that no keypoint matches."""
        places, mask = self._places, self.masks[0]
        if places is None or not self._anchors.follow:
            return None

        def follow(ids: Stamps, expected: Array) -> tuple[Array, Mask]:
            pixels, found = places.follow(gray, ids, expected)
            column, row = np.clip(np.rint(pixels).astype(int), 0, np.array(mask.shape[::-1]) - 1).T
            return pixels, found & (mask[row, column] != 0)

        return follow

    def _calibrated(self) -> Camera:
        if self._camera is None:
            raise StateError(f"{type(self).__name__}.process was called before setup(rig): set it up first")
        return self._camera

    def _match_stereo(
        self, tracks: Tracks, pair: TwoCameras, points: Keypoints, keypoints: Keypoints, gray: Image
    ) -> Tracks:
        """The points that camera 1 sees too."""
        bearings = projection.bearings(self._cameras[1], keypoints.pixels)
        rows, columns = pair.possible_pairs(tracks.bearings, bearings)
        rows, columns = match(
            points.descriptors,
            keypoints.descriptors,
            rows,
            columns,
            max_distance=self._options.max_distance,
            ratio=self._options.ratio,
        )
        pixels, bearings = keypoints.pixels[columns], bearings[columns]
        if self._places is not None:
            pixels, slipped = self._places.place_elsewhere(gray, tracks.ids[rows], pixels)
            rows, columns, pixels = rows[~slipped], columns[~slipped], pixels[~slipped]
            bearings = projection.bearings(self._cameras[1], pixels)
        return Tracks(
            ids=tracks.ids[rows],
            pixels=pixels,
            bearings=bearings,
            scores=tracks.scores[rows],
            descriptors=keypoints.descriptors[columns],
            camera=1,
        )


def _inner(camera: Camera, border: int) -> np.ndarray:
    """255 in (H, W) uint8 off the edge and where the camera model can be inverted; decided at every fourth pixel."""
    width, height = camera.size_px
    columns, rows = np.meshgrid(np.arange(0, width, 4.0), np.arange(0, height, 4.0))
    pixels = np.stack([columns, rows], axis=-1)
    with np.errstate(all="ignore"):
        back, _ = projection.project(camera, projection.bearings(camera, pixels))
        usable = np.linalg.norm(back - pixels, axis=-1) < 0.5
    mask = cv2.resize(usable.astype(np.uint8) * 255, (width, height), interpolation=cv2.INTER_NEAREST)
    allowed = np.zeros((height, width), np.uint8)
    allowed[border : height - border, border : width - border] = mask[border : height - border, border : width - border]
    return allowed
