"""Lasting ids for points that are found anew in every image."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from vioframe.checks import Array, Mask, Stamps, check_positive
from vioframe.errors import ConfigError
from vioframe.geometry import camera as projection
from vioframe.types import Camera
from vioframe.vision.keypoints import Keypoints
from vioframe.vision.matching import match, pairs_near
from vioframe.vision.outliers import epipolar_inliers
from vioframe.vision.spread import choose_spread

_FEWEST_JUDGED = 8
_NEIGHBOURS = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class KeeperOptions:
    """How points are found again.

    Attributes:
        max_points: most points that have an id at once.
        min_distance_px: of a new point from all others.
        search_px: how far from where the gyro's rotation puts it a point is looked for.
        blind_search_px: the same without a gyro.
        memory_images: for how many images an absent point is remembered.
        max_distance: of two descriptors of one point.
        ratio: to the second nearest descriptor.
        reject_outliers: by epipolar geometry.
        outlier_px: distance from the epipolar line that contradicts it.

    Raises:
        ConfigError: an option outside its range, by its name in the config of a front end.
    """

    max_points: int
    min_distance_px: float
    search_px: float
    blind_search_px: float
    memory_images: int
    max_distance: float
    ratio: float
    reject_outliers: bool
    outlier_px: float

    def __post_init__(self) -> None:
        check_positive(
            "frontend",
            search_px=self.search_px,
            blind_search_px=self.blind_search_px,
            outlier_px=self.outlier_px,
        )
        for name, least in (("max_points", 1), ("min_distance_px", 2), ("memory_images", 1)):
            if not getattr(self, name) >= least:
                raise ConfigError(f"frontend.{name} must be at least {least}, got {getattr(self, name)}")
        if not 0.0 < self.ratio <= 1.0:
            raise ConfigError(f"frontend.ratio must be above 0 and at most 1, got {self.ratio}")


Follow = Callable[[Stamps, Array], tuple[Array, Mask]]
"""Takes ids (M,) of points and where they may be (M, 2) px; returns where they are (M, 2) and which were found (M,)."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Kept:
    """The points of an image that have ids.

    Attributes:
        ids: (M,) ascending.
        points: M of them; those that were followed have the descriptor by which they were last known, and score 0.
        ages: (M,) in how many images each was seen.
        index: (M,) which of the image's keypoints they are; -1 where a point was followed.
    """

    ids: Stamps
    points: Keypoints
    ages: np.ndarray
    index: np.ndarray

    def select(self, keep: np.ndarray) -> "Kept":
        """Only these."""
        return Kept(ids=self.ids[keep], points=self.points.select(keep), ages=self.ages[keep], index=self.index[keep])


@dataclass(slots=True, kw_only=True, eq=False)
class _Seen:
    """An image of the past: ids (M,) ascending, rays (M, 3), and the camera's rotation since (3, 3)."""

    ids: Stamps
    bearings: Array
    R_then_now: Array


