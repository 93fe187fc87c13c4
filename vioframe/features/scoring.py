"""One method on one pair of pictures: extract, match, judge by the true homography."""

import time
from dataclasses import dataclass

import cv2
import numpy as np

from vioframe.checks import Array, Mask
from vioframe.errors import ConfigError
from vioframe.features.fitting import shared_areas
from vioframe.features.homography import corner_error_px, estimate_homography
from vioframe.features.matches import average_precision, matching_score
from vioframe.features.points import Repetition, distances_px, repetition
from vioframe.features.protocol import FeatureProtocol
from vioframe.pictures.homographies import valid_mask
from vioframe.pictures.pairs import PicturePair
from vioframe.types import Image
from vioframe.vision.keypoints import Extractor, Keypoints
from vioframe.vision.matching import all_distances, mutual_nearest

# A mask speaks of whole pixels; refining a place moves it by up to this much.
_REFINED_PX = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class DescriptorScores:
    """What descriptors are worth on one pair; a detector alone has none of this.

    Attributes:
        average_precision: see :func:`average_precision`.
        matching_score: see :func:`matching_score`.
        matches: mutual nearest neighbours, wherever they lie.
        correct: of them, at most ``correct_px`` apart.
        corner_error_px: of the homography estimated from them; infinite where there is none.
    """

    average_precision: float
    matching_score: float
    matches: int
    correct: int
    corner_error_px: float


@dataclass(frozen=True, slots=True, kw_only=True)
class PairScores:
    """One method on one pair.

    Attributes:
        pair: its name.
        split: its split.
        points: found in the area that both pictures show, first and second.
        repeatability: see :func:`repetition`.
        localisation_px: the same.
        descriptors: None for a detector without.
        milliseconds: of the extraction, first and second picture.
        cpu_milliseconds: the same as processor time of all threads, which other work on the machine changes less.
    """

    pair: str
    split: str
    points: tuple[int, int]
    repeatability: float
    localisation_px: float | None
    descriptors: DescriptorScores | None
    milliseconds: tuple[float, float]
    cpu_milliseconds: tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Seen:
    """What a method made of a pair, for pictures of it.

    Attributes:
        scores: see there.
        first: pixels (M, 2) in the first picture.
        second: pixels (K, 2) in the second.
        repeated: which of them were found again, (M,) and (K,).
        rows: (N,) points of the first that were matched ...
        columns: ... with these of the second.
        correct: (N,) which matches are right.
    """

    scores: PairScores
    first: Array
    second: Array
    repeated: tuple[Mask, Mask]
    rows: np.ndarray
    columns: np.ndarray
    correct: Mask


def score_pair(name: str, extractor: Extractor, pair: PicturePair, protocol: FeatureProtocol) -> Seen:
    """Run a method on a pair that has the protocol's size.

    Args:
        name: of the method, for messages.
        extractor: of its keypoints.
        pair: see :func:`fit_pair`.
        protocol: see there.

    Raises:
        ConfigError: the method returns more points than the protocol allows, or some where none are allowed.
    """
    areas = shared_areas(pair.H_second_first, protocol.size_px, protocol.border_px)
    whole = valid_mask(np.eye(3), protocol.size_px, protocol.border_px)
    allowed = areas if protocol.shared_only else (whole, whole)
    first, first_time = _extract(name, extractor, pair.first, allowed[0], protocol)
    second, second_time = _extract(name, extractor, pair.second, allowed[1], protocol)
    inside = _lie_in(first.pixels, areas[0]), _lie_in(second.pixels, areas[1])
    apart = distances_px(first.pixels, second.pixels, pair.H_second_first)
    shared = np.ix_(*inside)
    again = repetition(apart[shared], protocol.correct_px)
    counts = int(inside[0].sum()), int(inside[1].sum())
    described = None
    rows, columns = np.zeros((2, 0), dtype=np.int64)
    if has_descriptors(first, second):
        distance = all_distances(first.descriptors, second.descriptors)
        limit = None if first.descriptors.dtype == np.uint8 else protocol.max_distance
        rows, columns = mutual_nearest(distance, limit)
        right = apart[rows, columns] <= protocol.correct_px
        estimated = estimate_homography(first.pixels[rows], second.pixels[columns], protocol)
        described = DescriptorScores(
            average_precision=average_precision(distance[shared], apart[shared], protocol.correct_px, limit),
            matching_score=matching_score(int(np.count_nonzero(right & inside[0][rows] & inside[1][columns])), counts),
            matches=len(rows),
            correct=int(right.sum()),
            corner_error_px=corner_error_px(estimated, pair.H_second_first, protocol.size_px),
        )
    scores = PairScores(
        pair=pair.name,
        split=pair.split,
        points=counts,
        repeatability=again.repeatability,
        localisation_px=again.localisation_px,
        descriptors=described,
        milliseconds=(first_time[0], second_time[0]),
        cpu_milliseconds=(first_time[1], second_time[1]),
    )
    return Seen(
        scores=scores,
        first=first.pixels,
        second=second.pixels,
        repeated=(_spread_out(inside[0], again, 0), _spread_out(inside[1], again, 1)),
        rows=rows,
        columns=columns,
        correct=apart[rows, columns] <= protocol.correct_px,
    )


def has_descriptors(*keypoints: Keypoints) -> bool:
    """Whether they come from a method that describes its points."""
    return all(points.descriptors.shape[1] > 0 for points in keypoints)


def _extract(
    name: str, extractor: Extractor, picture: Image, allowed: Mask, protocol: FeatureProtocol
) -> tuple[Keypoints, tuple[float, float]]:
    """Keypoints, and how long they took, ms: on the clock, and of the processor."""
    mask = allowed.astype(np.uint8) * np.uint8(255)
    begin, begin_cpu = time.perf_counter(), time.process_time()
    found = extractor.extract(picture, mask)
    milliseconds = (time.perf_counter() - begin) * 1e3, (time.process_time() - begin_cpu) * 1e3
    if len(found) > protocol.points:
        raise ConfigError(
            f"task.methods.{name} returned {len(found)} points where protocol.points={protocol.points}: "
            "give it count: ${protocol.points}"
        )
    if not _lie_in(found.pixels, allowed).all():
        raise ConfigError(
            f"task.methods.{name} returned points where its mask allows none: its extract() must heed `allowed`"
        )
    return found, milliseconds


def _lie_in(pixels: Array, area: Mask) -> Mask:
    """Which points (M,) lie in an area (H, W), or so near that refining their place may have taken them out of it."""
    height, width = area.shape
    column, row = np.rint(pixels).astype(np.int64).T
    inside: Mask = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    side = 2 * _REFINED_PX + 1
    inside[inside] = cv2.dilate(area.astype(np.uint8), np.ones((side, side), np.uint8))[row[inside], column[inside]] > 0
    return inside


def _spread_out(inside: Mask, again: Repetition, which: int) -> Mask:
    """Marks of the points in the shared area, as marks of all points."""
    marks = np.zeros(len(inside), dtype=bool)
    marks[inside] = again.second if which else again.first
    return marks
