"""Strapdown navigation, sample by sample.

Savage, "Strapdown Inertial Navigation Integration Algorithm Design", parts 1 and 2, J. Guidance, Control,
and Dynamics 21(1-2), 1998: attitude by the rotation vector with coning correction, velocity with rotation
compensation and sculling, position with its own rotation compensation. His two-sample corrections are
written here for samples of rate and specific force instead of their integrals: with rate and force taken
as linear over a step s from (ω₀, a₀) to (ω₁, a₁),

    φ  = Δθ + s²/12 ω₀ × ω₁                                              (coning)
    Δv = R [Δυ + ½ φ × Δυ + ⅙ φ × (φ × Δυ) + s²/12 (ω₀ × a₁ + a₀ × ω₁)]      (rotation, sculling)
    Δp = v s + R [s² (a₀/3 + a₁/6) + s/6 φ × Δυ]

and Δθ, Δυ come from a parabola through the last three samples where they are evenly spaced. The error is
of third order in the step, one more than that of the midpoint rule.
"""

from functools import partial

import numpy as np

from vioframe.checks import Array
from vioframe.conventions import NANOSECONDS
from vioframe.errors import ConfigError, StateError
from vioframe.geometry import so3
from vioframe.interfaces import InertialIntegrator
from vioframe.types import ImuBias, ImuBlock, ImuNoise, InertialDelta, InertialPath, SensorRig

# A sample interpolated at the end of a window may be close to its neighbour, and the slope between two
# close noisy samples says nothing: the parabola needs steps whose lengths differ by less than this factor.
_EVEN = 2.0


