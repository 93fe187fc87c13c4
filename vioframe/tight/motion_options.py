"""What a start in motion needs before it is believed."""

from dataclasses import dataclass, fields, replace

from vioframe.errors import ConfigError
from vioframe.types import ImuNoise


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionStartOptions:
    """Limits and noise of a start in motion.

    Attributes:
        shortest_s: s of motion that are looked at, at least.
        longest_s: s, at most; older measurements are forgotten.
        every_s: s between attempts.
        pixel_sigma: px, noise of a tracked point.
        inertial_noise_scale: factor on the stated noise of the inertial sensor, which a vehicle shakes.
        accel_bias_sigma: m/s² an axis, of the accelerometer bias beforehand.
        min_points: points that are followed through the images.
        min_turn_deg: degrees by which the body turns; without a turn neither the calibration can be checked nor
            the accelerometer bias told from a tilt.
        min_accel: m/s², scatter of the acceleration; without it one camera knows no scale.
        min_parallax_deg: degrees by which the points move apart from the rotation.
        max_scale_sigma: ratio, standard deviation of the scale by the stated noise.
        max_scale_change: ratio, difference of the scale from the one that the attempt before found.
        widen: factor on the standard deviations of the first state, since the estimator goes through the same
            measurements again.
    """

    shortest_s: float = 1.0
    longest_s: float = 3.0
    every_s: float = 0.25
    pixel_sigma: float = 0.5
    inertial_noise_scale: float = 3.0
    accel_bias_sigma: float = 0.2
    min_points: int = 20
    min_turn_deg: float = 2.0
    min_accel: float = 0.1
    min_parallax_deg: float = 1.0
    max_scale_sigma: float = 0.03
    max_scale_change: float = 0.04
    widen: float = 5.0

    def __post_init__(self) -> None:
        for each in fields(self):
            value = getattr(self, each.name)
            if not value > 0:
                raise ConfigError(f"fuser.start.motion.{each.name} must be positive, got {value}")
        if self.longest_s < self.shortest_s:
            raise ConfigError(
                f"fuser.start.motion.longest_s ({self.longest_s}) must not be below shortest_s ({self.shortest_s})"
            )

    def noise(self, stated: ImuNoise) -> ImuNoise:
        """The densities to work with."""
        scale = self.inertial_noise_scale
        return replace(stated, gyro_noise=stated.gyro_noise * scale, accel_noise=stated.accel_noise * scale)
