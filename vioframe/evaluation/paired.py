"""Two systems on the same recordings: by how much one is better, and whether that could be chance."""

import math
from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from vioframe.checks import Array

_Run = TypeVar("_Run", bound=Hashable)
_DRAWS = 4000
_SEED = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class PairedComparison:
    """What pairs of runs say of one system beside another, which is the baseline.

    Attributes:
        pairs: runs that both have.
        better: pairs in which the system is better than the baseline.
        worse: pairs in which it is worse; the others are alike.
        ratio: median of the system over the median of the baseline; None where one of the two is not finite, that is,
            where at least half of its runs failed, or where that of the baseline is 0.
        low, high: interval of the ratio, from resampled pairs; infinite where failures reach into it; None with the
            ratio, and with fewer than two pairs.
        p_value: of Wilcoxon's signed-rank test, two-sided: the chance of differences this lopsided if both were
            equally good. 1 where no pair differs; None without pairs.
    """

    pairs: int
    better: int
    worse: int
    ratio: float | None = None
    low: float | None = None
    high: float | None = None
    p_value: float | None = None

    def sentence(self) -> str:
        """All of it in words."""
        if self.pairs == 0:
            return "no pair of runs to compare"
        said = [f"{show_ratio(self)}", f"better in {self.better} and worse in {self.worse} of {self.pairs}"]
        return ", ".join([*said, f"p = {show_p(self.p_value)}"])


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
    is worse than any other: it ranks above all finite ones, and two that failed are alike. The interval of the ratio
    of medians is the percentile bootstrap (Efron 1979): pairs drawn with replacement, from a fixed seed. Pairs count
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
    ratio = _ratio(first[None], second[None])[0]
    low = high = None
    if math.isfinite(ratio) and len(shared) > 1:
        low, high = _interval(first, second, confidence)
    return PairedComparison(
        pairs=len(shared),
        better=int((loss < 0.0).sum()),
        worse=int((loss > 0.0).sum()),
        ratio=float(ratio) if math.isfinite(ratio) else None,
        low=low,
        high=high,
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


def _ratio(first: Array, second: Array) -> Array:
    """Ratio of medians (K,) of rows (K, N); not a number where both are infinite, or both 0."""
    with np.errstate(invalid="ignore", divide="ignore"):
        # The middle of a finite number and infinity is infinite.
        ratios: Array = np.median(second, axis=1) / np.median(first, axis=1)
        # A baseline that failed in half of its runs is no unit to measure with.
        ratios[np.isinf(np.median(first, axis=1))] = math.nan
    return ratios


def _interval(first: Array, second: Array, confidence: float) -> tuple[float | None, float | None]:
    picked = np.random.default_rng(_SEED).integers(len(first), size=(_DRAWS, len(first)))
    ratios = np.sort(_ratio(first[picked], second[picked]))
    ratios = ratios[~np.isnan(ratios)]
    if not len(ratios):
        return None, None
    # Between a number and infinity there is nothing to interpolate.
    low, high = (ratios[round(share * (len(ratios) - 1))] for share in (0.5 - confidence / 2, 0.5 + confidence / 2))
    return float(low), float(high)


def show_ratio(compared: PairedComparison) -> str:
    """The ratio with its interval, such as ``0.83 (0.71…0.96)``."""
    if compared.ratio is None:
        return "no ratio"
    if compared.low is None or compared.high is None:
        return f"{compared.ratio:.2f}"
    high = f"{compared.high:.2f}" if math.isfinite(compared.high) else "∞"
    return f"{compared.ratio:.2f} ({compared.low:.2f}…{high})"


def show_p(p_value: float | None) -> str:
    """A p-value with two digits."""
    if p_value is None:
        return "–"
    return "<0.001" if p_value < 0.001 else f"{p_value:.2g}"
