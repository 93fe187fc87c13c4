"""How a keyframe looks: corners with binary descriptors, at the tracked points and beside them."""

from dataclasses import dataclass

import cv2
import numpy as np

from vioframe.checks import Array, Stamps
from vioframe.geometry import camera as projection
from vioframe.types import Camera, Image, Tracks
from vioframe.vision.keypoints import Keypoints

BYTES = 32
"""Length of a descriptor: 256 comparisons."""
NO_TRACK = -1
"""Id of a corner that nobody follows."""

# The descriptor compares pixels up to 18 px from its centre.
_BORDER_PX = 19
# Rays further off the axis say little about a direction in the image plane.
_MIN_COSINE = 0.2
# Corners found for each corner wanted, above and below which the threshold follows.
_ENOUGH, _SCARCE = 6, 3
# Seed of the planes that learned descriptors are cut by: another one would make saved maps unreadable.
_PLANES_SEED = 20_021


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Appearance:
    """Corners of one image.

    Attributes:
        ids: (N,) of the track at the corner, or ``NO_TRACK``.
        pixels: (N, 2) px, raw.
        bearings: (N, 3) unit vectors in the camera.
        descriptors: (N, 32) uint8.
    """

    ids: Stamps
    pixels: Array
    bearings: Array
    descriptors: np.ndarray

    def __len__(self) -> int:
        return len(self.ids)


class Describer:
    """Turns images into appearances.

    Descriptors are oriented BRIEF (Rublee et al., "ORB", ICCV 2011), turned by the direction in which gravity
    pulls in the image instead of by the image's own gradient: a tight estimator knows it to a fraction of a degree.
    A front end's own descriptors are taken instead where it has them; learned ones, of real numbers, become
    binary by the side of random planes on which they lie (Charikar, STOC 2002).

    Args:
        camera: that took the images.
        corners: most corners beside the tracked points.
        threshold: of FAST, grey levels.
        cell_px: at most one such corner in a square of this side.
    """

    def __init__(self, camera: Camera, *, corners: int, threshold: int, cell_px: int) -> None:
        self._camera = camera
        self._corners = corners
        self._cell_px = cell_px
        self._lowest = threshold
        self._fast = cv2.FastFeatureDetector.create(threshold=threshold)
        self._orb = cv2.ORB.create(nfeatures=100_000, nlevels=1, edgeThreshold=_BORDER_PX)
        self._planes: Array | None = None

    def describe(self, image: Image, tracks: Tracks, down_cam: Array, untracked: Keypoints | None = None) -> Appearance:
        """Corners of an image.

        Args:
            image: (H, W) or (H, W, 3).
            tracks: points followed in it.
            down_cam: (3,) direction of gravity in the camera.
            untracked: points of the image beside them, where the front end describes such.
        """
        if tracks.descriptors is not None and len(tracks):
            return self._as_described(tracks, tracks.descriptors, untracked)
        grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        extra = self._detect(grey, tracks.pixels)
        ids = np.concatenate([tracks.ids, np.full(len(extra), NO_TRACK, dtype=np.int64)])
        pixels = np.concatenate([tracks.pixels, extra])
        bearings = np.concatenate([tracks.bearings, projection.bearings(self._camera, extra)])
        degrees = _degrees_of_down(bearings, down_cam)
        points = [
            cv2.KeyPoint(x, y, 31.0, angle, 0.0, 0, index)
            for index, ((x, y), angle) in enumerate(zip(pixels.tolist(), degrees.tolist(), strict=True))
        ]
        described, descriptors = self._orb.compute(grey, points)
        kept = np.array([point.class_id for point in described], dtype=np.int64)
        return Appearance(
            ids=ids[kept],
            pixels=pixels[kept],
            bearings=bearings[kept],
            descriptors=np.zeros((0, BYTES), np.uint8) if descriptors is None else descriptors,
        )

    def _as_described(self, tracks: Tracks, descriptors: np.ndarray, untracked: Keypoints | None) -> Appearance:
        """By the front end's own descriptors, of the tracks and of the strongest points beside them."""
        if untracked is None or not len(untracked) or not self._corners:
            return Appearance(
                ids=tracks.ids, pixels=tracks.pixels, bearings=tracks.bearings, descriptors=self._binary(descriptors)
            )
        extra = untracked.select(np.argsort(-untracked.scores, kind="stable")[: self._corners])
        return Appearance(
            ids=np.concatenate([tracks.ids, np.full(len(extra), NO_TRACK, dtype=np.int64)]),
            pixels=np.concatenate([tracks.pixels, extra.pixels]),
            bearings=np.concatenate([tracks.bearings, projection.bearings(self._camera, extra.pixels)]),
            descriptors=self._binary(np.concatenate([descriptors, extra.descriptors])),
        )

    def _detect(self, grey: Image, taken: Array) -> Array:
        """The strongest corner (N, 2) of every cell without a tracked point, spread over the image."""
        if self._corners == 0:
            return np.zeros((0, 2))
        found = self._fast.detect(grey)
        # FAST takes as long as it finds corners; the next image is much like this one.
        change = 1.25 if len(found) > _ENOUGH * self._corners else 0.8 if len(found) < _SCARCE * self._corners else 1.0
        self._fast.setThreshold(max(round(change * self._fast.getThreshold()), self._lowest))
        if not found:
            return np.zeros((0, 2))
        pixels: Array = np.array([point.pt for point in found])
        response = np.array([point.response for point in found])
        columns = grey.shape[1] // self._cell_px + 1
        cell = self._cell(pixels, columns)
        free = ~np.isin(cell, self._cell(taken, columns))
        order = np.flatnonzero(free)[np.lexsort((-response[free], cell[free]))]
        best = order[np.concatenate([[True], np.diff(cell[order]) > 0])] if len(order) else order
        strongest = best[np.argsort(-response[best], kind="stable")[: self._corners]]
        return pixels[strongest]

    def _cell(self, pixels: Array, columns: int) -> np.ndarray:
        square = (pixels // self._cell_px).astype(np.int64)
        number: np.ndarray = square[:, 1] * columns + square[:, 0]
        return number

    def _binary(self, descriptors: np.ndarray) -> np.ndarray:
        if descriptors.dtype == np.uint8 and descriptors.shape[1] == BYTES:
            return descriptors
        values = descriptors.astype(float)
        if self._planes is None or len(self._planes) != values.shape[1]:
            self._planes = np.random.default_rng(_PLANES_SEED).standard_normal((values.shape[1], 8 * BYTES))
        return np.packbits(values @ self._planes > 0.0, axis=1)


def _degrees_of_down(bearings: Array, down_cam: Array) -> Array:
    """Angle (N,) that gravity's direction in the image at a bearing (N, 3) has turned from straight down."""
    depth = np.maximum(bearings[:, 2:], _MIN_COSINE)
    toward = down_cam[:2] - bearings[:, :2] / depth * down_cam[2]
    degrees: Array = np.degrees(np.arctan2(toward[:, 1], toward[:, 0])) - 90.0
    return degrees % 360.0
