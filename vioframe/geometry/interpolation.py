"""Poses between the samples of a trajectory."""

import numpy as np

from vioframe.checks import Array, Stamps
from vioframe.conventions import NANOSECONDS
from vioframe.geometry import se3, so3
from vioframe.types import Trajectory


def interpolate_poses(trajectory: Trajectory, stamps_ns: Stamps, *, max_gap_ns: int) -> tuple[Array, np.ndarray]:
    """Poses at the given stamps: geodesic in rotation, linear in position.

    Args:
        trajectory: with at least two poses.
        stamps_ns: (M,).
        max_gap_ns: stamps between poses further apart than this are not covered.

    Returns:
        T_world_body (M, 4, 4), and covered (M,): False outside the trajectory or in a gap, where the pose
        is that of the nearest end.
    """
    known = trajectory.stamps_ns
    after = np.clip(np.searchsorted(known, stamps_ns, side="left"), 1, len(known) - 1)
    before = after - 1
    span = known[after] - known[before]
    fraction = np.clip((stamps_ns - known[before]) / span, 0.0, 1.0)
    exact = (stamps_ns == known[before]) | (stamps_ns == known[after])
    covered = (stamps_ns >= known[0]) & (stamps_ns <= known[-1]) & ((span <= max_gap_ns) | exact)
    T0, T1 = trajectory.T_world_body[before], trajectory.T_world_body[after]
    step = so3.log(np.swapaxes(T0[:, :3, :3], -1, -2) @ T1[:, :3, :3])
    rotation = T0[:, :3, :3] @ so3.exp(fraction[:, None] * step)
    position = T0[:, :3, 3] + fraction[:, None] * (T1[:, :3, 3] - T0[:, :3, 3])
    return se3.from_parts(rotation, position), covered


def differentiate_positions(trajectory: Trajectory) -> Array:
    """Velocities (N, 3) m/s in the world: the trajectory's own, or central differences of its positions."""
    if trajectory.v_world_body is not None:
        return trajectory.v_world_body
    elapsed = (trajectory.stamps_ns - trajectory.stamps_ns[0]) / NANOSECONDS
    velocity: Array = np.gradient(trajectory.T_world_body[:, :3, 3], elapsed, axis=0)
    return velocity
