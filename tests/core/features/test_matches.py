"""Average precision and matching score, against counting by hand and by loops."""

import numpy as np
import pytest

from vioframe.features import average_precision, matching_score


def by_loops(distance, apart, correct_px):
    """The definition, one direction, proposal by proposal; distances must differ."""
    possible = sum(any(gap <= correct_px for gap in row) for row in apart.tolist())
    proposals = []
    for row, gaps in zip(distance.tolist(), apart.tolist(), strict=True):
        nearest = min(range(len(row)), key=row.__getitem__)
        proposals.append((row[nearest], gaps[nearest] <= correct_px))
    area, right = 0.0, 0
    for number, (_, good) in enumerate(sorted(proposals), start=1):
        right += good
        area += good * right / number / possible
    return area


def test_agrees_with_the_definition():
    rng = np.random.default_rng(3)
    for _ in range(5):
        distance, apart = rng.uniform(0, 2, (40, 30)), rng.uniform(0, 40, (40, 30))
        expected = 0.5 * (by_loops(distance, apart, 3.0) + by_loops(distance.T, apart.T, 3.0))
        assert average_precision(distance, apart, 3.0) == pytest.approx(expected)


def test_perfect_descriptors_have_1_and_misleading_ones_0():
    apart = np.where(np.eye(6) > 0, 0.5, 50.0)
    assert average_precision(1.0 - np.eye(6), apart, 3.0) == 1.0
    shifted = 1.0 - np.roll(np.eye(6), 1, axis=1)
    assert average_precision(shifted, apart, 3.0) == 0.0


def test_points_without_counterpart_harm_only_where_they_rank_before_right_ones():
    apart = np.full((3, 2), 50.0)
    apart[0, 0] = apart[1, 1] = 0.0
    last = np.array([[0.1, 1.0], [1.0, 0.2], [0.9, 0.8]])
    assert average_precision(last, apart, 3.0) == 1.0
    first = np.array([[0.3, 1.0], [1.0, 0.2], [0.9, 0.1]])
    # Of the first picture's three, ranked: wrong, right, right; of the second's two: wrong, right.
    assert average_precision(first, apart, 3.0) == pytest.approx(0.5 * (0.5 * (1 / 2 + 2 / 3) + 0.5 * (1 / 2)))


def test_proposals_of_equal_distance_are_taken_together():
    """So that no order of points among equals is luckier than another."""
    apart = np.where(np.eye(4) > 0, 0.0, 50.0)
    apart[2, 2] = 9.0
    distance = np.where(np.eye(4) > 0, 7.0, 90.0)
    for order in ([0, 1, 2, 3], [2, 0, 1, 3], [3, 1, 0, 2]):
        # Three right ones of four proposals, at one threshold.
        assert average_precision(distance[order][:, order], apart[order][:, order], 3.0) == pytest.approx(3 / 4)


def test_a_limit_ends_the_curve():
    apart = np.where(np.eye(2) > 0, 0.0, 50.0)
    distance = np.array([[0.2, 1.0], [1.0, 0.8]])
    assert average_precision(distance, apart, 3.0, 0.7) == pytest.approx(0.5)
    assert average_precision(distance, apart, 3.0, 0.1) == 0.0


@pytest.mark.parametrize("shape", [(0, 0), (0, 4), (4, 0), (3, 3)])
def test_nothing_possible_is_nothing_recovered(shape):
    assert average_precision(np.ones(shape), np.full(shape, 50.0), 3.0) == 0.0


def test_matching_score_is_the_mean_share_of_both():
    assert matching_score(30, (60, 100)) == pytest.approx(0.4)
    assert matching_score(0, (0, 10)) == 0.0
