"""The points of camera 0, found in the image of camera 1 at the same instant."""

import cv2
import numpy as np

from vioframe.checks import Array, Mask, Stamps
from vioframe.errors import DataError
from vioframe.geometry import camera as projection
from vioframe.geometry import se3
from vioframe.types import Camera, Image, Tracks

_LEVELS_NEAR = 1
_LEVELS_BACK = 1
# The search converges from within about this far; unknown depths are tried in steps of it along the epipolar line.
_REACH_PX = 40.0
_MAX_HYPOTHESES = 4
# A point that no depth explains is tried again every so many images.
_RETRY_IMAGES = 5
_NEIGHBOURS = 5


class StereoMatcher:
    """Lucas–Kanade from camera 0 to camera 1, started on the epipolar line at the depth last seen.

    Works for any rig whose views overlap; nothing is rectified.

    Args:
        left: camera 0.
        right: camera 1.
        window_px: odd side of the patch.
        levels: pyramid levels above the full image, where the depth is not yet known.
        criteria: of Lucas–Kanade, as OpenCV takes them.
        forward_backward_px: largest distance of a point matched there and back from its start.
        epipolar_px: largest distance from the epipolar line.
        min_depth: nearer points are not matched, m.
        border_px: no matches nearer to the edge of the image.

    Raises:
        DataError: the cameras sit at the same place.
    """

    def __init__(
        self,
        left: Camera,
        right: Camera,
        *,
        window_px: int,
        levels: int,
        criteria: tuple[int, int, float],
        forward_backward_px: float,
        epipolar_px: float,
        min_depth: float,
        border_px: int,
    ) -> None:
        self.right = right
        T_right_left = se3.inverse(right.T_body_cam) @ left.T_body_cam
        self._R_right_left, self._base = T_right_left[:3, :3], T_right_left[:3, 3]
        baseline = float(np.linalg.norm(self._base))
        if baseline < 1e-4:
            raise DataError(f"frontend.stereo needs two cameras apart from each other, but theirs is {baseline:.2g} m")
        focal = float(np.mean(right.intrinsics_px[:2]))
        widest = focal * baseline / min_depth
        count = int(np.clip(np.ceil(widest / (2.0 * _REACH_PX)), 1, _MAX_HYPOTHESES))
        self._guesses = (np.arange(count) + 0.5) / count / min_depth
        self._max_inverse_depth = 1.0 / min_depth
        self._threshold = epipolar_px / focal
        # So much beyond infinity does noise put a point that is far away.
        self._least_inverse_depth = -2.0 * self._threshold / baseline
        self._back_px = forward_backward_px
        self._window = (window_px, window_px)
        self._levels = levels
        self._criteria = criteria
        self._border = border_px
        self._images = 0
        self._ids: Stamps = np.zeros(0, dtype=np.int64)
        self._inverse_depth: Array = np.zeros(0)

    def match(self, left: Image, right: Image, tracks: Tracks) -> Tracks:
        """The points of ``tracks`` that are found in camera 1.

        Args:
            left: (H, W) uint8 of camera 0, exposed as ``right``.
            right: (H, W) uint8 of camera 1.
            tracks: of camera 0, ids ascending.
        """
        count = len(tracks)
        pixels = np.zeros((count, 2))
        bearings = np.zeros((count, 3))
        # NaN is not known; 1/z in camera 0.
        inverse_depth = np.full(count, np.nan)
        remembered = self._remembered(tracks.ids)
        guess = self._borrowed(tracks.bearings, remembered)
        blind = bool(np.isnan(guess).any())
        retry = blind or self._images % _RETRY_IMAGES == 0
        fresh = ~np.isin(tracks.ids, self._ids, assume_unique=True)
        wanted = ~np.isnan(remembered) | fresh | retry
        rounds = [] if blind else [(guess, _LEVELS_NEAR)]
        if retry:
            rounds += [(np.full(count, depth), self._levels) for depth in self._guesses]
        for index, (start, levels) in enumerate(rounds):
            rows = np.flatnonzero(wanted & np.isnan(inverse_depth) & ((index == 0) | np.isnan(remembered)))
            if len(rows) == 0:
                continue
            there, found = self._search(left, right, tracks, start, rows, levels)
            rays, depths, fits = self._consistent(tracks.bearings[rows], there)
            good = found & fits
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

    def _search(
        self, left: Image, right: Image, tracks: Tracks, inverse_depth: Array, rows: np.ndarray, levels: int
    ) -> tuple[Array, Mask]:
        """Pixels (K, 2) in camera 1 of the points ``rows``, searched for from a depth, and found (K,)."""
        rays = tracks.bearings[rows] / np.maximum(tracks.bearings[rows, 2:], 1e-3)
        ahead = rays @ self._R_right_left.T + inverse_depth[rows, None] * self._base
        expected, visible = projection.project(self.right, ahead)
        start = tracks.pixels[rows].astype(np.float32)
        there, status, _ = cv2.calcOpticalFlowPyrLK(
            left,
            right,
            start,
            np.where(visible[:, None], expected, start).astype(np.float32),
            winSize=self._window,
            maxLevel=levels,
            criteria=self._criteria,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        back, back_status, _ = cv2.calcOpticalFlowPyrLK(
            right,
            left,
            there,
            start.copy(),
            winSize=self._window,
            maxLevel=min(_LEVELS_BACK, levels),
            criteria=self._criteria,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        width, height = self.right.size_px
        low = self._border - 0.5
        found = (
            visible
            & (status[:, 0] > 0)
            & (back_status[:, 0] > 0)
            & (np.linalg.norm(back - start, axis=-1) < self._back_px)
            & (there > low).all(axis=-1)
            & (there[:, 0] < width - 1 - low)
            & (there[:, 1] < height - 1 - low)
        )
        return there.astype(float), found

    def _consistent(self, bearings: Array, pixels: Array) -> tuple[Array, Array, Mask]:
        """Rays (K, 3) of camera 1, 1/z (K,) in camera 0, and which lie near their epipolar line at a possible depth.

        The inverse depth ρ is the least-squares solution of ``b₁ × (R h₀ + ρ t) = 0``, with ``h₀`` the ray of
        camera 0 at depth 1.
        """
        rays = projection.bearings(self.right, pixels)
        turned = (bearings / np.maximum(bearings[:, 2:], 1e-3)) @ self._R_right_left.T
        across_base = np.cross(rays, self._base)
        inverse_depth = -np.sum(np.cross(rays, turned) * across_base, axis=-1) / np.maximum(
            np.sum(across_base * across_base, axis=-1), 1e-18
        )
        normal = np.cross(turned, self._base)
        length = np.linalg.norm(normal, axis=-1)
        near = np.abs(np.sum(normal * rays, axis=-1)) < self._threshold * length
        possible = (inverse_depth > self._least_inverse_depth) & (inverse_depth < self._max_inverse_depth)
        return rays, inverse_depth, near & possible
