"""Points of one image with what describes their surroundings."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from vioframe.checks import Array, Image, check_array
from vioframe.errors import ShapeError


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Keypoints:
    """What an extractor finds in one image.

    Attributes:
        pixels: (M, 2) px.
        scores: (M,) larger is better.
        descriptors: (M, D): uint8 are bits, compared by Hamming distance; floats by the norm of their difference. D is
            0 where an extractor describes nothing.
    """

    pixels: Array
    scores: Array
    descriptors: np.ndarray

    def __post_init__(self) -> None:
        check_array("Keypoints.pixels", self.pixels, (None, 2))
        check_array("Keypoints.scores", self.scores, (len(self.pixels),))
        if self.descriptors.ndim != 2 or len(self.descriptors) != len(self.pixels):
            raise ShapeError(
                f"Keypoints.descriptors must have shape ({len(self.pixels)}, any), got {self.descriptors.shape}"
            )

    def __len__(self) -> int:
        return len(self.pixels)

    def select(self, keep: np.ndarray) -> "Keypoints":
        """Only these."""
        return Keypoints(pixels=self.pixels[keep], scores=self.scores[keep], descriptors=self.descriptors[keep])

    def join(self, others: "Keypoints") -> "Keypoints":
        """These and then the others, whose descriptors are of the same kind."""
        return Keypoints(
            pixels=np.concatenate([self.pixels, others.pixels]),
            scores=np.concatenate([self.scores, others.scores]),
            descriptors=np.concatenate([self.descriptors, others.descriptors]),
        )


@runtime_checkable
class Extractor(Protocol):
    """Finds keypoints in an image; knows nothing of other images."""

    def extract(self, gray: Image, allowed: np.ndarray) -> Keypoints:
        """Keypoints of an image (H, W) uint8 where ``allowed`` (H, W) uint8 is not 0, spread over it."""
        ...
