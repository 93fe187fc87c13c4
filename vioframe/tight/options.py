"""The options that tightly coupled estimators share, in small groups, which the plugins' YAML files nest."""

from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from vioframe.checks import check_not_negative, check_positive
from vioframe.conventions import NANOSECONDS, seconds
from vioframe.errors import ConfigError
from vioframe.increments import add_gap
from vioframe.types import ImuNoise, InertialDelta

Extrinsics = Literal["fixed", "refine", "find"]


@dataclass(frozen=True, slots=True, kw_only=True)
class InertialTrust:
    """How far the inertial increments are believed.

    Attributes:
        gyro_noise_scale: factor on the gyro's white noise density of the rig. A data sheet states that of a
            sensor that does not shake.
        accel_noise_scale: factor on the accelerometer's.
        follow_scatter: use these factors only as far as successive samples scatter more than the rig states.
        gyro_walk_scale: factor on the gyro bias walk density.
        accel_walk_scale: factor on the accelerometer bias walk density.
        gap_allowed_s: a longer hole between samples widens the covariance.
        gap_rate_sigma: rad/s, unknown rate inside such a hole.
        gap_accel_sigma: m/s², unknown acceleration inside such a hole.
    """

    gyro_noise_scale: float = 1.0
    accel_noise_scale: float = 1.0
    follow_scatter: bool = True
    gyro_walk_scale: float = 1.0
    accel_walk_scale: float = 1.0
    gap_allowed_s: float = 0.05
    gap_rate_sigma: float = 0.5
    gap_accel_sigma: float = 2.0

    def __post_init__(self) -> None:
        check_positive(
            "fuser.inertial",
            gyro_noise_scale=self.gyro_noise_scale,
            accel_noise_scale=self.accel_noise_scale,
            gap_allowed_s=self.gap_allowed_s,
        )
        check_not_negative(
            "fuser.inertial",
            gyro_walk_scale=self.gyro_walk_scale,
            accel_walk_scale=self.accel_walk_scale,
            gap_rate_sigma=self.gap_rate_sigma,
            gap_accel_sigma=self.gap_accel_sigma,
        )

    def scales(self, scatter: tuple[float, float] | None) -> tuple[float, float]:
        """Factors on the white noise densities of gyro and accelerometer.

        Args:
            scatter: of their samples, over the stated (:class:`~vioframe.tight.scatter.SampleScatter`); None where
                it is not known: the sensor may shake.
        """
        most = self.gyro_noise_scale, self.accel_noise_scale
        if scatter is None or not self.follow_scatter:
            return most
        return min(most[0], max(scatter[0], 1.0)), min(most[1], max(scatter[1], 1.0))

    def noise(self, stated: ImuNoise, scales: tuple[float, float]) -> ImuNoise:
        """The densities to work with, of those of the rig."""
        return replace(
            stated,
            gyro_noise=stated.gyro_noise * scales[0],
            accel_noise=stated.accel_noise * scales[1],
            gyro_walk=stated.gyro_walk * self.gyro_walk_scale,
            accel_walk=stated.accel_walk * self.accel_walk_scale,
        )

    def has_gap(self, gap_ns: int) -> bool:
        """Whether a hole of this length widens the covariance."""
        return gap_ns > round(self.gap_allowed_s * NANOSECONDS)

    def trusted(self, delta: InertialDelta, gap_ns: int, scales: tuple[float, float]) -> InertialDelta:
        """The increment with the scaled covariance, widened for a hole; that of v and p is the accelerometer's."""
        gyro, accel = scales
        factor = np.repeat([gyro, accel, accel], 3)
        delta = replace(delta, covariance=factor[:, None] * delta.covariance * factor)
        if self.has_gap(gap_ns):
            return add_gap(delta, seconds(gap_ns), self.gap_rate_sigma, self.gap_accel_sigma)
        return delta


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationOptions:
    """What of the calibration is estimated while it runs.

    Attributes:
        extrinsics: place of the cameras on the body: ``fixed`` as calibrated, ``refine`` from there, or ``find``
            the rotation of camera 0 from nothing before the start, then refine.
        rotation_sigma: rad an axis, of the calibrated rotation.
        position_sigma: m an axis, of the calibrated position.
        time_offset: estimate the camera's delay.
        time_offset_sigma_s: s, of the delay that the rig states.
    """

    extrinsics: Extrinsics = "refine"
    rotation_sigma: float = 0.02
    position_sigma: float = 0.01
    time_offset: bool = True
    time_offset_sigma_s: float = 0.01

    def __post_init__(self) -> None:
        if self.extrinsics not in get_args(Extrinsics):
            raise ConfigError(
                f"fuser.calibration.extrinsics must be one of {', '.join(get_args(Extrinsics))}, "
                f"got {self.extrinsics!r}"
            )
        check_positive(
            "fuser.calibration",
            rotation_sigma=self.rotation_sigma,
            position_sigma=self.position_sigma,
            time_offset_sigma_s=self.time_offset_sigma_s,
        )

    @property
    def estimates_extrinsics(self) -> bool:
        """Whether the cameras' place on the body is part of the state."""
        return self.extrinsics != "fixed"


@dataclass(frozen=True, slots=True, kw_only=True)
class FailureOptions:
    """When an estimate is not believed any more.

    Attributes:
        min_used: fewer observations used in a window do not support its state.
        lost_after_s: seconds without support, moving, after which the status is ``lost``.
        restart_after_s: seconds without support although points are tracked, after which it starts again.
        max_gyro_bias: rad/s; a larger estimate is a failure.
        max_accel_bias: m/s².
        max_speed: m/s.
        max_correction_m: m by which the images of one window may move the position.
        restart: start again after a failure, keeping the frame of the trajectory; else stay ``lost``.
    """

    min_used: int = 4
    lost_after_s: float = 1.0
    restart_after_s: float = 2.0
    max_gyro_bias: float = 1.0
    max_accel_bias: float = 2.5
    max_speed: float = 60.0
    max_correction_m: float = 5.0
    restart: bool = True

    def __post_init__(self) -> None:
        if self.min_used < 1:
            raise ConfigError(f"fuser.failure.min_used must be at least 1, got {self.min_used}")
        check_positive(
            "fuser.failure",
            lost_after_s=self.lost_after_s,
            restart_after_s=self.restart_after_s,
            max_gyro_bias=self.max_gyro_bias,
            max_accel_bias=self.max_accel_bias,
            max_speed=self.max_speed,
            max_correction_m=self.max_correction_m,
        )
