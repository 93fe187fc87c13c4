"""Which of OpenCV's keypoints are kept: the strongest, or those that cover the image."""

from dataclasses import dataclass

import numpy as np

from vioframe.checks import Array, check_not_negative, check_positive
from vioframe.vision.spread import choose_spread
from vioframe.vision.suppression import strongest


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice:
    """How keypoints are chosen.

    Attributes:
        count: most.
        suppression_px: least distance of two; where the strongest are wanted, half side of the square around a point in
            which weaker ones give way, so that of several scales and orientations at one place one remains.
        spread: empty parts of the image first, instead of the strongest.

    Raises:
        ConfigError: with the key and its value.
    """

    count: int
    suppression_px: int
    spread: bool

    def __post_init__(self) -> None:
        check_positive("feature", count=self.count)
        check_not_negative("feature", suppression_px=self.suppression_px)
        if self.spread:
            # The distance is what cells of candidates are made of.
            check_positive("feature", suppression_px=self.suppression_px)

    def of(self, pixels: Array, scores: Array, allowed: np.ndarray) -> np.ndarray:
        """Indices of the points chosen, where ``allowed`` (H, W) uint8 is not 0.

        On the coarse levels of a pyramid, OpenCV's own masks are coarse too.

        Args:
            pixels: (M, 2) px, in the image.
            scores: (M,) larger is better.
            allowed: see above.
        """
        height, width = allowed.shape
        column, row = np.clip(np.rint(pixels), 0, [width - 1, height - 1]).astype(np.int64).T
        inside = np.flatnonzero(allowed[row, column])
        pixels, scores = pixels[inside], scores[inside]
        if self.spread:
            distance = float(self.suppression_px)
            taken = np.zeros((0, 2))
            kept = choose_spread(pixels, scores, taken, size_px=(width, height), distance=distance, count=self.count)
        else:
            kept = strongest(pixels, scores, radius_px=self.suppression_px, count=self.count)
        chosen: np.ndarray = inside[kept]
        return chosen
