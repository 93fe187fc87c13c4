"""Where a fuser begins: standing still, or from a state that is given.

At rest the gyro reads its bias and the accelerometer gravity plus its bias, so a standstill gives roll,
pitch and the gyro bias; heading and position are free and set to zero. With u the upward direction in the
body, f the mean specific force and b_a, n its bias and noise, ``f = g u + b_a + n``. Levelling on f turns
the horizontal part of ``b_a + n`` into tilt,

    θ = hat(u) (b_a + n) / g,                                  (θ local, R_true = R Exp(θ))

while its vertical part is seen: ``uᵀ f − g = uᵀ (b_a + n)``. :func:`rest_state` is the linear-Gaussian
answer to these two, so the tilt and the accelerometer bias it returns are correlated as they must be.
"""

import logging
from dataclasses import dataclass

import numpy as np

from vioframe.checks import Array, Stamps
from vioframe.conventions import NANOSECONDS, seconds
from vioframe.errors import ConfigError
from vioframe.geometry import se3, so3
from vioframe.image_motion import ImageMotion
from vioframe.inertial import level, white_sigma
from vioframe.types import ImuBias, ImuBlock, ImuNoise, NavState, SensorRig, SyncedWindow, VisualFeatures

log = logging.getLogger(__name__)

# Motors that idle shake the raw samples by 1 m/s² (EuRoC V1_01, first 5 s), but not their means over 0.1 s.
BLOCK_S = 0.1
"""Length of the stretches whose means :func:`measure_stillness` compares, s."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Stillness:
    """How still the body was over a stretch of samples.

    Attributes:
        duration_s: length of the stretch.
        gyro_mean: (3,) rad/s and accel_mean: (3,) m/s², over the whole stretch, body.
        gyro_scatter: (3,) rad/s and accel_scatter: (3,) m/s², standard deviation of the means over ``BLOCK_S``.
        blocks: how many such means there were.
    """

    duration_s: float
    gyro_mean: Array
    accel_mean: Array
    gyro_scatter: Array
    accel_scatter: Array
    blocks: int


def measure_stillness(imu: ImuBlock) -> Stillness:
    """Compare the means of successive stretches of ``BLOCK_S``, by trapezoidal integration of the samples.

    Args:
        imu: at least two samples; spacing may vary.
    """
    elapsed = (imu.stamps_ns - imu.stamps_ns[0]) / NANOSECONDS
    values = np.concatenate([imu.gyro, imu.accel], axis=1)
    integral = np.zeros_like(values)
    np.cumsum(0.5 * (values[1:] + values[:-1]) * np.diff(elapsed)[:, None], axis=0, out=integral[1:])
    duration = float(elapsed[-1])
    blocks = max(round(duration / BLOCK_S), 1)
    borders = np.linspace(0.0, duration, blocks + 1)
    at_borders = np.stack([np.interp(borders, elapsed, integral[:, axis]) for axis in range(6)], axis=1)
    means = np.diff(at_borders, axis=0) * (blocks / duration)
    mean = integral[-1] / duration
    scatter = means.std(axis=0, ddof=1) if blocks > 1 else np.full(6, np.inf)
    return Stillness(
        duration_s=duration,
        gyro_mean=mean[:3],
        accel_mean=mean[3:],
        gyro_scatter=scatter[:3],
        accel_scatter=scatter[3:],
        blocks=blocks,
    )


class StillnessDetector:
    """Says whether the body has stood still for the last ``duration_s``.

    A body that moves at constant velocity without turning reads the same as one at rest: a car on a smooth
    straight road can pass for a standstill. No threshold on inertial samples tells the two apart; images do
    (:class:`RestInitialiser`).

    Args:
        rig: gravity and noise densities of the sequence.
        duration_s: length of the standstill, s.
        gyro_threshold: largest scatter of 0.1 s means of the gyro, length over the axes, rad/s; what the
            sensor's white noise adds is allowed on top, in quadrature. On the EuRoC recordings motors that idle
            scatter by up to 0.008, flight by 0.05 and more.
        accel_threshold: the same of the accelerometer, m/s² (idle motors 0.11, flight 0.2 and more).
        max_gyro_bias: a steadier turn than this, rad/s, is motion and not bias.
        max_gravity_error: largest difference of the mean specific force from gravity, m/s².
    """

    def __init__(
        self,
        rig: SensorRig,
        *,
        duration_s: float = 0.75,
        gyro_threshold: float = 0.02,
        accel_threshold: float = 0.15,
        max_gyro_bias: float = 0.15,
        max_gravity_error: float = 0.5,
    ) -> None:
        for name, value in (
            ("gyro_threshold", gyro_threshold),
            ("accel_threshold", accel_threshold),
            ("max_gyro_bias", max_gyro_bias),
            ("max_gravity_error", max_gravity_error),
        ):
            if not value > 0.0:
                raise ConfigError(f"{name} of the standstill detection must be positive, got {value}")
        if not duration_s >= 2 * BLOCK_S:
            raise ConfigError(
                f"duration_s of the standstill detection must be at least {2 * BLOCK_S} s, got {duration_s}"
            )
        self._gravity = rig.gravity
        self._duration_ns = round(duration_s * NANOSECONDS)
        # White noise alone scatters by √3 σ over the three axes; twice that is five sigma of ten blocks' scatter.
        white = 2.0 * np.sqrt(3.0)
        self._max_gyro = float(np.hypot(gyro_threshold, white * white_sigma(rig.imu.gyro_noise, BLOCK_S)))
        self._max_accel = float(np.hypot(accel_threshold, white * white_sigma(rig.imu.accel_noise, BLOCK_S)))
        self._max_gyro_bias = max_gyro_bias
        self._max_gravity_error = max_gravity_error
        self._stamps_ns: Stamps = np.zeros(0, dtype=np.int64)
        self._values: Array = np.zeros((0, 6))

    def push(self, window: SyncedWindow) -> Stillness | None:
        """Take the next window; measure the last ``duration_s``, or None while fewer seconds have been seen."""
        imu = window.imu
        if not len(imu):
            self._stamps_ns, self._values = self._stamps_ns[:0], self._values[:0]
            return None
        values = np.concatenate([imu.gyro, imu.accel], axis=1)
        follows = len(self._stamps_ns) > 0 and self._stamps_ns[-1] == imu.stamps_ns[0]
        # What happened inside a hole is unknown, so a standstill cannot reach across it.
        if not follows or window.gap_ns > BLOCK_S * NANOSECONDS:
            self._stamps_ns, self._values = imu.stamps_ns[:0], values[:0]
        if window.gap_ns > BLOCK_S * NANOSECONDS:
            return None
        # The last sample of a window is the first of the next.
        first = 1 if len(self._stamps_ns) else 0
        stamps_ns = np.concatenate([self._stamps_ns, imu.stamps_ns[first:]])
        values = np.concatenate([self._values, values[first:]])
        keep = max(int(np.searchsorted(stamps_ns, stamps_ns[-1] - self._duration_ns, side="right")) - 1, 0)
        self._stamps_ns, self._values = stamps_ns[keep:], values[keep:]
        if self._stamps_ns[-1] - self._stamps_ns[0] < self._duration_ns:
            return None
        return measure_stillness(
            ImuBlock(stamps_ns=self._stamps_ns, gyro=self._values[:, :3], accel=self._values[:, 3:])
        )

    def motion(self, stillness: Stillness) -> str | None:
        """What speaks against a standstill, with the number and the limit; None if nothing does."""
        checks = (
            ("means of the gyro scatter by", np.linalg.norm(stillness.gyro_scatter), self._max_gyro, "rad/s"),
            ("means of the accelerometer scatter by", np.linalg.norm(stillness.accel_scatter), self._max_accel, "m/s²"),
            ("the gyro turns steadily at", np.linalg.norm(stillness.gyro_mean), self._max_gyro_bias, "rad/s"),
            (
                f"the specific force differs from gravity ({self._gravity:.3f} m/s²) by",
                abs(np.linalg.norm(stillness.accel_mean) - self._gravity),
                self._max_gravity_error,
                "m/s²",
            ),
        )
        for what, value, limit, unit in checks:
            if not value <= limit:
                return f"{what} {value:.3g} {unit}, more than {limit:.3g}"
        return None


class RestInitialiser:
    """Waits for a standstill, then gives the state it implies.

    Where points are tracked through the images, they must have stood still as long as the inertial samples.

    Args:
        rig: gravity and noise densities of the sequence.
        duration_s: how long the body must stand still, s.
        gyro_threshold: see :class:`StillnessDetector`, rad/s.
        accel_threshold: see :class:`StillnessDetector`, m/s².
        accel_bias_sigma: standard deviation of the accelerometer bias before anything is known, m/s² an axis.
        gravity_sigma: how far the rig's gravity may be from the place's, m/s².
        max_flow_deg: largest median angle by which image points move during the standstill, degrees. Idling
            motors shake EuRoC's V1_01 by 0.1; a car's images move by 0.5 and more from one frame to the next.
        patience_s: seconds without a standstill after which the log says, once, what is missing.
        complain: whether the log says it at all.
    """

    def __init__(
        self,
        rig: SensorRig,
        *,
        duration_s: float = 0.75,
        gyro_threshold: float = 0.02,
        accel_threshold: float = 0.15,
        accel_bias_sigma: float = 0.1,
        gravity_sigma: float = 0.01,
        max_flow_deg: float = 0.25,
        patience_s: float = 3.0,
        complain: bool = True,
    ) -> None:
        for name, value in (("accel_bias_sigma", accel_bias_sigma), ("gravity_sigma", gravity_sigma)):
            if not value >= 0.0:
                raise ConfigError(f"{name} of the initialisation must not be negative, got {value}")
        if not max_flow_deg > 0.0:
            raise ConfigError(f"max_flow_deg of the initialisation must be positive, got {max_flow_deg}")
        self._detector = StillnessDetector(
            rig, duration_s=duration_s, gyro_threshold=gyro_threshold, accel_threshold=accel_threshold
        )
        self._rig = rig
        self._duration_s = duration_s
        self._accel_bias_sigma = accel_bias_sigma
        self._gravity_sigma = gravity_sigma
        self._max_flow_deg = max_flow_deg
        self._images = ImageMotion(duration_s)
        self._patience_s = patience_s
        self._first_ns: int | None = None
        self._complained = self._contradicted = not complain

    def push(self, window: SyncedWindow, features: VisualFeatures | None = None) -> NavState | None:
        """Take the next window; return the state at ``window.current``, or None as long as the body moves.

        Args:
            window: the inertial samples.
            features: of ``window.current``, if there are any.
        """
        moved = self._images.push(features)
        if self._first_ns is None:
            self._first_ns = window.previous.stamp_ns
        stillness = self._detector.push(window)
        motion = "too few inertial samples in a row" if stillness is None else self._detector.motion(stillness)
        if stillness is None or motion is not None:
            waited = seconds(window.current.stamp_ns - self._first_ns)
            if waited >= self._duration_s + self._patience_s and not self._complained:
                self._complained = True
                log.warning(
                    "not at rest for %.3g s in the first %.1f s: %s; waiting for a standstill "
                    "(start the recording at rest, or use init=groundtruth)",
                    self._duration_s,
                    waited,
                    motion,
                )
            return None
        if moved is not None and moved[0] > self._max_flow_deg:
            if not self._contradicted:
                # What else speaks against rest later is less to the point.
                self._contradicted = self._complained = True
                log.warning(
                    "the inertial sensor reads rest, but the images move by %.2g° in %.2g s (more than %.3g°): "
                    "the body moves steadily; use init=groundtruth",
                    *moved,
                    self._max_flow_deg,
                )
            return None
        return rest_state(
            window.current.stamp_ns,
            stillness,
            self._rig.imu,
            self._rig.gravity,
            accel_bias_sigma=self._accel_bias_sigma,
            gravity_sigma=self._gravity_sigma,
        )


def rest_state(
    stamp_ns: int,
    stillness: Stillness,
    noise: ImuNoise,
    gravity: float,
    *,
    accel_bias_sigma: float = 0.1,
    gravity_sigma: float = 0.01,
    position_sigma: float = 1e-4,
    velocity_sigma: float = 0.01,
    yaw_sigma: float = 1e-4,
) -> NavState:
    """The state of a body at rest, by the equations at the top of this module.

    Args:
        stamp_ns: of the state.
        stillness: means at rest.
        noise: densities of the sensor.
        gravity: m/s².
        accel_bias_sigma: of the accelerometer bias beforehand, m/s² an axis.
        gravity_sigma: of ``gravity``, m/s²; it hides the vertical bias below it.
        position_sigma: m; position and heading are a choice of the world frame, so these are small
            but not zero, which keeps the covariance invertible.
        velocity_sigma: m/s.
        yaw_sigma: rad.
    """
    R_world_body = level(stillness.accel_mean)
    up = R_world_body[2]
    excess = float(np.linalg.norm(stillness.accel_mean)) - gravity
    accel_noise = np.diag(_mean_variance(noise.accel_noise, stillness.accel_scatter, stillness))

    # Condition the prior of the bias on its visible, vertical part; gravity's error looks like such a bias.
    prior = accel_bias_sigma**2 * np.eye(3)
    innovation = float(up @ (prior + accel_noise) @ up) + gravity_sigma**2
    gain = prior @ up / innovation if innovation > 0.0 else np.zeros(3)
    accel_bias = gain * excess
    bias_covariance = prior - np.outer(gain, up @ prior)

    # The horizontal parts of bias and noise are independent of the vertical ones, which hat(u) removes.
    to_tilt = so3.hat(up) / gravity
    covariance = np.zeros((15, 15))
    covariance[:3, :3] = to_tilt @ (bias_covariance + accel_noise) @ to_tilt.T + yaw_sigma**2 * np.outer(up, up)
    covariance[:3, 12:] = to_tilt @ bias_covariance
    covariance[12:, :3] = covariance[:3, 12:].T
    covariance[3:6, 3:6] = position_sigma**2 * np.eye(3)
    covariance[6:9, 6:9] = velocity_sigma**2 * np.eye(3)
    covariance[9:12, 9:12] = np.diag(_mean_variance(noise.gyro_noise, stillness.gyro_scatter, stillness))
    covariance[12:, 12:] = bias_covariance
    return NavState(
        stamp_ns=stamp_ns,
        T_world_body=se3.from_parts(R_world_body, np.zeros(3)),
        bias=ImuBias(gyro=stillness.gyro_mean.copy(), accel=accel_bias),
        covariance=covariance,
    )


def initial_covariance(
    R_world_body: Array,
    *,
    tilt_sigma: float = 1e-3,
    yaw_sigma: float = 1e-3,
    position_sigma: float = 1e-3,
    velocity_sigma: float = 0.02,
    gyro_bias_sigma: float = 0.01,
    accel_bias_sigma: float = 0.1,
) -> Array:
    """Covariance (15, 15) of a state that is given, such as one from the ground truth.

    Args:
        R_world_body: (3, 3), turns "about the vertical" into body axes.
        tilt_sigma: rad, of roll and pitch.
        yaw_sigma: rad.
        position_sigma: m an axis.
        velocity_sigma: m/s an axis.
        gyro_bias_sigma: rad/s an axis; a given state seldom knows the biases, so these are wide.
        accel_bias_sigma: m/s² an axis.
    """
    up = R_world_body[2]
    covariance = np.diag(
        np.repeat([tilt_sigma**2, position_sigma**2, velocity_sigma**2, gyro_bias_sigma**2, accel_bias_sigma**2], 3)
    )
    covariance[:3, :3] += (yaw_sigma**2 - tilt_sigma**2) * np.outer(up, up)
    return covariance


def _mean_variance(density: float, scatter: Array, stillness: Stillness) -> Array:
    """Variance (3,) of a mean at rest: the sensor's white noise, and the vibration that exceeds it."""
    white = density**2 / stillness.duration_s
    # Ten blocks know their variance to about a half, so only twice the white one is called vibration.
    vibration: Array = np.maximum(scatter**2 / stillness.blocks - 2.0 * white, 0.0)
    return white + vibration
