"""Methods side by side: all pairs, the same protocol, means by split."""

import logging
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from vioframe.features.fitting import fit_pair, shared_areas
from vioframe.features.homography import homography_accuracy
from vioframe.features.protocol import EPSILONS_PX, FeatureProtocol
from vioframe.features.scoring import PairScores, Seen, score_pair
from vioframe.pictures.pairs import PicturePair
from vioframe.vision.keypoints import Extractor

log = logging.getLogger(__name__)

# Of each picture.
_LEAST_SHARED = 0.02

ALL = "all"
"""The split of all pairs together."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Summary:
    """One method on the pairs of one split.

    Attributes:
        method: its name.
        split: name, or ``all``.
        pairs: how many.
        points: mean number in the area that both pictures of a pair show.
        repeatability: mean over pairs ...
        repeatability_error: ... and the standard error of that mean; None for one pair.
        localisation_px: mean over the pairs in which a point was found again.
        mean_average_precision: NN mAP; None, like all below, for a detector without descriptors.
        matching_score: mean over pairs.
        matches: mean number.
        correct: mean number of right ones.
        homography_accuracy: share of the pairs with a corner error up to each of ``EPSILONS_PX``.
        milliseconds: median time of extraction, a picture ...
        cpu_milliseconds: ... and its processor time, of all threads.
    """

    method: str
    split: str
    pairs: int
    points: float
    repeatability: float
    repeatability_error: float | None
    localisation_px: float | None
    mean_average_precision: float | None
    matching_score: float | None
    matches: float | None
    correct: float | None
    homography_accuracy: tuple[float, ...] | None
    milliseconds: float
    cpu_milliseconds: float

    def accuracy_at(self, epsilon_px: int) -> float | None:
        """Homography accuracy at one of ``EPSILONS_PX``."""
        if self.homography_accuracy is None:
            return None
        return self.homography_accuracy[EPSILONS_PX.index(epsilon_px)]

    def numbers(self) -> dict[str, float]:
        """All that are defined, by name; accuracies as ``homography_3px`` and the like."""
        plain = {
            key: float(value)
            for key, value in asdict(self).items()
            if isinstance(value, int | float) and math.isfinite(value)
        }
        accuracies = self.homography_accuracy or ()
        return plain | {f"homography_{px}px": value for px, value in zip(EPSILONS_PX, accuracies, strict=False)}


def evaluate_pairs(
    methods: Mapping[str, Extractor], pairs: Iterable[PicturePair], protocol: FeatureProtocol
) -> Iterator[tuple[PicturePair, dict[str, Seen]]]:
    """Each pair, at the protocol's size, and what each method made of it.

    A pair whose pictures hardly overlap at that size is left out with a warning: no method could do anything with it.

    Args:
        methods: by name.
        pairs: of any size; each is taken once.
        protocol: see there.

    Raises:
        ConfigError: a method does not keep to the protocol.
    """
    for pair in pairs:
        fitted = fit_pair(pair, protocol.size_px)
        areas = shared_areas(fitted.H_second_first, protocol.size_px, protocol.border_px)
        if min(area.mean() for area in areas) < _LEAST_SHARED:
            log.warning("%s is left out: its pictures show next to nothing in common", pair.name)
            continue
        yield fitted, {name: score_pair(name, extractor, fitted, protocol) for name, extractor in methods.items()}


def summarise(method: str, scores: Sequence[PairScores]) -> list[Summary]:
    """A summary for each split, in the order of first appearance, and for all pairs where there are several splits.

    Args:
        method: its name.
        scores: of at least one pair.
    """
    splits = list(dict.fromkeys(score.split for score in scores))
    summaries = [_summary(method, split, [score for score in scores if score.split == split]) for split in splits]
    return summaries if len(splits) == 1 else [*summaries, _summary(method, ALL, scores)]


def _summary(method: str, split: str, scores: Sequence[PairScores]) -> Summary:
    repeatability = np.array([score.repeatability for score in scores])
    spread = float(repeatability.std(ddof=1) / math.sqrt(len(scores))) if len(scores) > 1 else None
    placed = [score.localisation_px for score in scores if score.localisation_px is not None]
    described = [score.descriptors for score in scores if score.descriptors is not None]
    errors = [one.corner_error_px for one in described]
    return Summary(
        method=method,
        split=split,
        pairs=len(scores),
        points=float(np.mean([score.points for score in scores])),
        repeatability=float(repeatability.mean()),
        repeatability_error=spread,
        localisation_px=float(np.mean(placed)) if placed else None,
        mean_average_precision=float(np.mean([one.average_precision for one in described])) if described else None,
        matching_score=float(np.mean([one.matching_score for one in described])) if described else None,
        matches=float(np.mean([one.matches for one in described])) if described else None,
        correct=float(np.mean([one.correct for one in described])) if described else None,
        homography_accuracy=tuple(homography_accuracy(errors, px) for px in EPSILONS_PX) if described else None,
        milliseconds=float(np.median([score.milliseconds for score in scores])),
        cpu_milliseconds=float(np.median([score.cpu_milliseconds for score in scores])),
    )
