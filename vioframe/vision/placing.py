"""Matched points placed by how their surroundings first looked, instead of where a detector found them this time."""

from dataclasses import dataclass, replace

import numpy as np

from vioframe.checks import Array, Mask, Stamps
from vioframe.errors import ConfigError
from vioframe.types import Image
from vioframe.vision.anchors import Anchors

# A patch seen so much larger, or smaller, than it first was is cut anew.
_MAX_STRETCH = 1.6
# Share of patches below which what does not fit is not the points' fault.
_FEW_FIT = 0.5
# Of points that are found by their patches alone.
_FOLLOW_STEPS = 8
_FOLLOW_REACH_PX = 3.0
_FOLLOW_CORRELATION = 0.9


@dataclass(frozen=True, slots=True, kw_only=True)
class AnchorOptions:
    """How a matched point is placed by its patch.

    Attributes:
        window_px: odd side of the patch; 0 leaves points where they were found.
        steps: to align it, an image.
        reach_px: largest distance of the aligned point from where the detector found it.
        min_correlation: of the patch as it first looked and what is seen now.
        memory_images: for how many images a patch is kept whose point is not seen.
        follow: look by its patch for a point that no keypoint matched.

    Raises:
        ConfigError: with the key and its value.
    """

    window_px: int
    steps: int
    reach_px: float
    min_correlation: float
    memory_images: int
    follow: bool

    def __post_init__(self) -> None:
        odd = self.window_px == 0 or (self.window_px >= 7 and self.window_px % 2 == 1)
        for name, value, good, rule in (
            ("anchor_window_px", self.window_px, odd, "odd and at least 7, or 0"),
            ("anchor_steps", self.steps, self.steps >= 1, "at least 1"),
            ("anchor_reach_px", self.reach_px, self.reach_px > 0.0, "positive"),
            ("min_correlation", self.min_correlation, 0.0 <= self.min_correlation < 1.0, "at least 0 and below 1"),
        ):
            if not good:
                raise ConfigError(f"frontend.{name} must be {rule}, got {value}")


class AnchoredPlaces:
    """Where points with lasting ids are.

    A detector finds a corner again to a fraction of a pixel that differs from image to image. The patch around it,
    aligned under an affine warp with any gain and offset of its light, says to a tenth where the same point is. A
    match whose patch does not fit is a slip to a neighbour, unless few fit: then the image is to blame (light that no
    gain undoes, blur), and points are taken where they were found.

    Args:
        options: see there.
    """

    def __init__(self, options: AnchorOptions) -> None:
        self._options = options
        # With no detector to agree a patch must fit better. It begins where the motion until now puts the point, which
        # is further off.
        self._alone = replace(
            options,
            steps=_FOLLOW_STEPS,
            reach_px=_FOLLOW_REACH_PX,
            min_correlation=max(_FOLLOW_CORRELATION, options.min_correlation),
        )
        self._anchors = Anchors(options.window_px)
        self._ids: Stamps = np.zeros(0, dtype=np.int64)
        self._absent: np.ndarray = np.zeros(0, dtype=np.int64)

    def place(self, gray: Image, ids: Stamps, pixels: Array) -> tuple[Array, Mask]:
        """Places (M, 2) px of points that were found at ``pixels``, and which of them (M,) are other points now.

        Args:
            gray: (H, W) uint8, the next image.
            ids: (M,) of its points, ascending; higher than all before where they are new.
            pixels: (M, 2) px where they were found.
        """
        _, rows, seen = np.intersect1d(self._ids, ids, assume_unique=True, return_indices=True)
        placed, slipped = pixels.copy(), np.zeros(len(ids), dtype=bool)
        keep = self._absent < self._options.memory_images
        keep[rows] = True
        if len(rows):
            found, fits, bend = self._align(gray, pixels[seen], rows, self._options)
            self._anchors.bend[rows[fits]] = bend[fits]
            stretch = np.linalg.svd(bend, compute_uv=False)
            worn = (stretch[:, 0] > _MAX_STRETCH) | (stretch[:, 1] < 1.0 / _MAX_STRETCH)
            if fits.mean() >= _FEW_FIT:
                placed[seen] = found
                slipped[seen[~fits]] = True
                keep[rows[~fits]] = False
            else:
                worn[:] = True
            # What has come to look otherwise begins anew at its place.
            if worn.any():
                self._anchors.renew(gray, placed[seen[worn]], rows[worn])
        self._absent += 1
        self._absent[rows] = 0
        fresh = np.setdiff1d(np.arange(len(ids)), seen)
        self._anchors.select(keep)
        self._anchors.add(gray, placed[fresh])
        self._ids = np.concatenate([self._ids[keep], ids[fresh]])
        self._absent = np.concatenate([self._absent[keep], np.zeros(len(fresh), dtype=np.int64)])
        return placed, slipped

    def follow(self, gray: Image, ids: Stamps, expected: Array) -> tuple[Array, Mask]:
        """Look for points of images before by their patches alone; :meth:`place` is to be told of what is taken.

        Args:
            gray: (H, W) uint8, the next image.
            ids: (M,) ascending.
            expected: (M, 2) px where they may be.

        Returns:
            places (M, 2) px and which were found (M,); one whose patch is gone was not.
        """
        _, rows, mine = np.intersect1d(self._ids, ids, assume_unique=True, return_indices=True)
        places, found = expected.copy(), np.zeros(len(ids), dtype=bool)
        if len(rows):
            places[mine], found[mine], _ = self._align(gray, expected[mine], rows, self._alone)
        return places, found

    def place_elsewhere(self, gray: Image, ids: Stamps, pixels: Array) -> tuple[Array, Mask]:
        """The same in an image that another camera took at the instant of the last one, with nothing remembered of it.

        Args:
            gray: (H, W) uint8.
            ids: (M,) of points of the last image.
            pixels: (M, 2) px where they were found.
        """
        rows = np.searchsorted(self._ids, ids)
        placed, fits, _ = self._align(gray, pixels, rows, self._options)
        if len(rows) and fits.mean() < _FEW_FIT:
            return pixels, np.zeros(len(ids), dtype=bool)
        return placed, ~fits

    def _align(
        self, gray: Image, pixels: Array, rows: np.ndarray, options: AnchorOptions
    ) -> tuple[Array, Mask, np.ndarray]:
        """Places (K, 2), which patches fit there (K,), and their warps (K, 2, 2), of others the last."""
        found, bend, correlation = self._anchors.align(gray, pixels, self._anchors.bend[rows], options.steps, rows)
        with np.errstate(invalid="ignore"):
            near = np.linalg.norm(found - pixels, axis=-1) < options.reach_px
            fits: Mask = np.asarray(near & (correlation > options.min_correlation))
        bend = np.where(fits[:, None, None], bend, self._anchors.bend[rows])
        return np.where(fits[:, None], found, pixels), fits, bend
