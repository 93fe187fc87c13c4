"""Two systems on the same recordings: by how much one is better, and whether that could be chance."""

import math
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from vioframe.checks import Array

_Rows = NDArray[np.int64]
_Run = TypeVar("_Run", bound=Hashable)
_DRAWS = 4000
_SEED = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Ratio:
    """A factor between a system and the baseline, below 1 where its numbers are smaller.

    Attributes:
        value: estimate.
        low, high: interval, from pairs drawn with replacement; infinite where failures reach into it; None with fewer
            than two pairs.
    """

    value: float
    low: float | None = None
    high: float | None = None

    def __str__(self) -> str:
        """Such as ``0.83 (0.71…0.96)``."""
        if self.low is None or self.high is None:
            return f"{self.value:.2f}"
        low, high = (f"{end:.2f}" if math.isfinite(end) else "∞" for end in (self.low, self.high))
        return f"{self.value:.2f} ({low}…{high})"


@dataclass(frozen=True, slots=True, kw_only=True)
class PairedComparison:
    """What pairs of runs say of one system beside another, which is the baseline.

    Attributes:
        pairs: runs that both have.
        better: pairs in which the system is better than the baseline.
        worse: pairs in which it is worse; the others are alike.
        of_medians: median of the system over the median of the baseline; None where one of the two is not finite, that
            is, where at least half of its runs failed, or where that of the baseline is 0. Runs of different
            recordings are thrown together here, so that it may differ from what pairs say.
        of_pairs: median over pairs of the ratio within the pair; None where it is not finite.
        p_value: of Wilcoxon's signed-rank test, two-sided: the chance of differences this lopsided if both were
            equally good. 1 where no pair differs; None without pairs.
    """

    pairs: int
    better: int
    worse: int
    of_medians: Ratio | None = None
    of_pairs: Ratio | None = None
    p_value: float | None = None

    def sentence(self) -> str:
        """All of it in words."""
        if self.pairs == 0:
            return "no pair of runs to compare"
        p = show_p(self.p_value)
        return (
            f"ratio of medians {show_ratio(self.of_medians)}, median of the ratios {show_ratio(self.of_pairs)}, "
            f"better in {self.better} and worse in {self.worse} of {self.pairs}, p {p if p[0] == '<' else f'= {p}'}"
        )


def compare_pairs(
    baseline: Mapping[_Run, float],
    system: Mapping[_Run, float],
    *,
    lower_is_better: bool = True,
    confidence: float = 0.95,
) -> PairedComparison:
    """Compare a metric of two systems run by run.

    The test is that of Wilcoxon (1945) on the signed ranks of ``log(system / baseline)``, since errors differ by
    factors from one recording to the next; on the ranks of the differences where a value is not positive. A failed run
    is worse than any other: it ranks above all finite ones, and two that failed are alike. Intervals are those of the
    percentile bootstrap (Efron 1979): pairs drawn with replacement, from a fixed seed. Pairs count
    as independent. Runs with several seeds on one recording are not quite, so what follows holds of these recordings.

    Args:
        baseline: a number by run; infinity where the run failed.
        system: the same; only runs that both have are compared.
        lower_is_better: False for metrics of which more is better; a failed run is then ``-inf`` or 0.
        confidence: of the interval, such as 0.95.
    """
    shared = [key for key in baseline if key in system]
    first = np.array([baseline[key] for key in shared], dtype=float)
    second = np.array([system[key] for key in shared], dtype=float)
    if not shared:
        return PairedComparison(pairs=0, better=0, worse=0)
    loss = _losses(first, second) * (1.0 if lower_is_better else -1.0)
    picked = np.random.default_rng(_SEED).integers(len(first), size=(_DRAWS, len(first)))
    every, drawn = np.arange(len(first), dtype=np.int64)[None], picked if len(shared) > 1 else None
    within = _within(first, second)

    def of_medians(rows: _Rows) -> Array:
        return _quotient(np.median(first[rows], axis=1), np.median(second[rows], axis=1))

    def of_pairs(rows: _Rows) -> Array:
        return _middle(within[rows])

    return PairedComparison(
        pairs=len(shared),
        better=int((loss < 0.0).sum()),
        worse=int((loss > 0.0).sum()),
        of_medians=_estimate(of_medians, every, drawn, confidence),
        of_pairs=_estimate(of_pairs, every, drawn, confidence),
        p_value=_signed_rank(loss),
    )


def _losses(first: Array, second: Array) -> Array:
    """By how much the second of each pair is larger, infinite where one alone is; 0 where they are alike."""
    known = np.isfinite(first) & np.isfinite(second)
    positive = bool((first[known] > 0.0).all() and (second[known] > 0.0).all())
    losses: Array = np.zeros(len(first))
    losses[known] = np.log(second[known] / first[known]) if positive else second[known] - first[known]
    apart = ~known & (first != second)
    losses[apart] = np.where(second[apart] > first[apart], math.inf, -math.inf)
    return losses


def _signed_rank(losses: Array) -> float:
    if not losses.any():
        return 1.0
    # Imported here: the module takes half a second to load.
    from scipy.stats import wilcoxon

    finite = np.abs(losses[np.isfinite(losses)])
    above = 2.0 * float(finite.max(initial=0.0)) + 1.0
    return float(wilcoxon(np.clip(losses, -above, above), alternative="two-sided").pvalue)


def _quotient(first: Array, second: Array) -> Array:
    """Second over first; not a number where the first is infinite, which is no unit to measure with, or both are 0."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(np.isinf(first), math.nan, second / first)


def _within(first: Array, second: Array) -> Array:
    """The ratio of every pair: 0 where the baseline alone failed, infinite where the system did, 1 where both did."""
    alike = first == second
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(alike, 1.0, np.where(np.isinf(first), 0.0, second / first))


def _middle(values: Array) -> Array:
    """Medians of rows (K, N), where the middle of a number and infinity is infinite."""
    return np.asarray(np.median(values, axis=1))


def _estimate(of: Callable[[_Rows], Array], every: _Rows, drawn: _Rows | None, confidence: float) -> Ratio | None:
    value = float(of(every)[0])
    if not math.isfinite(value):
        return None
    ratios = np.zeros(0) if drawn is None else np.sort(of(drawn))
    ratios = ratios[~np.isnan(ratios)]
    if not len(ratios):
        return Ratio(value=value)
    # Between a number and infinity there is nothing to interpolate.
    low, high = (ratios[round(share * (len(ratios) - 1))] for share in (0.5 - confidence / 2, 0.5 + confidence / 2))
    return Ratio(value=value, low=float(low), high=float(high))


def show_ratio(ratio: Ratio | None) -> str:
    """A ratio with its interval, or ``none``."""
    return "none" if ratio is None else str(ratio)


def show_p(p_value: float | None) -> str:
    """A p-value with two digits."""
    if p_value is None:
        return "–"
    return "< 0.001" if p_value < 0.001 else f"{p_value:.2g}"
