"""Which tracks may enter the window, and what a turn without parallax says."""

import numpy as np
import pytest

from synthetic_tracks import R_BODY_CAM
from vioframe.geometry import se3, so3
from vioframe_window.keyframes import View
from vioframe_window.options import LandmarkOptions
from vioframe_window.triangulation import Doubts, find_new_points
from vioframe_window.turning import find_turn

FOCAL_PX = 460.0
OPTIONS = LandmarkOptions()


def views_of(T_world_cam, points, sigma_px=0.0, seed=0):
    rng = np.random.default_rng(seed)
    views = []
    for T in T_world_cam:
        local = se3.transform(se3.inverse(T), points)
        local = local / np.linalg.norm(local, axis=1, keepdims=True)
        local += sigma_px / FOCAL_PX * rng.normal(size=local.shape)
        bearings = local / np.linalg.norm(local, axis=1, keepdims=True)
        views.append(View(ids=np.arange(len(points)), points=bearings[:, :2] / bearings[:, 2:], bearings=bearings))
    return views


def sideways(count=5, step=0.1):
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = R_BODY_CAM
    T[:, 1, 3] = step * np.arange(count)
    return T


def ahead(seed=1, count=30, far=6.0):
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(2.0, far, count), rng.uniform(-1, 1, count), rng.uniform(-1, 1, count)])


def find(T_world_cam, views, ids, doubts=None, most=100):
    return find_new_points(T_world_cam, views, ids, OPTIONS, most=most, focal_px=FOCAL_PX, slack=1.0, doubts=doubts)


def test_points_are_where_they_are():
    T, points = sideways(), ahead()
    found = find(T, views_of(T, points), np.arange(30))
    order = np.argsort(found.ids)
    np.testing.assert_array_equal(found.ids[order], np.arange(30))
    np.testing.assert_allclose(found.points_world[order], points, atol=1e-9)


def test_points_without_parallax_wait():
    T = sideways(step=0.005)
    assert len(find(T, views_of(T, ahead()), np.arange(30)).ids) == 0


def test_no_point_behind_a_camera_enters():
    T, points = sideways(), ahead()
    views = views_of(T, points)
    # Rays that part as the camera moves meet behind it.
    swapped = [View(ids=v.ids, points=w.points, bearings=w.bearings) for v, w in zip(views, views[::-1], strict=True)]
    found = find(T, swapped, np.arange(30))
    assert len(found.ids) == 0
    assert found.refused == 30


def test_a_wrong_observation_is_refused():
    T, points = sideways(), ahead()
    views = views_of(T, points, sigma_px=0.3)
    views[2].bearings[7] = so3.exp(np.array([8.0 / FOCAL_PX, 0.0, 0.0])) @ views[2].bearings[7]
    found = find(T, views, np.arange(30))
    assert 7 not in found.ids
    assert len(found.ids) > 25
    assert found.refused >= 1


def test_the_widest_parallax_enters_first():
    T, points = sideways(), ahead()
    found = find(T, views_of(T, points), np.arange(30), most=5)
    assert set(found.ids.tolist()) == set(np.argsort(np.linalg.norm(points - T[0, :3, 3], axis=1))[:8].tolist()) & set(
        found.ids.tolist()
    )
    assert len(found.ids) == 5


def test_parallax_that_a_gyro_bias_may_have_made_does_not_count():
    T, points = sideways(step=0.02), ahead(far=3.0)
    views, times = views_of(T, points), 0.2 * np.arange(5)
    assert len(find(T, views, np.arange(30), Doubts(times_s=times, rate_sigma=1e-3)).ids) > 0
    assert len(find(T, views, np.arange(30), Doubts(times_s=times, rate_sigma=0.05)).ids) == 0


def test_a_turn_on_the_spot_is_measured():
    points, turn = ahead(), so3.exp(np.array([0.02, -0.03, 0.05]))
    T = sideways(2, step=0.0)
    T[1, :3, :3] = T[0, :3, :3] @ turn
    views = views_of(T, points, sigma_px=0.3)
    found = find_turn(views[0], views[1], np.radians(1.0))
    assert found.agreeing == 30
    assert found.sigma == pytest.approx(np.sqrt(2.0) * 0.3 / FOCAL_PX * np.sqrt(2.0), rel=0.3)
    assert so3.angle(found.R_past_cam.T @ turn) < 3.0 * found.sigma


def test_a_shift_is_no_turn():
    T = sideways(2, step=0.5)
    views = views_of(T, ahead())
    assert find_turn(views[0], views[1], np.radians(1.0)) is None


def test_few_points_say_nothing_of_a_turn():
    T = sideways(2, step=0.0)
    views = views_of(T, ahead(count=8))
    assert find_turn(views[0], views[1], np.radians(1.0)) is None
