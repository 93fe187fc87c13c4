"""Preintegration on the rotation manifold, all samples at once.

Forster, Carlone, Dellaert, Scaramuzza, "On-Manifold Preintegration for Real-Time Visual-Inertial
Odometry", IEEE T-RO 33(1), 2017: eqs. 33 to 38 (increments), 44 (bias), appendices A and B (noise,
Jacobians). Their recursions are sums once the rotations R_k from the first sample to the k-th are
known, and those come from a scan. With steps s_k, f_k = R_k (a_k − b_a) and the increment of each step

    φ_k = ω̄_k s_k,   M_k = R_{k+1} J_r(φ_k) s_k,   S_k = Σ_{i<k} M_i

an increment is a weighted sum over the samples, Δv = Σ w_k f_k and Δp = Σ u_k f_k, and

    ∂θ/∂b_g = −R_Nᵀ S_N,   ∂Δv/∂b_g = Σ w_k hat(f_k) S_k,   ∂Δv/∂b_a = −Σ w_k R_k   (Δp with u_k)

while noise n_i in the rate of step i gives, in the first body frame,

    δθ = M_i n_i,   δv = −hat(Σ_{k>i} w_k f_k) M_i n_i,   δp = −hat(Σ_{k>i} u_k f_k) M_i n_i.

Noise is white over each step (variance density²/s_k), so the covariances of adjoining windows add up to
that of the whole, wherever the windows are cut and although they share an interpolated sample.
"""

from functools import partial
from typing import Literal

import numpy as np

from vioframe.checks import Array
from vioframe.conventions import NANOSECONDS
from vioframe.errors import ConfigError, StateError
from vioframe.geometry import so3
from vioframe.interfaces import InertialIntegrator
from vioframe.types import ImuBias, ImuBlock, ImuNoise, InertialDelta, InertialPath, SensorRig
from vioframe_preintegration.rotations import cumulative_products, exp_and_right_jacobian

Method = Literal["midpoint", "euler"]


