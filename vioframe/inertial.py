"""Noise densities ↔ discrete covariances, and what an accelerometer says about gravity.

Source: Crassidis & Junkins, "Optimal Estimation of Dynamic Systems", 2nd ed., section 4.7.
"""

import numpy as np

from vioframe.checks import Array
from vioframe.geometry import so3
from vioframe.types import ImuNoise


def white_sigma(density: float, step_s: float) -> float:
    """Standard deviation of one sample of white noise of this density, sampled every ``step_s``."""
    return float(density / np.sqrt(step_s))


def walk_sigma(density: float, step_s: float) -> float:
    """Standard deviation of the step that a bias takes in ``step_s``."""
    return float(density * np.sqrt(step_s))


def bias_walk_covariance(noise: ImuNoise, duration_s: float) -> Array:
    """Covariance (6, 6), order (gyro, accel), that the biases gain in ``duration_s``."""
    return np.diag(np.repeat([noise.gyro_walk**2, noise.accel_walk**2], 3) * duration_s)


def level(accel_at_rest: Array, yaw: float = 0.0) -> Array:
    """R_world_body (3, 3) from the specific force (3,) at rest, with the body's x axis at ``yaw`` where defined.

    Roll and pitch come from gravity; the heading is free, and ``yaw`` (rad) sets it: the body's x axis is
    turned onto that heading about the vertical (its y axis, where x stands upright).
    """
    R_world_body = so3.from_two_vectors(accel_at_rest, np.array([0.0, 0.0, 1.0]))
    x_axis = R_world_body[:, 0] if abs(R_world_body[2, 0]) < 0.9 else R_world_body[:, 1]
    return so3.rotation_z(yaw - np.arctan2(x_axis[1], x_axis[0])) @ R_world_body
