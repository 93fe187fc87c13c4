"""Parameters of :class:`~vioframe.data.vo_errors.VoErrors` from what an odometer really answered.

Each of the seven error signals is taken for white noise of variance w²/T plus a Gauss-Markov process. With C(l) the
mean product of values l pairs apart, and l ≥ 1,

    C(l) = c² exp(−l T / τ),      C(0) = c² + w²/T,

so the lags give c and τ and what they leave of C(0) is white. How heavy its tails are, ν, is read off
``E[√|y|]² / E|y|``, which exists for all ν and falls as tails get heavier; with y | λ Gaussian of variance
``c² + λ w²/T`` and λ = (ν − 2)/χ²_ν, both means are averages over λ.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vioframe.checks import Array, Mask
from vioframe.data.vo_errors import DIRECTION, ROTATION, SCALE, VoErrors, error_signals
from vioframe.errors import DataError

# Below this speed, m/s, direction and scale of a motion are mostly noise.
_LEAST_SPEED = 3.0
_LEAST_PAIRS = 200
# Lags are looked at up to this many seconds; what lasts longer than the longest time is as good as constant.
_LONGEST_LAG_S = 10.0
_TIMES_S = np.geomspace(0.2, 60.0, 80)
_TAILS = np.geomspace(2.2, 100.0, 60)
_QUANTILES = (np.arange(400) + 0.5) / 400


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AnsweredMotions:
    """What an odometer answered on one recording, pair after pair.

    Attributes:
        T_true: (P, 4, 4) true motion of camera 0, metres.
        T_estimate: (P, 4, 4) its answer.
        duration_s: (P,) from image to image, nearly even.
        valid: (P,) whether it stands by it and the truth is known.
    """

    T_true: Array
    T_estimate: Array
    duration_s: Array
    valid: Mask


def fit_errors(recordings: Sequence[AnsweredMotions], *, translation_floor: float = 0.0) -> VoErrors:
    """The model whose errors have the size, duration and tails of these.

    Axes of one kind share their correlation time. Forward motion says nothing of turning its direction about itself:
    what an axis does not show it takes from the mean of the others.

    Args:
        recordings: of cameras that look ahead while they move, 200 pairs or more in all.
        translation_floor: m/√s, which moving recordings do not show; taken as given.

    Raises:
        DataError: too few pairs.
    """
    columns, durations = [], []
    for each in recordings:
        signals = error_signals(each.T_true, each.T_estimate, each.duration_s, _LEAST_SPEED)
        signals[~each.valid] = np.nan
        columns.append(signals)
        durations.append(each.duration_s)
    counts = [int(np.isfinite(signals).all(axis=1).sum()) for signals in columns]
    if sum(counts) < _LEAST_PAIRS:
        raise DataError(
            f"an error model needs {_LEAST_PAIRS} valid pairs of images of a camera faster than {_LEAST_SPEED} m/s, "
            f"got {sum(counts)}: give more recordings"
        )
    duration = float(np.median(np.concatenate(durations)))
    lags = max(3, round(_LONGEST_LAG_S / duration))
    products = np.stack([_products([signals[:, k] for signals in columns], lags) for k in range(7)])
    # A direction is turned only about axes across it: of three values two are free.
    seen = _visible(recordings)
    products[DIRECTION] /= np.where(seen > 0.1, seen, np.nan)[:, None]
    products[DIRECTION] = np.where(
        np.isnan(products[DIRECTION]), np.nanmean(products[DIRECTION], axis=0), products[3:6]
    )
    variance, times = np.zeros(7), np.zeros(7)
    for group in (ROTATION, DIRECTION, slice(SCALE, SCALE + 1)):
        variance[group], times[group] = _decay(products[group], duration)
    white = np.maximum(products[:, 0] - variance, 0.0)
    shown = [*range(3), *(3 + np.flatnonzero(seen > 0.1)), SCALE]
    values = [np.concatenate([signals[:, k] for signals in columns]) for k in shown]
    tail = _tail([v[np.isfinite(v)] for v in values], variance[shown], white[shown])
    density, correlated = np.sqrt(white * duration), np.sqrt(variance)
    return VoErrors(
        rotation_white=tuple(density[ROTATION]),
        rotation_correlated=tuple(correlated[ROTATION]),
        rotation_time_s=float(times[0]),
        direction_white=tuple(density[DIRECTION]),
        direction_correlated=tuple(correlated[DIRECTION]),
        direction_time_s=float(times[3]),
        scale_white=float(density[SCALE]),
        scale_correlated=float(correlated[SCALE]),
        scale_time_s=float(times[SCALE]),
        translation_floor=translation_floor,
        tail=tail,
    )


def _visible(recordings: Sequence[AnsweredMotions]) -> Array:
    """Share (3,) of a turn of the direction of motion about each axis that can be seen, mean over the pairs."""
    t = np.concatenate([each.T_true[each.valid, :3, 3] for each in recordings])
    length = np.linalg.norm(t, axis=1)
    moving = length > 0.0
    share: Array = 1.0 - ((t[moving] / length[moving, None]) ** 2).mean(axis=0)
    return share


def _products(courses: Sequence[Array], lags: int) -> Array:
    """C(0) … C(lags): mean products of values so many pairs apart; NaN values take no part."""
    totals, counts = np.zeros(lags + 1), np.zeros(lags + 1)
    for course in courses:
        known = np.isfinite(course)
        values = np.where(known, course, 0.0)
        for lag in range(min(lags, len(course) - 1) + 1):
            end = len(course) - lag
            totals[lag] += values[:end] @ values[lag:]
            counts[lag] += float((known[:end] & known[lag:]).sum())
    means: Array = totals / np.maximum(counts, 1.0)
    return means


def _decay(products: Array, duration_s: float) -> tuple[Array, float]:
    """Variances (K,) and common correlation time of K processes, by least squares over C(l), l ≥ 1."""
    lags = np.arange(1, products.shape[1])
    shapes = np.exp(-lags * duration_s / _TIMES_S[:, None])
    variances = np.maximum(products[:, 1:] @ shapes.T / (shapes**2).sum(axis=1), 0.0)
    misfit = ((products[:, None, 1:] - variances[:, :, None] * shapes) ** 2).sum(axis=(0, 2))
    best = int(misfit.argmin())
    # More than all of it cannot last.
    return np.minimum(variances[:, best], products[:, 0]), float(_TIMES_S[best])


def _tail(values: Sequence[Array], variance: Array, white: Array) -> float:
    """Degrees of freedom ν that all signals agree with best."""
    from scipy.special import chdtri

    misfit = np.zeros(len(_TAILS))
    for each, lasting, noise in zip(values, variance, white, strict=True):
        size = np.abs(each)
        measured = np.sqrt(size).mean() ** 2 / size.mean() if size.any() else 0.0
        for k, tail in enumerate(_TAILS):
            spread = lasting + noise * (tail - 2.0) / chdtri(tail, _QUANTILES)
            # Of a standard Gaussian E√|z| = 0.82218 and E|z| = √(2/π).
            expected = 0.82218**2 * np.mean(spread**0.25) ** 2 / (np.sqrt(2.0 / np.pi) * np.mean(np.sqrt(spread)))
            misfit[k] += (measured - expected) ** 2 if noise > 0.0 else 0.0
    return float(_TAILS[int(misfit.argmin())])