class Preintegration(InertialIntegrator):
    """Forster et al.'s increments with bias Jacobians and covariance, vectorised.

    Args:
        method: ``midpoint`` takes the mean of the samples at both ends of a step (error of second order in
            the step), ``euler`` the sample at its start (first order; what Forster et al. and gtsam print).
        max_gyro_bias_change: change of the gyro bias, rad/s, beyond which ``InertialDelta.at`` integrates
            again instead of using the Jacobian.
        max_accel_bias_change: the same of the accelerometer bias, m/s².

    Raises:
        ConfigError: an unknown method or a negative limit.
    """

    def __init__(
        self,
        *,
        method: Method = "midpoint",
        max_gyro_bias_change: float = 0.01,
        max_accel_bias_change: float = 0.1,
    ) -> None:
        if method not in ("midpoint", "euler"):
            raise ConfigError(f"integrator.method must be midpoint or euler, got {method!r}")
        for name, value in (
            ("max_gyro_bias_change", max_gyro_bias_change),
            ("max_accel_bias_change", max_accel_bias_change),
        ):
            if not value >= 0.0:
                raise ConfigError(f"integrator.{name} must not be negative, got {value}")
        self._midpoint = method == "midpoint"
        self._max_bias_change = (max_gyro_bias_change, max_accel_bias_change)
        self._noise: ImuNoise | None = None

    def setup(self, rig: SensorRig) -> None:
        """Take the noise densities of the next sequence."""
        self._noise = rig.imu

    def integrate(self, imu: ImuBlock, bias: ImuBias) -> InertialDelta:
        """Integrate from the first to the last sample; one sample alone is no motion."""
        if self._noise is None:
            raise StateError("Preintegration.integrate was called before setup(rig): set the integrator up first")
        elapsed = (imu.stamps_ns - imu.stamps_ns[0]) / NANOSECONDS
        steps = elapsed[1:] - elapsed[:-1]
        duration = float(elapsed[-1])
        gyro = imu.gyro - bias.gyro
        accel = imu.accel - bias.accel

        rates = 0.5 * (gyro[:-1] + gyro[1:]) if self._midpoint else gyro[:-1]
        turns, right_jacobians = exp_and_right_jacobian(rates * steps[:, None])
        R = cumulative_products(turns)
        forces = (R @ accel[:, :, None])[:, :, 0]

        # Path: trapezoidal, or with the acceleration at the start of each step.
        mean_forces = 0.5 * (forces[:-1] + forces[1:]) if self._midpoint else forces[:-1]
        velocity = np.zeros_like(forces)
        position = np.zeros_like(forces)
        gains = mean_forces * steps[:, None]
        np.cumsum(gains, axis=0, out=velocity[1:])
        np.cumsum((velocity[:-1] + 0.5 * gains) * steps[:, None], axis=0, out=position[1:])

        weights = self._weights(elapsed, steps)
        spread = R[1:] @ right_jacobians * steps[:, None, None]
        jacobian = self._bias_jacobian(R, forces, spread, weights)
        covariance = self._covariance(R[-1], forces, spread, steps, duration, weights)
        return InertialDelta(
            delta_R=R[-1],
            delta_v=velocity[-1],
            delta_p=position[-1],
            path=InertialPath(stamps_ns=imu.stamps_ns, delta_R=R, delta_v=velocity, delta_p=position),
            duration_s=duration,
            covariance=covariance,
            bias=bias,
            bias_jacobian=jacobian,
            reintegrate=partial(self.integrate, imu),
            max_bias_change=self._max_bias_change,
        )

    def _weights(self, elapsed: Array, steps: Array) -> Array:
        """(2, N): how much the acceleration at each sample counts in Δv (s) and in Δp (s²)."""
        per_step = np.stack([steps, steps * (elapsed[-1] - elapsed[1:] + 0.5 * steps)])
        weights = np.zeros((2, len(elapsed)))
        if self._midpoint:
            weights[:, :-1] = 0.5 * per_step
            weights[:, 1:] += 0.5 * per_step
        else:
            weights[:, :-1] = per_step
        return weights

    @staticmethod
    def _bias_jacobian(R: Array, forces: Array, spread: Array, weights: Array) -> Array:
        """(9, 6), order (R, v, p) by (gyro, accel)."""
        count = len(forces)
        turned = np.zeros((count, 3, 3))
        np.cumsum(spread, axis=0, out=turned[1:])
        jacobian = np.zeros((9, 6))
        jacobian[:3, :3] = -R[-1].T @ turned[-1]
        by_gyro = weights @ (so3.hat(forces) @ turned).reshape(count, 9)
        by_accel = weights @ R.reshape(count, 9)
        jacobian[3:, :3] = by_gyro.reshape(6, 3)
        jacobian[3:, 3:] = -by_accel.reshape(6, 3)
        return jacobian

    def _covariance(
        self, R_last: Array, forces: Array, spread: Array, steps: Array, duration: float, weights: Array
    ) -> Array:
        """(9, 9), order (R, v, p)."""
        noise = self._noise
        covariance = np.zeros((9, 9))
        if noise is None or not len(steps):
            return covariance
        # Rows of Σ_{k>i} w_k f_k and Σ_{k>i} u_k f_k, summed from the end.
        weighted = weights[:, 1:, None] * forces[None, 1:]
        later = np.cumsum(weighted[:, ::-1], axis=1)[:, ::-1]
        levers = np.empty((len(steps), 9, 3))
        levers[:, :3] = R_last.T
        levers[:, 3:6] = -so3.hat(later[0])
        levers[:, 6:] = -so3.hat(later[1])
        # Written row by row, so that the sum over samples is one product of two flat matrices.
        gains = np.empty((9, len(steps), 3))
        scaled = spread * (noise.gyro_noise / np.sqrt(steps))[:, None, None]
        np.matmul(levers, scaled, out=gains.transpose(1, 0, 2))
        flat = gains.reshape(9, -1)
        covariance += flat @ flat.T
        # Accelerometer noise only turns with R, so its part is isotropic: ∫ dt, ∫ (T − t) dt, ∫ (T − t)² dt.
        strength = noise.accel_noise**2
        diagonal = np.arange(3, 6)
        covariance[diagonal, diagonal] += strength * duration
        covariance[diagonal, diagonal + 3] += strength * duration**2 / 2
        covariance[diagonal + 3, diagonal] += strength * duration**2 / 2
        covariance[diagonal + 3, diagonal + 3] += strength * duration**3 / 3
        return covariance
