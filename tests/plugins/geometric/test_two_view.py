"""Two-view odometry: exact without noise, honest with it, silent where nothing can be known."""

import numpy as np
import pytest

from synthetic_tracks import Scene, make_rig, make_room, make_walk, run
from vioframe.errors import ConfigError, DataError, StateError
from vioframe.geometry import se3, so3
from vioframe.types import SensorRig
from vioframe_geometric import TwoViewVO


def scene(sigma_px, step=4, count=40, **options):
    return Scene(make_rig(cameras=1), make_walk(count * step, seed=2)[::step], make_room(2), sigma_px, **options)


def compare(result):
    """Rotation errors and errors of direction in degrees."""
    rotation, direction = [], []
    for motion, truth, _ in result.steps:
        rotation.append(np.degrees(so3.angle(motion.T_prev_cur[:3, :3].T @ truth[:3, :3])))
        unit = truth[:3, 3] / np.linalg.norm(truth[:3, 3])
        direction.append(np.degrees(np.arccos(np.clip(unit @ motion.T_prev_cur[:3, 3], -1, 1))))
    return np.array(rotation), np.array(direction)


def test_exact_without_noise():
    result = run(TwoViewVO(), scene(0.0, count=15))
    rotation, direction = compare(result)
    # Two pairs see a single wall: two motions explain it without error, which makes it invalid, not wrong.
    assert result.valid.mean() > 0.8
    assert rotation.max() < 0.01
    assert direction.max() < 0.1


def test_unit_length_and_honest_covariance():
    result = run(TwoViewVO(), scene(0.5, step=6))
    assert result.valid.mean() > 0.7
    rotation, direction = compare(result)
    assert np.median(rotation) < 0.2
    assert np.median(direction) < 2.0
    nees = []
    for motion, truth, _ in result.steps:
        t = motion.T_prev_cur[:3, 3]
        assert np.linalg.norm(t) == pytest.approx(1.0)
        # Nothing is known of the length: a variance of one along the translation.
        along = motion.T_prev_cur[:3, :3].T @ t
        assert along @ motion.covariance[3:, 3:] @ along == pytest.approx(1.0, abs=1e-6)
        off = motion.T_prev_cur[:3, :3].T @ (truth[:3, 3] / np.linalg.norm(truth[:3, 3]) - t)
        error = np.concatenate([so3.log(motion.T_prev_cur[:3, :3].T @ truth[:3, :3]), off])
        nees.append(error @ np.linalg.solve(motion.covariance, error) / 5)
    assert 0.3 < np.median(nees) / 0.87 < 2.0


def test_outliers_are_counted_out():
    result = run(TwoViewVO(), scene(0.3, count=15, outliers=0.2))
    _, direction = compare(result)
    assert result.valid.mean() > 0.6
    assert np.median(direction) < 2.5
    assert max(motion.inliers for motion, _, _ in result.steps) < 140


def test_rotation_and_standstill_have_no_direction():
    T = np.tile(make_walk(1), (10, 1, 1))
    turning = T.copy()
    turning[:, :3, :3] = T[:, :3, :3] @ so3.exp(np.arange(10)[:, None] * np.array([0.0, 0.02, 0.08]))
    for motion in (T, turning):
        assert not run(TwoViewVO(), Scene(make_rig(cameras=1), motion, make_room(3))).valid.any()


def test_too_few_points_give_nothing():
    assert not run(TwoViewVO(), scene(0.3, count=6, most=12)).valid.any()


def test_a_plane_is_no_trap():
    """All points on one wall: two motions may fit equally well; what is said to be valid must be right."""
    rng = np.random.default_rng(4)
    wall = np.column_stack([np.full(800, 3.0), rng.uniform(-4, 4, 800), rng.uniform(-2, 3, 800)])
    T = np.tile(np.eye(4), (12, 1, 1))
    T[:, :3, 3] = np.arange(12)[:, None] * [0.1, 0.2, 0.05]
    result = run(TwoViewVO(), Scene(make_rig(cameras=1), T, wall, sigma_px=0.1))
    _, direction = compare(result)
    assert (direction < 8.0).mean() > 0.9 if len(direction) else True


def test_wrong_use_is_named():
    with pytest.raises(ConfigError, match=r"vo\.sigma_px must be positive, got 0"):
        TwoViewVO(sigma_px=0.0)
    with pytest.raises(ConfigError, match=r"vo\.min_points must be at least 8, got 3"):
        TwoViewVO(min_points=3)
    features = next(iter(scene(0.1)))[0]
    with pytest.raises(StateError, match="setup"):
        TwoViewVO().estimate(features, features)
    with pytest.raises(DataError, match="needs a camera"):
        TwoViewVO().setup(SensorRig(cameras=(), imu=make_rig().imu))
    assert np.allclose(se3.inverse(np.eye(4)), np.eye(4))
