"""ORB as it was published: oriented FAST corners of a pyramid with rotated binary tests (Rublee et al. 2011)."""

from collections.abc import Sequence

import cv2
import numpy as np

from vioframe.checks import Array, check_positive
from vioframe.errors import ConfigError
from vioframe.types import Image
from vioframe.vision.keypoints import Keypoints
from vioframe_opencv.choice import Choice

_BYTES = 32


class OrbExtractor:
    """OpenCV's ORB, the strongest points of all levels, put where they belong to a fraction of a pixel.

    Args:
        count: most points.
        suppression_px: half side of the square in which a point gives way to a stronger one.
        candidates: points that ORB distributes over its levels before that, as a multiple of ``count``.
        threshold: of FAST, grey levels.
        edge_px: no points nearer than this to the edge of their level.
        levels: of the pyramid.
        scale: between two of them.

    Raises:
        ConfigError: an option outside its range.
    """

    def __init__(
        self,
        *,
        count: int,
        suppression_px: int,
        candidates: float,
        threshold: int,
        edge_px: int,
        levels: int,
        scale: float,
    ) -> None:
        check_positive("feature", candidates=candidates, threshold=threshold, levels=levels)
        if scale <= 1.0:
            raise ConfigError(f"feature.scale must be above 1, got {scale}")
        self._choice = Choice(count=count, suppression_px=suppression_px, spread=False)
        self._scale = scale
        self._orb = cv2.ORB.create(
            nfeatures=round(candidates * count),
            scaleFactor=scale,
            nlevels=levels,
            edgeThreshold=edge_px,
            fastThreshold=threshold,
        )

    def extract(self, gray: Image, allowed: np.ndarray) -> Keypoints:
        """The strongest points where ``allowed`` is not 0, with 256 bits each; scores are Harris' measure."""
        found = self._orb.detect(gray, allowed)
        pixels, scores = self._places(found, gray.shape), np.array([point.response for point in found])
        chosen = self._choice.of(pixels, scores, allowed)
        points = [found[index] for index in chosen.tolist()]
        for number, point in enumerate(points):
            point.class_id = number
        kept, descriptors = self._orb.compute(gray, points)
        rows = chosen[[point.class_id for point in kept]]
        if not kept:
            descriptors = np.zeros((0, _BYTES), np.uint8)
        return Keypoints(pixels=pixels[rows], scores=scores[rows], descriptors=descriptors)

    def _places(self, points: "Sequence[cv2.KeyPoint]", shape: tuple[int, ...]) -> Array:
        """Where points (M, 2) are in an image of a shape (H, W).

        OpenCV multiplies the place on a level by its scale, but a level has whole pixels in number, and the centre of
        its pixel x lies at s (x + 1/2) − 1/2 for the ratio s of both widths.
        """
        scale = self._scale ** np.array([point.octave for point in points]).reshape(-1, 1)
        size = np.array([shape[1], shape[0]], dtype=float)
        ratio = size / np.rint(size / scale)
        places = np.array([point.pt for point in points]).reshape(-1, 2)
        centres: Array = (places / scale + 0.5) * ratio - 0.5
        return centres
