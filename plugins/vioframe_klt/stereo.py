"""The points of camera 0, found in the image of camera 1 at the same instant."""

import numpy as np

from vioframe.checks import Array, Mask, Stamps
from vioframe.geometry import camera as projection
from vioframe.types import Image, Tracks
from vioframe.vision.anchors import Anchors
from vioframe.vision.two_cameras import TwoCameras
from vioframe_klt.points import inside
from vioframe_klt.search import Search

_LEVELS_NEAR = 1
# The search converges from within about this far; unknown depths are tried in steps of it along the epipolar line.
_REACH_PX = 40.0
_MAX_HYPOTHESES = 4
# A point that no depth explains is tried again every so many images.
_RETRY_IMAGES = 5
_NEIGHBOURS = 5


class StereoMatcher:
    """Lucas–Kanade from camera 0 to camera 1, started on the epipolar line at the depth last seen.

    The patch a point began with then says where exactly it is, as it does in camera 0.

    Args:
        cameras: their geometry.
        search: in images of camera 1.
        allowed: (H, W) uint8, zero where no match may lie.
        anchor_steps: to align a patch.
        anchor_reach_px: largest distance of the aligned point from where the search put it.
        min_correlation: of the patch that a point began with and what camera 1 sees.
    """

    def __init__(
        self,
        cameras: TwoCameras,
        search: Search,
        *,
        allowed: np.ndarray,
        anchor_steps: int,
        anchor_reach_px: float,
        min_correlation: float,
    ) -> None:
        self.cameras = cameras
        self._search = search
        self._allowed = allowed
        self._steps = anchor_steps
        self._reach_px = anchor_reach_px
        self._min_correlation = min_correlation
        widest = cameras.focal_px * cameras.baseline * cameras.max_inverse_depth
        count = int(np.clip(np.ceil(widest / (2.0 * _REACH_PX)), 1, _MAX_HYPOTHESES))
        self._guesses = (np.arange(count) + 0.5) / count * cameras.max_inverse_depth
        self._images = 0
        self._ids: Stamps = np.zeros(0, dtype=np.int64)
        self._inverse_depth: Array = np.zeros(0)

    def match(self, left: Image, right: Image, tracks: Tracks, anchors: Anchors) -> Tracks:
        """The points of ``tracks`` that are found in camera 1.

        Args:
            left: (H, W) uint8 of camera 0, exposed as ``right``.
            right: (H, W) uint8 of camera 1.
            tracks: of camera 0, ids ascending.
            anchors: the patches they began with.
        """
        count = len(tracks)
        pixels = np.zeros((count, 2))
        bearings = np.zeros((count, 3))
        # 1/z in camera 0; NaN is not known.
        inverse_depth = np.full(count, np.nan)
        remembered = self._remembered(tracks.ids)
        guess = self._borrowed(tracks.bearings, remembered)
        blind = bool(np.isnan(guess).any())
        retry = blind or self._images % _RETRY_IMAGES == 0
        fresh = ~np.isin(tracks.ids, self._ids, assume_unique=True)
        wanted = ~np.isnan(remembered) | fresh | retry
        rounds: list[tuple[Array, int | None]] = [] if blind else [(guess, _LEVELS_NEAR)]
        if retry:
            rounds += [(np.full(count, depth), None) for depth in self._guesses]
        for index, (start, levels) in enumerate(rounds):
            rows = np.flatnonzero(wanted & np.isnan(inverse_depth) & ((index == 0) | np.isnan(remembered)))
            if len(rows) == 0:
                continue
            there, found = self._find(left, right, tracks, anchors, start, rows, levels)
            rays = projection.bearings(self.cameras.right, there)
            depths, possible = self.cameras.inverse_depth(tracks.bearings[rows], rays)
            good = found & possible
            pixels[rows[good]], bearings[rows[good]] = there[good], rays[good]
            inverse_depth[rows[good]] = depths[good]
        self._ids, self._inverse_depth = tracks.ids, inverse_depth
        self._images += 1
        seen = np.flatnonzero(~np.isnan(inverse_depth))
        return Tracks(
            ids=tracks.ids[seen],
            pixels=pixels[seen],
            bearings=bearings[seen],
            scores=tracks.scores[seen],
            camera=1,
        )

    def _remembered(self, ids: Stamps) -> Array:
        """1/z (M,) of the image before; NaN where the point was not matched there."""
        depths = np.full(len(ids), np.nan)
        if len(self._ids):
            place = np.minimum(np.searchsorted(self._ids, ids), len(self._ids) - 1)
            known = self._ids[place] == ids
            depths[known] = self._inverse_depth[place[known]]
        return depths

    def _borrowed(self, bearings: Array, inverse_depth: Array) -> Array:
        """Where unknown, the median of the nearest neighbours' (M,); NaN where nothing is known at all."""
        known = np.flatnonzero(~np.isnan(inverse_depth))
        unknown = np.flatnonzero(np.isnan(inverse_depth))
        if len(known) == 0 or len(unknown) == 0:
            return inverse_depth
        likeness = bearings[unknown] @ bearings[known].T
        few = min(_NEIGHBOURS, len(known))
        nearest = known[np.argpartition(-likeness, few - 1, axis=1)[:, :few]]
        filled = inverse_depth.copy()
        filled[unknown] = np.median(inverse_depth[nearest], axis=1)
        return filled

    def _find(
        self,
        left: Image,
        right: Image,
        tracks: Tracks,
        anchors: Anchors,
        inverse_depth: Array,
        rows: np.ndarray,
        levels: int | None,
    ) -> tuple[Array, Mask]:
        """Pixels (K, 2) in camera 1 of the points ``rows``, searched for from a depth, and found (K,)."""
        expected, visible = self.cameras.project(tracks.bearings[rows], inverse_depth[rows])
        start = tracks.pixels[rows]
        there, found = self._search.there(left, right, start, np.where(visible[:, None], expected, start), levels)
        pixels, _, correlation = anchors.align(right, there, anchors.bend[rows], self._steps, rows)
        found &= (
            visible
            & (correlation > self._min_correlation)
            & (np.linalg.norm(pixels - there, axis=-1) < self._reach_px)
            & inside(self._allowed, pixels)
        )
        # What is not found is given any place where the camera model holds.
        return np.where(found[:, None], pixels, start), found
