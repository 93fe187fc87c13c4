"""The spline's derivatives are those of the motion it draws."""

import numpy as np
import pytest

from vioframe.data.simulator.spline import ORDER, SplineMotion, basis_weights, control_times
from vioframe.errors import ConfigError
from vioframe.geometry import so3


def random_motion(seed: int, count: int = 40, knot_s: float = 0.2) -> SplineMotion:
    rng = np.random.default_rng(seed)
    rotations = [np.eye(3)]
    for step in 0.4 * rng.standard_normal((count - 1, 3)):
        rotations.append(rotations[-1] @ so3.exp(step))
    return SplineMotion(knot_s=knot_s, positions=rng.standard_normal((count, 3)), rotations=np.array(rotations))


def test_spline_refuses_too_few_control_poses() -> None:
    with pytest.raises(ConfigError, match="at least 6"):
        SplineMotion(knot_s=0.1, positions=np.zeros((5, 3)), rotations=np.tile(np.eye(3), (5, 1, 1)))


def test_spline_refuses_a_step_that_is_not_positive() -> None:
    with pytest.raises(ConfigError, match="knot_s"):
        SplineMotion(knot_s=0.0, positions=np.zeros((6, 3)), rotations=np.tile(np.eye(3), (6, 1, 1)))


def test_weights_are_a_partition_of_unity() -> None:
    weights = basis_weights(np.linspace(0.0, 1.0, 11))
    assert weights.min() > -1e-15
    np.testing.assert_allclose(weights.sum(axis=0), 1.0, atol=1e-14)


@pytest.mark.parametrize("seed", [0, 1])
def test_derivatives_agree_with_differences(seed: int) -> None:
    motion = random_motion(seed)
    times = np.random.default_rng(seed).uniform(0.1, motion.duration_s - 0.1, 200)
    h = 1e-5
    before, now, after = (motion.evaluate(times + step) for step in (-h, 0.0, h))
    moved = (after.T_world_body[:, :3, 3] - before.T_world_body[:, :3, 3]) / (2 * h)
    np.testing.assert_allclose(now.velocity, moved, atol=1e-6)
    np.testing.assert_allclose(now.acceleration, (after.velocity - before.velocity) / (2 * h), atol=1e-5)
    R_before, R_after = before.T_world_body[:, :3, :3], after.T_world_body[:, :3, :3]
    turned = so3.log(np.swapaxes(R_before, -1, -2) @ R_after) / (2 * h)
    np.testing.assert_allclose(now.rotation_rate, turned, atol=1e-6)
    bend = (after.rotation_rate - before.rotation_rate) / (2 * h)
    np.testing.assert_allclose(now.rotation_acceleration, bend, atol=1e-5)


def test_acceleration_is_continuous_across_knots() -> None:
    motion = random_motion(3)
    knots = motion.knot_s * np.arange(1, 30)
    before, after = motion.evaluate(knots - 1e-9), motion.evaluate(knots + 1e-9)
    np.testing.assert_allclose(before.acceleration, after.acceleration, atol=1e-4)
    np.testing.assert_allclose(before.rotation_acceleration, after.rotation_acceleration, atol=1e-4)


def test_it_rests_where_control_poses_agree() -> None:
    motion = random_motion(4)
    motion = SplineMotion(
        knot_s=0.2,
        positions=np.concatenate([np.repeat(motion.positions[:1], 10, axis=0), motion.positions]),
        rotations=np.concatenate([np.repeat(motion.rotations[:1], 10, axis=0), motion.rotations]),
    )
    state = motion.evaluate(np.linspace(0.0, 0.2 * (10 - ORDER + 1), 50))
    assert np.abs(state.velocity).max() < 1e-12
    assert np.abs(state.rotation_rate).max() < 1e-12


def test_shapes_follow_the_times() -> None:
    motion = random_motion(5)
    assert motion.evaluate(1.0).T_world_body.shape == (4, 4)
    assert motion.evaluate(np.ones((2, 3))).velocity.shape == (2, 3, 3)


def test_control_times_cover_the_duration() -> None:
    for duration_s in (0.05, 1.0, 3.33):
        times = control_times(duration_s, 0.1)
        assert (len(times) - ORDER + 1) * 0.1 >= duration_s - 1e-9
