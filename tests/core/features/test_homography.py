"""Homographies from matches, and the error of their corners."""

import numpy as np
import pytest

from vioframe.features import corner_error_px, estimate_homography, homography_accuracy
from vioframe.pictures.homographies import warp_points

TRUE = np.array([[0.92, -0.21, 31.0], [0.18, 1.03, -22.0], [2.5e-4, -1.5e-4, 1.0]])
SIZE = (320, 240)


def some_points(count, seed=0):
    return np.random.default_rng(seed).uniform([10, 10], [310, 230], (count, 2))


@pytest.mark.parametrize("H", [np.eye(3), TRUE])
def test_exact_matches_give_the_exact_homography(make_protocol, H):
    points = some_points(50)
    estimated = estimate_homography(points, warp_points(points, H), make_protocol())
    assert corner_error_px(estimated, H, SIZE) < 1e-3


def test_half_wrong_matches_do_not_matter(make_protocol):
    points = some_points(120)
    second = warp_points(points, TRUE)
    second[:60] = some_points(60, seed=1)
    estimated = estimate_homography(points, second, make_protocol())
    assert corner_error_px(estimated, TRUE, SIZE) < 0.1


def test_the_same_matches_give_the_same_answer(make_protocol):
    points = some_points(80)
    second = warp_points(points, TRUE) + np.random.default_rng(2).normal(0, 1.5, points.shape)
    second[:50] = some_points(50, seed=3)
    answers = [estimate_homography(points, second, make_protocol()) for _ in range(2)]
    assert np.array_equal(*answers)


def test_a_known_shift_has_its_length_as_error():
    shift = np.array([[1.0, 0.0, 3.0], [0.0, 1.0, -4.0], [0.0, 0.0, 1.0]])
    assert corner_error_px(shift, np.eye(3), SIZE) == pytest.approx(5.0)
    # Corners of a picture scaled about the first one move by 0, w, the diagonal, and h times 1 %.
    scale = np.diag([1.01, 1.01, 1.0])
    moved = 0.01 * np.array([0.0, 319.0, np.hypot(319.0, 239.0), 239.0])
    assert corner_error_px(scale, np.eye(3), SIZE) == pytest.approx(moved.mean())


def test_no_estimate_is_infinitely_wrong(make_protocol):
    assert estimate_homography(some_points(3), some_points(3), make_protocol()) is None
    same = np.tile(some_points(1), (8, 1))
    assert corner_error_px(estimate_homography(same, same, make_protocol()), np.eye(3), SIZE) > 12.0
    assert corner_error_px(None, TRUE, SIZE) == float("inf")
    behind = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-0.01, 0.0, 1.0]])
    assert corner_error_px(behind, TRUE, SIZE) == float("inf")


def test_accuracy_is_the_share_of_pairs_up_to_the_threshold():
    errors = [0.2, 1.0, 2.9, float("inf")]
    assert [homography_accuracy(errors, px) for px in (0.1, 1, 3, 12)] == [0.0, 0.5, 0.75, 0.75]
