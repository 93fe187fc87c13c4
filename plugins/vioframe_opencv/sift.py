"""SIFT: extrema of a scale space, described by histograms of gradients (Lowe 2004)."""

import cv2
import numpy as np

from vioframe.checks import check_positive
from vioframe.errors import ConfigError
from vioframe.types import Image
from vioframe.vision.keypoints import Keypoints
from vioframe_opencv.choice import Choice

_NUMBERS = 128


class SiftExtractor:
    """OpenCV's SIFT; descriptors are unit vectors of 128 numbers.

    The upscaling of its first octave is the precise one: the other shifts all points by a quarter of a pixel.

    Args:
        count: most points.
        suppression_px: see :class:`Choice`.
        spread: see :class:`Choice`.
        contrast: least contrast of an extremum, relative to the range of grey levels; divided by the layers.
        edge: largest ratio of the principal curvatures of an extremum.
        layers: of an octave.
        sigma: blur of the first octave, px.
        upright: describe patches as they lie in the image, instead of turned to their strongest gradients.

    Raises:
        ConfigError: an option outside its range.
    """

    def __init__(
        self,
        *,
        count: int,
        suppression_px: int,
        spread: bool,
        contrast: float,
        edge: float,
        layers: int,
        sigma: float,
        upright: bool,
    ) -> None:
        check_positive("feature", contrast=contrast, layers=layers, sigma=sigma)
        if edge <= 1.0:
            raise ConfigError(f"feature.edge must be above 1, got {edge}")
        self._choice = Choice(count=count, suppression_px=suppression_px, spread=spread)
        self._upright = upright
        self._sift = cv2.SIFT.create(
            nfeatures=0,
            nOctaveLayers=layers,
            contrastThreshold=contrast,
            edgeThreshold=edge,
            sigma=sigma,
            enable_precise_upscale=True,
        )

    def extract(self, gray: Image, allowed: np.ndarray) -> Keypoints:
        """At most ``count`` points where ``allowed`` is not 0; scores are their contrasts."""
        every = self._sift.detect(gray, allowed)
        pixels = np.array([point.pt for point in every]).reshape(-1, 2)
        chosen = self._choice.of(pixels, np.array([point.response for point in every]), allowed)
        found = [every[index] for index in chosen.tolist()]
        if self._upright:
            for point in found:
                point.angle = 0.0
        kept, histograms = self._sift.compute(gray, found)
        if not kept:
            return Keypoints(
                pixels=np.zeros((0, 2)), scores=np.zeros(0), descriptors=np.zeros((0, _NUMBERS), np.float32)
            )
        pixels = np.array([point.pt for point in kept], dtype=float)
        length = np.linalg.norm(histograms, axis=1, keepdims=True)
        return Keypoints(
            pixels=pixels,
            scores=np.array([point.response for point in kept]),
            descriptors=(histograms / np.maximum(length, 1e-6)).astype(np.float32),
        )
