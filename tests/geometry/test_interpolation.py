"""Poses between samples, and where there are none."""

import numpy as np

from geometry_tolerances import ROUNDING
from vioframe.geometry import se3, so3
from vioframe.geometry.interpolation import differentiate_positions, interpolate_poses
from vioframe.types import Trajectory

SECOND = 1_000_000_000
START = 1_403_715_273_262_142_976
"""A stamp of EuRoC: as a float of seconds it would be off by 100 ns."""

TWIST = np.array([0.3, -0.2, 0.5])
SPEED = np.array([1.0, -2.0, 0.5])


def steady(times_s: np.ndarray) -> Trajectory:
    """Constant body rate and constant velocity, which the interpolation follows exactly."""
    return Trajectory(
        stamps_ns=START + np.round(times_s * SECOND).astype(np.int64),
        T_world_body=se3.from_parts(so3.exp(times_s[:, None] * TWIST), times_s[:, None] * SPEED),
    )


def test_a_steady_motion_is_followed_exactly() -> None:
    trajectory = steady(np.array([0.0, 0.1, 0.35, 0.4, 1.0]))
    times = np.linspace(0.0, 1.0, 101)
    poses, covered = interpolate_poses(trajectory, START + np.round(times * SECOND).astype(np.int64), max_gap_ns=SECOND)
    assert covered.all()
    np.testing.assert_allclose(poses, steady(times).T_world_body, atol=1e-9)


def test_samples_are_met_exactly() -> None:
    trajectory = steady(np.linspace(0, 1, 11))
    poses, covered = interpolate_poses(trajectory, trajectory.stamps_ns, max_gap_ns=1)
    assert covered.all()
    np.testing.assert_allclose(poses, trajectory.T_world_body, atol=ROUNDING)


def test_outside_and_in_gaps_is_not_covered() -> None:
    trajectory = steady(np.array([0.0, 0.1, 0.2, 1.2, 1.3]))
    times = np.array([-0.01, 0.05, 0.2, 0.21, 1.19, 1.2, 1.25, 1.31])
    stamps = START + np.round(times * SECOND).astype(np.int64)
    poses, covered = interpolate_poses(trajectory, stamps, max_gap_ns=SECOND // 5)
    np.testing.assert_array_equal(covered, [False, True, True, False, False, True, True, False])
    np.testing.assert_allclose(poses[0], trajectory.T_world_body[0], atol=ROUNDING)
    np.testing.assert_allclose(poses[-1], trajectory.T_world_body[-1], atol=ROUNDING)


def test_rotation_takes_the_short_way() -> None:
    R = so3.rotation_z(np.array([0.0, 3.0, 6.0]))
    trajectory = Trajectory(stamps_ns=START + np.arange(3) * SECOND, T_world_body=se3.from_parts(R, np.zeros((3, 3))))
    between = np.array([START + SECOND // 2, START + 3 * SECOND // 2])
    poses, _ = interpolate_poses(trajectory, between, max_gap_ns=SECOND)
    np.testing.assert_allclose(poses[:, :3, :3], so3.rotation_z(np.array([1.5, 4.5])), atol=ROUNDING)


def test_velocities_are_the_differences_or_the_given_ones() -> None:
    trajectory = steady(np.array([0.0, 0.1, 0.35, 0.4, 1.0]))
    np.testing.assert_allclose(differentiate_positions(trajectory), np.tile(SPEED, (5, 1)), atol=1e-9)
    given = Trajectory(
        stamps_ns=trajectory.stamps_ns, T_world_body=trajectory.T_world_body, v_world_body=np.ones((5, 3))
    )
    np.testing.assert_array_equal(differentiate_positions(given), np.ones((5, 3)))
