"""Inertial samples between two keyframes, for gtsam.

gtsam takes each sample to hold, in the body axes at its start, until the next:

    ΔR ← ΔR Exp(ω s),   Δv ← Δv + ΔR a s,   Δp ← Δp + Δv s + ½ ΔR a s²

so what it is given here is, for each step, the mean rate ω̄ and the mean of the two specific forces, the later one
turned back into the axes at the start, ½ (a_k + Exp(ω̄ s) a_{k+1}); the error is then of second order in the step.
"""

import gtsam
import numpy as np

from vioframe.checks import Array
from vioframe.conventions import NANOSECONDS, seconds
from vioframe.geometry import so3
from vioframe.tight.options import InertialTrust
from vioframe.types import ImuBias, ImuNoise, SyncedWindow

# A step this many nominal ones long belongs to a hole.
_HOLE_STEPS = 2.5
# What gtsam adds to position for its own discretisation, m/√Hz; small beside the accelerometer's.
_INTEGRATION_SIGMA = 1e-5


def midpoint_steps(window: SyncedWindow, bias: ImuBias) -> tuple[Array, Array, Array]:
    """Rates (N, 3) and specific forces (N, 3), bias included, and lengths (N,) s of a window's steps.

    Args:
        window: N + 1 samples.
        bias: as estimated; only turns the later of two forces.
    """
    imu = window.imu
    steps = np.diff(imu.stamps_ns) / NANOSECONDS
    rates = 0.5 * (imu.gyro[:-1] + imu.gyro[1:])
    turns = so3.exp((rates - bias.gyro) * steps[:, None])
    later = (turns @ (imu.accel[1:] - bias.accel)[:, :, None])[:, :, 0] + bias.accel
    return rates, 0.5 * (imu.accel[:-1] + later), steps


class SampleIntegrator:
    """Collects the samples since the last keyframe.

    Args:
        noise: densities, of which the bias walks are taken; the white ones come with every window.
        gravity: m/s².
        trust: how far holes between samples are believed.
    """

    def __init__(self, noise: ImuNoise, gravity: float, trust: InertialTrust) -> None:
        self._trust = trust
        self._params = gtsam.PreintegrationCombinedParams.MakeSharedU(gravity)
        self._params.setIntegrationCovariance(_INTEGRATION_SIGMA**2 * np.eye(3))
        self._params.setBiasAccCovariance(max(noise.accel_walk, 1e-9) ** 2 * np.eye(3))
        self._params.setBiasOmegaCovariance(max(noise.gyro_walk, 1e-9) ** 2 * np.eye(3))
        self.begin(ImuBias())

    def begin(self, bias: ImuBias) -> None:
        """Forget the samples; those to come are linearised at ``bias``."""
        self._bias = bias
        self._collected = gtsam.PreintegratedCombinedMeasurements(
            self._params, gtsam.imuBias.ConstantBias(bias.accel, bias.gyro)
        )

    def push(self, window: SyncedWindow, noise: ImuNoise) -> None:
        """Take the samples of one more window, which are believed with these white densities."""
        rates, forces, steps = midpoint_steps(window, self._bias)
        collected = self._collected
        self._set_white_noise(noise.gyro_noise, noise.accel_noise)
        in_hole = np.zeros(len(steps), dtype=bool)
        gap_s = seconds(window.gap_ns)
        if self._trust.has_gap(window.gap_ns):
            in_hole = steps > _HOLE_STEPS / noise.rate_hz
        for rate, force, step, hole in zip(rates, forces, steps.tolist(), in_hole.tolist(), strict=True):
            if hole:
                # An unknown constant over the hole: as white noise, as strong as what it adds up to at its end.
                root = np.sqrt(gap_s)
                self._set_white_noise(self._trust.gap_rate_sigma * root, self._trust.gap_accel_sigma * root)
            collected.integrateMeasurement(force, rate, step)
            if hole:
                self._set_white_noise(noise.gyro_noise, noise.accel_noise)

    def take(self) -> gtsam.PreintegratedCombinedMeasurements:
        """The increment since :meth:`begin`."""
        return self._collected

    def _set_white_noise(self, gyro: float, accel: float) -> None:
        self._params.setGyroscopeCovariance(gyro**2 * np.eye(3))
        self._params.setAccelerometerCovariance(accel**2 * np.eye(3))