class TrackKeeper:
    """Matches the keypoints of each image with the points remembered, and gives new ids to the rest.

    A point is looked for near where the gyro's rotation since it was last seen puts it, by its last descriptor;
    absent for a few images, it may come back with its id. Matches must agree with the epipolar geometry of the
    image in which the point was last seen and this one.

    Args:
        camera: calibration.
        options: see there.
    """

    def __init__(self, camera: Camera, options: KeeperOptions) -> None:
        self._camera = camera
        self._options = options
        self._threshold = options.outlier_px / float(np.mean(camera.intrinsics_px[:2]))
        self._images = 0
        self._next_id = 0
        # Everything remembered, seen in the last image or not.
        self._ids: Stamps = np.zeros(0, dtype=np.int64)
        self._ages: np.ndarray = np.zeros(0, dtype=np.int64)
        self._absent: np.ndarray = np.zeros(0, dtype=np.int64)
        self._bearings: Array = np.zeros((0, 3))
        # Displacement an image that rotation does not explain, px; NaN where a point was seen once.
        self._drift: Array = np.zeros((0, 2))
        self._descriptors: np.ndarray = np.zeros((0, 0), np.uint8)
        self._past: deque[_Seen] = deque(maxlen=options.memory_images)

    def keep(self, keypoints: Keypoints, R_prev_cur: Array | None, follow: Follow | None = None) -> Kept:
        """Take the next image.

        Args:
            keypoints: K of it.
            R_prev_cur: (3, 3) rotation of the camera since the image before, by the gyro, or None.
            follow: finds points that no keypoint matches; without it they are absent.
        """
        for image in self._past:
            image.R_then_now = image.R_then_now @ (np.eye(3) if R_prev_cur is None else R_prev_cur)
        gyro = R_prev_cur is not None
        expected, visible = self._expect()
        known, index = self._find(keypoints, expected, visible, gyro=gyro)
        agree = self._agreeing(known, keypoints.pixels[index], gyro=gyro)
        known, index = known[agree], index[agree]
        points = keypoints.select(index)
        if follow is not None:
            missed = np.setdiff1d(np.flatnonzero(visible), known)
            followed, pixels = self._follow(follow, missed, expected[missed], known, points.pixels, gyro=gyro)
            order = np.argsort(np.concatenate([known, followed]))
            unmatched = Keypoints(pixels=pixels, scores=np.zeros(len(pixels)), descriptors=self._descriptors[followed])
            known = np.concatenate([known, followed])[order]
            index = np.concatenate([index, np.full(len(followed), -1)])[order]
            points = points.join(unmatched).select(order) if len(followed) else points
        fresh = self._choose_new(keypoints, index[index >= 0], points.pixels)
        points = points.join(keypoints.select(fresh))
        self._remember(points, known)
        self._images += 1
        here = np.flatnonzero(self._absent == 0)
        self._past.appendleft(_Seen(ids=self._ids[here], bearings=self._bearings[here], R_then_now=np.eye(3)))
        return Kept(ids=self._ids[here], points=points, ages=self._ages[here], index=np.concatenate([index, fresh]))

    def forget(self, ids: Stamps) -> None:
        """Do not look for these points again."""
        keep = ~np.isin(self._ids, ids)
        self._ids, self._ages, self._absent = self._ids[keep], self._ages[keep], self._absent[keep]
        self._bearings, self._drift = self._bearings[keep], self._drift[keep]
        self._descriptors = self._descriptors[keep]

    def _expect(self) -> tuple[Array, Mask]:
        """Where everything remembered should be now (M, 2) px, and whether in the image (M,)."""
        if len(self._ids) == 0:
            return np.zeros((0, 2)), np.zeros(0, dtype=bool)
        expected, visible = projection.project(self._camera, self._turned())
        return expected + self._drifts(expected) * (1.0 + self._absent)[:, None], visible

    def _find(
        self, keypoints: Keypoints, expected: Array, visible: Mask, *, gyro: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """Rows of the memory, ascending, and the keypoints that match them."""
        if len(self._ids) == 0 or len(keypoints) == 0:
            return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
        reach = self._options.search_px if gyro else self._options.blind_search_px
        radius = np.where(visible, reach * np.sqrt(1.0 + self._absent), 0.0)
        rows, columns = pairs_near(np.where(visible[:, None], expected, -1e4), keypoints.pixels, radius)
        return match(
            self._descriptors,
            keypoints.descriptors,
            rows,
            columns,
            max_distance=self._options.max_distance,
            ratio=self._options.ratio,
        )

    def _follow(
        self, follow: Follow, missed: np.ndarray, expected: Array, known: np.ndarray, pixels: Array, *, gyro: bool
    ) -> tuple[np.ndarray, Array]:
        """Rows of the memory that no keypoint matched and that are there all the same, and where (M, 2) px.

        Args:
            follow: see :meth:`keep`.
            missed: rows.
            expected: (M, 2) px of them.
            known: rows that keypoints matched.
            pixels: (K, 2) of those.
            gyro: whether the rotation is known.
        """
        places, good = follow(self._ids[missed], expected)
        # What has come to lie where another point is has been lost.
        crowded, _ = pairs_near(places, pixels, np.full(len(places), 0.5 * self._options.min_distance_px))
        good = good.copy()
        good[crowded] = False
        missed, places = missed[good], places[good]
        rows = np.concatenate([known, missed])
        agree = self._agreeing(rows, np.concatenate([pixels, places]), gyro=gyro)[len(known) :]
        return missed[agree], places[agree]

    def _turned(self) -> Array:
        """Rays (M, 3) of what is remembered, in the camera now, if it had only turned."""
        if len(self._ids) == 0:
            return self._bearings
        rotations = np.stack([image.R_then_now for image in self._past])[self._absent]
        turned: Array = (self._bearings[:, None, :] @ rotations)[:, 0]
        return turned

    def _drifts(self, expected: Array) -> Array:
        """What parallax adds an image (M, 2) px: as last seen, or as the nearest points have it."""
        known = np.flatnonzero(~np.isnan(self._drift[:, 0]))
        unknown = np.flatnonzero(np.isnan(self._drift[:, 0]))
        if len(known) < _NEIGHBOURS:
            return np.nan_to_num(self._drift)
        drift = self._drift.copy()
        if len(unknown):
            apart = np.sum((expected[unknown, None] - expected[known]) ** 2, axis=-1)
            nearest = known[np.argpartition(apart, _NEIGHBOURS - 1, axis=1)[:, :_NEIGHBOURS]]
            drift[unknown] = np.median(self._drift[nearest], axis=1)
        return drift

    def _agreeing(self, known: np.ndarray, pixels: Array, *, gyro: bool) -> np.ndarray:
        """Which points (M,) agree with the epipolar geometry of this image and the one they were last seen in."""
        if not self._options.reject_outliers:
            return np.ones(len(known), dtype=bool)
        agree = np.zeros(len(known), dtype=bool)
        bearings = projection.bearings(self._camera, pixels)
        ids, absent = self._ids[known], self._absent[known]
        for images_ago in np.unique(absent):
            past = self._past[images_ago]
            mine = absent == images_ago
            # Points seen in that image and since are judged with the others, for more of them to agree.
            _, then, now = np.intersect1d(past.ids, ids, assume_unique=True, return_indices=True)
            if len(then) < _FEWEST_JUDGED:
                agree |= mine & (images_ago == 0)
                continue
            inliers = np.zeros(len(known), dtype=bool)
            R_then_now = past.R_then_now if gyro else None
            inliers[now] = epipolar_inliers(
                past.bearings[then], bearings[now], R_then_now, self._threshold, seed=self._images
            )
            agree |= mine & inliers
        return agree

    def _choose_new(self, keypoints: Keypoints, matched: np.ndarray, taken: Array) -> np.ndarray:
        """Keypoints that are given new ids: none of those ``matched``, nor near the places ``taken`` (M, 2) px."""
        room = self._options.max_points - len(taken)
        free = np.ones(len(keypoints), dtype=bool)
        free[matched] = False
        if len(taken):
            reach = np.full(len(taken), self._options.min_distance_px)
            _, near = pairs_near(taken, keypoints.pixels, reach)
            free[near] = False
        rows = np.flatnonzero(free)
        chosen = choose_spread(
            keypoints.pixels[rows],
            keypoints.scores[rows],
            taken,
            size_px=self._camera.size_px,
            distance=self._options.min_distance_px,
            count=room,
        )
        new: np.ndarray = rows[chosen]
        return new

    def _remember(self, points: Keypoints, known: np.ndarray) -> None:
        """Take note of the points of this image: those of the rows ``known``, and then new ones."""
        bearings = projection.bearings(self._camera, points.pixels)
        again, fresh = slice(0, len(known)), slice(len(known), None)
        turned = self._turned()[known]
        plain, visible = projection.project(self._camera, turned)
        moved = (points.pixels[again] - plain) / (1.0 + self._absent[known])[:, None]
        self._drift[known] = np.where(visible[:, None], moved, np.nan)
        self._absent += 1
        self._absent[known] = 0
        self._ages[known] += 1
        self._bearings[known] = bearings[again]
        if len(known):
            self._descriptors[known] = points.descriptors[again]
        keep = self._absent < self._options.memory_images
        count = len(points) - len(known)
        ids = np.arange(self._next_id, self._next_id + count, dtype=np.int64)
        self._next_id += count
        descriptors = self._descriptors if len(self._ids) else points.descriptors[:0]
        self._ids = np.concatenate([self._ids[keep], ids])
        self._ages = np.concatenate([self._ages[keep], np.ones(count, dtype=np.int64)])
        self._absent = np.concatenate([self._absent[keep], np.zeros(count, dtype=np.int64)])
        self._bearings = np.concatenate([self._bearings[keep], bearings[fresh]])
        self._drift = np.concatenate([self._drift[keep], np.full((count, 2), np.nan)])
        self._descriptors = np.concatenate([descriptors[keep], points.descriptors[fresh]])
