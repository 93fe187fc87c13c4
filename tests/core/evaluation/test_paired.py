"""Paired comparison: exact where the answer is known, calibrated where it is not."""

import math

import numpy as np
import pytest
from scipy.stats import wilcoxon

from vioframe.evaluation.paired import Ratio, compare_pairs, show_p, show_ratio


def pairs(values):
    return dict(enumerate(values))


def test_ratio_and_counts_of_a_constant_factor():
    base = pairs([0.1, 0.2, 0.05, 0.4, 0.3, 0.15])
    half = {key: 0.5 * value for key, value in base.items()}
    found = compare_pairs(base, half)
    assert found.of_medians.value == pytest.approx(0.5)
    assert (found.of_pairs.low, found.of_pairs.high) == pytest.approx((0.5, 0.5))
    assert (found.better, found.worse, found.pairs) == (6, 0, 6)
    # All six of one sign: 2 of the 64 equally likely patterns of signs are this extreme.
    assert found.p_value == pytest.approx(2 / 64)


def test_test_is_scipys_on_logarithms():
    rng = np.random.default_rng(0)
    first, second = rng.lognormal(size=15), rng.lognormal(0.3, size=15)
    found = compare_pairs(pairs(first), pairs(second))
    assert found.p_value == pytest.approx(wilcoxon(np.log(second / first)).pvalue)
    # A recording in other units changes its pair by the same factor, and so nothing.
    scale = rng.lognormal(sigma=2.0, size=15)
    assert compare_pairs(pairs(first * scale), pairs(second * scale)).p_value == pytest.approx(found.p_value)


def test_exchanged_systems_give_the_inverse():
    rng = np.random.default_rng(1)
    first, second = pairs(rng.lognormal(size=11)), pairs(rng.lognormal(size=11))
    there, back = compare_pairs(first, second), compare_pairs(second, first)
    assert there.of_medians.value == pytest.approx(1.0 / back.of_medians.value)
    assert there.of_pairs.value == pytest.approx(1.0 / back.of_pairs.value)
    assert (there.better, there.worse) == (back.worse, back.better)
    assert there.p_value == pytest.approx(back.p_value)


def test_equal_systems_are_not_told_apart():
    base = pairs([0.1, 0.2, 0.3])
    found = compare_pairs(base, base)
    same = Ratio(value=1.0, low=1.0, high=1.0)
    assert (found.better, found.worse, found.of_pairs, found.p_value) == (0, 0, same, 1.0)
    assert found.of_medians.value == 1.0


def test_pairs_see_what_medians_of_all_recordings_hide():
    """Recordings differ by more than systems do: the middle run of each need not be of the same recording."""
    base = pairs([1.0, 1.1, 1.2, 10.0, 11.0])
    found = compare_pairs(base, {0: 1.3, 1: 1.4, 2: 1.15, 3: 12.0, 4: 12.0})
    assert found.of_pairs.value == pytest.approx(1.2)
    assert found.of_medians.value == pytest.approx(1.4 / 1.2)


def test_chance_is_called_significant_as_often_as_it_says():
    rng = np.random.default_rng(2)
    below = [
        compare_pairs(pairs(rng.lognormal(size=12)), pairs(rng.lognormal(size=12))).p_value <= 0.05 for _ in range(400)
    ]
    assert 0.02 < np.mean(below) < 0.08


def test_interval_holds_the_true_ratio_about_as_often_as_it_says():
    rng = np.random.default_rng(3)
    medians, within = [], []
    for _ in range(120):
        first = rng.lognormal(sigma=0.5, size=25)
        second = 0.8 * first * rng.lognormal(sigma=0.2, size=25)
        found = compare_pairs(pairs(first), pairs(second))
        medians.append(found.of_medians.low <= 0.8 <= found.of_medians.high)
        within.append(found.of_pairs.low <= 0.8 <= found.of_pairs.high)
    assert np.mean(medians) > 0.88 and np.mean(within) > 0.88


def test_failed_run_is_worse_than_any_other():
    base = pairs([0.1, 0.2, 0.3, 0.4, 0.5])
    one_failed = {**base, 4: math.inf}
    found = compare_pairs(base, one_failed)
    assert (found.better, found.worse) == (0, 1)
    assert found.of_medians.value == found.of_pairs.value == 1.0 and math.isinf(found.of_pairs.high)
    assert "∞" in show_ratio(found.of_pairs)
    # A failure outranks the largest finite difference, whatever that is.
    gain = {key: 1e-3 * value for key, value in base.items()}
    assert compare_pairs(base, {**gain, 4: math.inf}).p_value == pytest.approx(wilcoxon([-1, -1, -1, -1, 9]).pvalue)
    both = compare_pairs({0: math.inf, 1: 1.0}, {0: math.inf, 1: 1.0})
    assert (both.better, both.worse, both.p_value) == (0, 0, 1.0)


def test_half_of_the_runs_failed_leaves_no_ratio():
    found = compare_pairs(pairs([0.1, 0.2]), pairs([0.1, math.inf]))
    assert found.of_medians is None and found.of_pairs is None and show_ratio(None) == "none"
    healed = compare_pairs(pairs([math.inf, math.inf]), pairs([0.1, 0.2]))
    assert healed.of_medians is None and healed.of_pairs.value == 0.0


def test_only_what_both_have_is_compared_and_nothing_is_no_error():
    assert compare_pairs({"a": 1.0, "b": 2.0}, {"b": 1.0, "c": 3.0}).pairs == 1
    nothing = compare_pairs({"a": 1.0}, {})
    assert nothing.pairs == 0 and nothing.p_value is None
    assert nothing.sentence() == "no pair of runs to compare"


def test_where_more_is_better_a_gain_is_better_and_zero_may_occur():
    found = compare_pairs(pairs([0.0, 0.5, 0.9]), pairs([0.4, 0.6, 0.9]), lower_is_better=False)
    assert (found.better, found.worse) == (2, 0)


def test_words():
    assert show_p(0.00001) == "< 0.001" and show_p(0.034) == "0.034" and show_p(None) == "–"
    found = compare_pairs(pairs([2.0, 2.0]), pairs([1.0, 1.0]))
    assert found.sentence() == (
        "ratio of medians 0.50 (0.50…0.50), median of the ratios 0.50 (0.50…0.50), "
        "better in 2 and worse in 0 of 2, p = 0.5"
    )
    many = compare_pairs(pairs([2.0] * 20), pairs([1.0] * 20))
    assert many.sentence().endswith("p < 0.001")