class Strapdown(InertialIntegrator):
    """Classic navigation mechanisation in the body frame of the first sample.

    A loop over the samples that carries attitude, velocity, position, their covariance and their bias
    Jacobian; independent of :class:`Preintegration` in every formula, so that each is a check of the other.

    Args:
        max_gyro_bias_change: change of the gyro bias, rad/s, beyond which ``InertialDelta.at`` integrates
            again instead of using the Jacobian.
        max_accel_bias_change: the same of the accelerometer bias, m/s².

    Raises:
        ConfigError: a negative limit.
    """

    def __init__(self, *, max_gyro_bias_change: float = 0.01, max_accel_bias_change: float = 0.1) -> None:
        for name, value in (
            ("max_gyro_bias_change", max_gyro_bias_change),
            ("max_accel_bias_change", max_accel_bias_change),
        ):
            if not value >= 0.0:
                raise ConfigError(f"integrator.{name} must not be negative, got {value}")
        self._max_bias_change = (max_gyro_bias_change, max_accel_bias_change)
        self._noise: ImuNoise | None = None

    def setup(self, rig: SensorRig) -> None:
        """Take the noise densities of the next sequence."""
        self._noise = rig.imu

    def integrate(self, imu: ImuBlock, bias: ImuBias) -> InertialDelta:
        """Navigate from the first to the last sample; one sample alone is no motion."""
        if self._noise is None:
            raise StateError("Strapdown.integrate was called before setup(rig): set the integrator up first")
        elapsed = (imu.stamps_ns - imu.stamps_ns[0]) / NANOSECONDS
        steps = np.diff(elapsed)
        count = len(elapsed)
        gyro, accel = imu.gyro - bias.gyro, imu.accel - bias.accel

        # What each step does to a body at rest in its own first frame, and how that changes with the biases.
        s = steps[:, None]
        s33 = steps[:, None, None]
        identity = np.eye(3)
        w0, w1, a0, a1 = gyro[:-1], gyro[1:], accel[:-1], accel[1:]
        phi = _quadrature(gyro, steps) + s * s / 12 * np.cross(w0, w1)
        push = _quadrature(accel, steps)
        lateral = np.cross(phi, push)
        speed = push + lateral / 2 + np.cross(phi, lateral) / 6 + s * s / 12 * (np.cross(w0, a1) + np.cross(a0, w1))
        shift = s * s * (a0 / 3 + a1 / 6) + s / 6 * lateral
        turn = so3.exp(phi)

        phi_hat, push_hat = so3.hat(phi), so3.hat(push)
        phi_by_gyro = -s33 * identity + s33 * s33 / 12 * so3.hat(w1 - w0)
        speed_by_phi = -push_hat / 2 - (so3.hat(lateral) + phi_hat @ push_hat) / 6
        by_bias = np.zeros((count - 1, 9, 6))
        by_bias[:, :3, :3] = so3.right_jacobian(phi) @ phi_by_gyro
        by_bias[:, 3:6, :3] = speed_by_phi @ phi_by_gyro - s33 * s33 / 12 * so3.hat(a0 - a1)
        by_bias[:, 3:6, 3:] = -s33 * (identity + phi_hat / 2 + phi_hat @ phi_hat / 6) - s33 * s33 / 12 * so3.hat(
            w0 - w1
        )
        by_bias[:, 6:, :3] = -s33 / 6 * push_hat @ phi_by_gyro
        by_bias[:, 6:, 3:] = -s33 * s33 * (identity / 2 + phi_hat / 6)
        # White noise over a step acts like a bias of variance density²/s; what it does to the position
        # within the step besides, s³/12 of the strength, is added apart.
        strength = np.repeat([self._noise.gyro_noise**2, self._noise.accel_noise**2], 3)
        within = self._noise.accel_noise**2 / 12.0

        R = np.tile(identity, (count, 1, 1))
        velocity, position = np.zeros((count, 3)), np.zeros((count, 3))
        jacobian, covariance = np.zeros((9, 6)), np.zeros((9, 9))
        for k, step in enumerate(steps):
            R[k + 1] = R[k] @ turn[k]
            velocity[k + 1] = velocity[k] + R[k] @ speed[k]
            position[k + 1] = position[k] + velocity[k] * step + R[k] @ shift[k]
            transition = np.eye(9)
            transition[:3, :3] = turn[k].T
            transition[3:6, :3] = -R[k] @ so3.hat(speed[k])
            transition[6:, :3] = -R[k] @ so3.hat(shift[k])
            transition[6:, 3:6] = step * identity
            entry = by_bias[k].copy()
            entry[3:6] = R[k] @ entry[3:6]
            entry[6:] = R[k] @ entry[6:]
            jacobian = transition @ jacobian + entry
            covariance = transition @ covariance @ transition.T + (entry * (strength / step)) @ entry.T
            covariance[6:, 6:] += within * step**3 * identity
        return InertialDelta(
            delta_R=R[-1],
            delta_v=velocity[-1],
            delta_p=position[-1],
            path=InertialPath(stamps_ns=imu.stamps_ns, delta_R=R, delta_v=velocity, delta_p=position),
            duration_s=float(elapsed[-1]),
            covariance=0.5 * (covariance + covariance.T),
            bias=bias,
            bias_jacobian=jacobian,
            reintegrate=partial(self.integrate, imu),
            max_bias_change=self._max_bias_change,
        )


def _quadrature(values: Array, steps: Array) -> Array:
    """Integral (N − 1, 3) over each step of samples (N, 3): a parabola through three, or the trapezoid."""
    integral = 0.5 * (values[:-1] + values[1:]) * steps[:, None]
    if len(steps) < 2:
        return integral
    slopes = np.diff(values, axis=0) / steps[:, None]
    before, step = steps[:-1], steps[1:]
    even = (before < _EVEN * step) & (step < _EVEN * before)
    curvature = np.diff(slopes, axis=0) / (before + step)[:, None]
    # ∫ (t − t₀)(t − t₁) dt over the step is −s³/6. The first step borrows the parabola of the second.
    integral[1:] -= np.where(even, step**3 / 6, 0.0)[:, None] * curvature
    if even[0]:
        integral[0] -= steps[0] ** 3 / 6 * curvature[0]
    return integral
