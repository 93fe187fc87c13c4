"""Repeatability and localisation error, on points whose answer is known."""

import numpy as np
import pytest

from vioframe.features import distances_px, repetition

RNG = np.random.default_rng(0)
TURN = np.array([[0.9, -0.3, 40.0], [0.25, 1.05, -12.0], [3e-4, -2e-4, 1.0]])


def spaced_points(count=60):
    """Points at least 12 px apart, in any order."""
    grid = np.stack(np.meshgrid(np.arange(20.0, 300, 16), np.arange(20.0, 220, 16)), axis=-1).reshape(-1, 2)
    return RNG.permutation(grid)[:count] + RNG.uniform(-2, 2, (count, 2))


def warped(points, H):
    mapped = np.concatenate([points, np.ones((len(points), 1))], axis=1) @ H.T
    return mapped[:, :2] / mapped[:, 2:]


def test_the_same_points_are_all_found_again():
    points = spaced_points()
    for H in (np.eye(3), TURN):
        found = repetition(distances_px(points, warped(points, H), H), 3.0)
        assert found.repeatability == 1.0
        assert found.localisation_px == pytest.approx(0.0, abs=1e-9)


def test_half_of_the_points_displaced_by_a_known_amount():
    points = spaced_points(40)
    second = warped(points, TURN)
    second[:10] += np.array([0.6, 0.8])
    second[10:20] += np.array([0.0, 4.0])
    found = repetition(distances_px(points, second, TURN), 3.0)
    assert found.repeatability == pytest.approx(30 / 40)
    assert found.localisation_px == pytest.approx(10 * 1.0 / 30)
    assert not found.first[10:20].any() and found.first[20:].all()
    assert np.array_equal(found.first, found.second)


def test_counts_of_both_pictures_count():
    points = spaced_points(50)
    found = repetition(distances_px(points, points[:20], np.eye(3)), 3.0)
    assert found.repeatability == pytest.approx((20 + 20) / (50 + 20))


def test_two_points_beside_one_are_both_found_again():
    found = repetition(distances_px(np.array([[10.0, 10.0], [12.0, 10.0]]), np.array([[11.0, 10.0]]), np.eye(3)), 3.0)
    assert found.repeatability == 1.0
    assert found.localisation_px == pytest.approx(1.0)


def test_distances_are_taken_in_the_second_picture():
    double = np.diag([2.0, 2.0, 1.0])
    apart = distances_px(np.array([[10.0, 10.0]]), np.array([[24.0, 20.0]]), double)
    assert apart.tolist() == [[4.0]]


@pytest.mark.parametrize(("first", "second"), [(0, 0), (5, 0), (0, 5)])
def test_without_points_nothing_is_found_again(first, second):
    points = spaced_points(5)
    found = repetition(distances_px(points[:first], points[:second], np.eye(3)), 3.0)
    assert (found.repeatability, found.localisation_px) == (0.0, None)


def test_what_goes_behind_the_camera_is_near_nothing():
    behind = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-0.1, 0.0, 1.0]])
    apart = distances_px(np.array([[20.0, 5.0], [5.0, 5.0]]), np.array([[10.0, 10.0]]), behind)
    assert np.isinf(apart[0, 0]) and apart[1, 0] == pytest.approx(0.0)
