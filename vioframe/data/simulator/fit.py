"""Fits a smooth motion to recorded poses, so that a recorded trajectory gets exact derivatives."""

import numpy as np

from vioframe.checks import Array
from vioframe.conventions import NANOSECONDS
from vioframe.data.simulator.spline import ORDER, SplineMotion, basis_weights, control_times
from vioframe.errors import DataError
from vioframe.geometry import so3
from vioframe.geometry.interpolation import interpolate_poses
from vioframe.types import Trajectory

# Each round leaves an error quadratic in the turn between control poses; six leave nothing to see.
_ROTATION_ROUNDS = 6
# Weight of third differences of the control poses, against samples of weight one: decides only what no sample says.
_SMOOTHING = 1e-4


def longest_covered(trajectory: Trajectory, max_gap_s: float) -> Trajectory:
    """The longest stretch without a step of more than ``max_gap_s``.

    Raises:
        DataError: no stretch has as many as ten poses.
    """
    breaks = np.flatnonzero(np.diff(trajectory.stamps_ns) > max_gap_s * NANOSECONDS) + 1
    starts, ends = np.append(0, breaks), np.append(breaks, len(trajectory))
    spans = trajectory.stamps_ns[ends - 1] - trajectory.stamps_ns[starts]
    best = int(np.argmax(spans))
    part = slice(int(starts[best]), int(ends[best]))
    if ends[best] - starts[best] < 10:
        raise DataError(
            f"the ground truth has no stretch of ten poses without a hole of {max_gap_s:g} s: raise dataset.max_gap_s"
        )
    velocity = trajectory.v_world_body
    return Trajectory(
        stamps_ns=trajectory.stamps_ns[part],
        T_world_body=trajectory.T_world_body[part],
        v_world_body=None if velocity is None else velocity[part],
        causal=trajectory.causal,
    )


def fit_spline(trajectory: Trajectory, knot_s: float) -> SplineMotion:
    """Least-squares motion through poses; its time zero is the first stamp.

    Position is linear in the control points. For rotation the residuals ``Log(Rᵀ R_given)`` are spread over
    the control rotations with the same weights, again and again.

    Args:
        trajectory: without holes of more than a few knots.
        knot_s: time between control poses: short enough for the motion, long enough to average the noise.
    """
    from scipy.linalg import cho_solve_banded, cholesky_banded

    elapsed_s = (trajectory.stamps_ns - trajectory.stamps_ns[0]) / NANOSECONDS
    times = control_times(float(elapsed_s[-1]), knot_s)
    count = len(times)
    near_ns = trajectory.stamps_ns[0] + np.round(np.clip(times, 0.0, elapsed_s[-1]) * NANOSECONDS).astype(np.int64)
    start, _ = interpolate_poses(trajectory, near_ns, max_gap_ns=NANOSECONDS)
    rotations = start[:, :3, :3]
    first = np.minimum((elapsed_s / knot_s).astype(np.int64), count - ORDER)
    weights = basis_weights(elapsed_s / knot_s - first)
    band = np.zeros((ORDER, count))
    for a in range(ORDER):
        for b in range(a, ORDER):
            band[b - a] += np.bincount(first + a, weights[a] * weights[b], minlength=count)
    third = np.array([-1.0, 3.0, -3.0, 1.0])
    for a in range(4):
        for b in range(a, 4):
            band[b - a, a : count - 3 + a] += _SMOOTHING * third[a] * third[b]
    factor = cholesky_banded(band, lower=True)

    def spread(residual: Array) -> Array:
        right = np.zeros((count, 3))
        for a in range(ORDER):
            for axis in range(3):
                right[:, axis] += np.bincount(first + a, weights[a] * residual[:, axis], minlength=count)
        solved: Array = cho_solve_banded((factor, True), right)
        return solved

    positions = start[:, :3, 3]
    for _ in range(2):
        motion = SplineMotion(knot_s=knot_s, positions=positions, rotations=rotations)
        positions = positions + spread(
            trajectory.T_world_body[:, :3, 3] - motion.evaluate(elapsed_s).T_world_body[:, :3, 3]
        )
    for _ in range(_ROTATION_ROUNDS):
        motion = SplineMotion(knot_s=knot_s, positions=positions, rotations=rotations)
        fitted = motion.evaluate(elapsed_s).T_world_body[:, :3, :3]
        residual = so3.log(np.swapaxes(fitted, -1, -2) @ trajectory.T_world_body[:, :3, :3])
        rotations = rotations @ so3.exp(spread(residual))
    return SplineMotion(knot_s=knot_s, positions=positions, rotations=so3.normalise(rotations))
