"""The conventions every part of vioframe shares, each held by a test in ``tests/conventions``.

Frames
    The body frame *is* the IMU frame. The world has z up; gravity is ``(0, 0, -g)``. The camera looks
    along +z, with x to the right and y down. ``T_a_b`` maps coordinates of b into a:
    ``p_a = T_a_b @ p_b``, so inner names touch: ``T_world_cam = T_world_body @ T_body_cam``.

Pixels
    x to the right, y down; the centre of the top-left pixel is (0, 0).

Clocks
    Stamps are integer nanoseconds. A frame is on the camera clock until a synchronizer has moved it to
    the IMU clock: ``t_imu = t_cam + camera_delay``.

Inertial samples
    The accelerometer measures specific force: it reads +g upwards at rest. Rotation rates are those of
    the body relative to the world, in body axes. A stamped sample is the value *at* its stamp.

Uncertainty
    Tangent vectors of motions are ordered (rotation, translation). Errors are local, on the right:
    ``R_true = R_estimated Exp(θ)``. A state covariance is ordered (θ, p, v, b_g, b_a), with p and v in
    the world; a preintegrated one (R, v, p), with v and p in the first body frame.
"""

import numpy as np

GRAVITY = 9.81
"""Magnitude of gravity in m/s² where a recording does not give its own."""

NANOSECONDS = 1_000_000_000
"""Nanoseconds in a second."""

STATE_ORDER = ("theta", "p", "v", "bias_gyro", "bias_accel")
"""Blocks of three in ``NavState.covariance``."""


def gravity_vector(gravity: float = GRAVITY) -> np.ndarray:
    """Return the acceleration of free fall in the world, (3,) m/s²."""
    return np.array([0.0, 0.0, -gravity])


def seconds(duration_ns: int) -> float:
    """Convert a *difference* of stamps to seconds; absolute stamps would lose digits as floats."""
    return float(duration_ns) / NANOSECONDS
