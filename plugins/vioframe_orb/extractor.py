"""Corners described by ORB's binary tests (Rublee et al. 2011)."""

import cv2
import numpy as np

from vioframe.types import Image
from vioframe.vision.corners import CornerDetector, place_corners
from vioframe.vision.keypoints import Keypoints

_BYTES = 32
_PATCH_PX = 31


class OrbExtractor:
    """Shi-Tomasi corners spread over the image, with ORB's descriptors.

    FAST, which ORB begins with, finds corners at whole pixels of a pyramid: their place in the next image differs by
    more than what odometry can live with. The smaller eigenvalue has a maximum to a fraction of a pixel.

    Args:
        count: most keypoints an image.
        spacing_px: least distance between two.
        quality: fraction of the strongest corner's smaller eigenvalue a corner needs.
        min_gradient: square root of that eigenvalue a corner needs at least, grey levels a pixel.
        subpixel_px: half side of the window in which a corner is placed where the gradients meet; 0 leaves it at the
            maximum of the eigenvalue.
        upright: describe patches as they lie in the image, instead of turned to their brightest side.
    """

    def __init__(
        self,
        *,
        count: int,
        spacing_px: float,
        quality: float,
        min_gradient: float,
        subpixel_px: int,
        upright: bool,
    ) -> None:
        self._count = count
        self._spacing = spacing_px
        self._quality = quality
        self._min_gradient = min_gradient
        self._subpixel = subpixel_px
        self._upright = upright
        # ORB pads its image itself; the caller's mask says how near to the edge a point may lie.
        self._orb = cv2.ORB.create(nlevels=1, edgeThreshold=3, patchSize=_PATCH_PX)

    def extract(self, gray: Image, allowed: np.ndarray) -> Keypoints:
        """At most ``count`` keypoints, strong ones and empty parts of the image first."""
        detector = CornerDetector(
            min_distance_px=self._spacing,
            quality=self._quality,
            min_gradient=self._min_gradient,
            scale=2,
            allowed=allowed,
        )
        pixels, scores = detector.detect(gray, np.zeros((0, 2)), self._count)
        pixels = place_corners(gray, pixels, self._subpixel)
        if len(pixels) == 0:
            return Keypoints(pixels=pixels, scores=scores, descriptors=np.zeros((0, _BYTES), np.uint8))
        angles = np.zeros(len(pixels)) if self._upright else orientations(gray, pixels)
        points = [
            cv2.KeyPoint(x, y, _PATCH_PX, angle, 1.0, 0, index)
            for index, ((x, y), angle) in enumerate(zip(pixels.tolist(), angles.tolist(), strict=True))
        ]
        kept, descriptors = self._orb.compute(gray, points)
        # Points whose patch would leave the image are left out.
        rows = np.array([point.class_id for point in kept], dtype=int)
        return Keypoints(pixels=pixels[rows], scores=scores[rows], descriptors=descriptors)


def orientations(gray: Image, pixels: np.ndarray) -> np.ndarray:
    """Direction (M,) in degrees of the centre of brightness of each point's round patch (Rosin 1999)."""
    half = _PATCH_PX // 2
    reach = np.arange(-half, half + 1, dtype=np.float32)
    x, y = np.meshgrid(reach, reach)
    disc = x * x + y * y <= half * half
    offsets = np.stack([x[disc], y[disc]], axis=-1)
    where = pixels[:, None, :].astype(np.float32) + offsets
    patch = cv2.remap(gray, where, None, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REFLECT_101).astype(np.float32)
    moments = patch @ offsets
    angles: np.ndarray = np.degrees(np.arctan2(moments[:, 1], moments[:, 0])) % 360.0
    return angles
