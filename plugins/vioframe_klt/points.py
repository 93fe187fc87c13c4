"""The points followed, as parallel arrays."""

from dataclasses import dataclass

import numpy as np

from vioframe.checks import Array, Mask, Stamps


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Points:
    """Points in the last image.

    Attributes:
        ids: (M,) ascending.
        pixels: (M, 2).
        bearings: (M, 3) unit vectors in the camera.
        ages: (M,) images each was seen in.
    """

    ids: Stamps
    pixels: Array
    bearings: Array
    ages: np.ndarray

    def __len__(self) -> int:
        return len(self.ids)

    @staticmethod
    def none() -> "Points":
        """No points at all."""
        empty = np.zeros(0, dtype=np.int64)
        return Points(ids=empty, pixels=np.zeros((0, 2)), bearings=np.zeros((0, 3)), ages=empty)

    def select(self, keep: np.ndarray) -> "Points":
        """Only these."""
        return Points(ids=self.ids[keep], pixels=self.pixels[keep], bearings=self.bearings[keep], ages=self.ages[keep])

    def moved(self, pixels: Array, bearings: Array) -> "Points":
        """The same points in the next image."""
        return Points(ids=self.ids, pixels=pixels, bearings=bearings, ages=self.ages + 1)

    def joined(self, ids: Stamps, pixels: Array, bearings: Array) -> "Points":
        """With new ones at the end."""
        return Points(
            ids=np.concatenate([self.ids, ids]),
            pixels=np.concatenate([self.pixels, pixels]),
            bearings=np.concatenate([self.bearings, bearings]),
            ages=np.concatenate([self.ages, np.ones(len(ids), dtype=np.int64)]),
        )


def inside(allowed: np.ndarray, pixels: Array) -> Mask:
    """Which pixels (M, 2) lie where the mask (H, W) is not 0."""
    height, width = allowed.shape
    column, row = np.rint(pixels[:, 0]).astype(int), np.rint(pixels[:, 1]).astype(int)
    within = (column >= 0) & (row >= 0) & (column < width) & (row < height)
    mask: Mask = within & (allowed[np.where(within, row, 0), np.where(within, column, 0)] > 0)
    return mask
