"""The options of loosely coupled filters in small groups, which the plugins' YAML files nest.

Each group knows what its numbers mean: it checks them, and makes of them what the filter works with.
"""

from dataclasses import dataclass, replace

import numpy as np

from vioframe.checks import Array, check_not_negative, check_positive
from vioframe.consistency import NoiseAdaptation, StandstillTest, chi_square_limit
from vioframe.errors import ConfigError
from vioframe.initialisation import RestInitialiser, StillnessDetector, initial_covariance
from vioframe.types import InertialDelta, NavState, RelativePose, SensorRig


def _check_gate(group: str, probability: float) -> None:
    if not 0.0 < probability <= 1.0:
        raise ConfigError(f"fuser.{group}.gate_probability must be in (0, 1], got {probability}; 1 means no gate")


def _gate(probability: float, degrees: int) -> float:
    return chi_square_limit(probability, degrees) if probability < 1.0 else float("inf")


@dataclass(frozen=True, slots=True, kw_only=True)
class InertialOptions:
    """How far the inertial increments are believed.

    Attributes:
        gyro_noise_scale: factor on the gyro's white noise density of the rig.
        accel_noise_scale: factor on the accelerometer's.
        walk_scale: factor on the bias walk densities of the rig.
        adapt_most: up to this factor noise is raised while the sensors contradict each other; 1 for never.
        adapt_s: seconds in which it is.
        gap_allowed_s: a longer hole between samples widens the covariance.
        gap_rate_sigma: rad/s, unknown rate inside such a hole.
        gap_accel_sigma: m/s², unknown acceleration inside such a hole.
    """

    gyro_noise_scale: float = 1.0
    accel_noise_scale: float = 1.0
    walk_scale: float = 1.0
    adapt_most: float = 30.0
    adapt_s: float = 0.5
    gap_allowed_s: float = 0.05
    gap_rate_sigma: float = 0.5
    gap_accel_sigma: float = 2.0

    def __post_init__(self) -> None:
        check_positive(
            "fuser.inertial",
            gyro_noise_scale=self.gyro_noise_scale,
            accel_noise_scale=self.accel_noise_scale,
            adapt_s=self.adapt_s,
            gap_allowed_s=self.gap_allowed_s,
        )
        if not self.adapt_most >= 1.0:
            raise ConfigError(f"fuser.inertial.adapt_most must be at least 1, got {self.adapt_most}; 1 adapts nothing")
        check_not_negative(
            "fuser.inertial",
            walk_scale=self.walk_scale,
            gap_rate_sigma=self.gap_rate_sigma,
            gap_accel_sigma=self.gap_accel_sigma,
        )

    def scaled(self, delta: InertialDelta, adapted: NoiseAdaptation) -> InertialDelta:
        """The increment with the scaled covariance; that of v and p is the accelerometer's, near enough."""
        gyro, accel = self.gyro_noise_scale * adapted.inertial, self.accel_noise_scale * adapted.inertial
        if gyro == 1.0 and accel == 1.0:
            return delta
        factor = np.repeat([gyro, accel, accel], 3)
        # Integrating again would give the unscaled covariance back.
        return replace(delta, covariance=factor[:, None] * delta.covariance * factor, reintegrate=None)


@dataclass(frozen=True, slots=True, kw_only=True)
class VisualOptions:
    """How far the relative poses are believed.

    Attributes:
        covariance_scale: factor on the covariance that the VO states, or that stands in for it.
        rotation_sigma: rad an axis, where the VO states no covariance.
        translation_sigma: in the unit of the VO, an axis, where it states none.
        translation_ratio: part of the distance moved, an axis, added to that in variance.
        gate_probability: a relative pose is used if its χ² is one that a true one stays below with this
            probability; 1 uses all.
        lost_after_s: seconds without a used one, moving, after which the status is ``lost``.
        recover_after_s: seconds of refusing or hardly believing all of them after which the filter doubts itself.
        recover_tilt_sigma: rad, what is then added to roll and pitch.
        recover_velocity_sigma: m/s, what is then added to the velocity.
    """

    covariance_scale: float = 1.0
    rotation_sigma: float = 0.002
    translation_sigma: float = 0.005
    translation_ratio: float = 0.02
    gate_probability: float = 0.9999
    lost_after_s: float = 1.0
    recover_after_s: float = 1.0
    recover_tilt_sigma: float = 0.02
    recover_velocity_sigma: float = 1.0

    def __post_init__(self) -> None:
        check_positive(
            "fuser.visual",
            covariance_scale=self.covariance_scale,
            rotation_sigma=self.rotation_sigma,
            lost_after_s=self.lost_after_s,
            recover_after_s=self.recover_after_s,
        )
        check_not_negative(
            "fuser.visual",
            translation_sigma=self.translation_sigma,
            translation_ratio=self.translation_ratio,
            recover_tilt_sigma=self.recover_tilt_sigma,
            recover_velocity_sigma=self.recover_velocity_sigma,
        )
        if self.translation_sigma == 0.0 and self.translation_ratio == 0.0:
            raise ConfigError(
                "fuser.visual.translation_sigma and translation_ratio are both 0: "
                "a motion without error cannot be fused"
            )
        _check_gate("visual", self.gate_probability)

    def gate(self, degrees: int) -> float:
        """Largest χ² of a residual with this many degrees of freedom that is used."""
        return _gate(self.gate_probability, degrees)

    def covariance_of(self, pose: RelativePose) -> Array:
        """Covariance (6, 6) to use, in the unit of the VO."""
        if pose.covariance is not None:
            return self.covariance_scale * pose.covariance
        distance = float(np.linalg.norm(pose.T_prev_cur[:3, 3]))
        spread = self.translation_sigma**2 + (self.translation_ratio * distance) ** 2
        return self.covariance_scale * np.diag(np.repeat([self.rotation_sigma**2, spread], 3))


@dataclass(frozen=True, slots=True, kw_only=True)
class StandstillOptions:
    """When and how sharply the motion is measured as none.

    Attributes:
        enabled: do so at all.
        duration_s: how long the samples must have been still.
        gyro: rad/s, scatter and mean of the rate that count as none.
        accel: m/s², scatter of the specific force that counts as none.
        speed: m/s, estimated speed that counts as none.
        rotation_sigma: rad, over a window.
        position_sigma: m, over a window.
        velocity_sigma: m/s.
        gate_probability: a rest that is one is measured with this probability. Low, since the samples tell the
            onset of motion late, and a rest that is missed costs nothing.
    """

    enabled: bool = True
    duration_s: float = 0.5
    gyro: float = 0.02
    accel: float = 0.15
    speed: float = 0.1
    rotation_sigma: float = 3e-4
    position_sigma: float = 2e-4
    velocity_sigma: float = 5e-3
    gate_probability: float = 0.9

    def __post_init__(self) -> None:
        check_positive(
            "fuser.standstill",
            rotation_sigma=self.rotation_sigma,
            position_sigma=self.position_sigma,
            velocity_sigma=self.velocity_sigma,
        )
        check_not_negative("fuser.standstill", speed=self.speed)
        _check_gate("standstill", self.gate_probability)

    def gate(self) -> float:
        """Largest χ² of a standstill measurement that is used."""
        return _gate(self.gate_probability, 9)

    def test(self, rig: SensorRig) -> StandstillTest:
        """The test with these limits for a sequence."""
        detector = StillnessDetector(
            rig, duration_s=self.duration_s, gyro_threshold=self.gyro, accel_threshold=self.accel
        )
        return StandstillTest(detector, gyro_limit=self.gyro, speed_limit=self.speed)


@dataclass(frozen=True, slots=True, kw_only=True)
class StartOptions:
    """What is assumed of the first state.

    Attributes:
        rest_duration_s: length of the standstill that the filter starts from by itself.
        rest_gyro: rad/s, scatter of the rate that counts as rest.
        rest_accel: m/s², scatter of the specific force that counts as rest.
        rest_flow_deg: degrees, median angle by which image points may move during it.
        rest_accel_bias_sigma: m/s² an axis, of the accelerometer bias at that standstill.
        tilt_sigma: rad, of a given state that states no covariance; so the rest.
        yaw_sigma: rad.
        position_sigma: m an axis.
        velocity_sigma: m/s an axis.
        gyro_bias_sigma: rad/s an axis.
        accel_bias_sigma: m/s² an axis.
    """

    rest_duration_s: float = 0.75
    rest_gyro: float = 0.02
    rest_accel: float = 0.15
    rest_flow_deg: float = 0.25
    rest_accel_bias_sigma: float = 0.1
    tilt_sigma: float = 2e-3
    yaw_sigma: float = 1e-3
    position_sigma: float = 1e-3
    velocity_sigma: float = 0.05
    gyro_bias_sigma: float = 0.01
    accel_bias_sigma: float = 0.1

    def __post_init__(self) -> None:
        check_positive(
            "fuser.start",
            tilt_sigma=self.tilt_sigma,
            yaw_sigma=self.yaw_sigma,
            position_sigma=self.position_sigma,
            velocity_sigma=self.velocity_sigma,
            gyro_bias_sigma=self.gyro_bias_sigma,
            accel_bias_sigma=self.accel_bias_sigma,
        )

    def at_rest(self, rig: SensorRig, *, complain: bool = True) -> RestInitialiser:
        """What waits for a standstill in a sequence; it says in the log that none comes if it is to ``complain``."""
        return RestInitialiser(
            rig,
            duration_s=self.rest_duration_s,
            gyro_threshold=self.rest_gyro,
            accel_threshold=self.rest_accel,
            accel_bias_sigma=self.rest_accel_bias_sigma,
            max_flow_deg=self.rest_flow_deg,
            complain=complain,
        )

    def covariance_of(self, state: NavState) -> Array:
        """Covariance (15, 15) of a given state: its own, or the stated sigmas."""
        if state.covariance is not None:
            return state.covariance
        return initial_covariance(
            state.T_world_body[:3, :3],
            tilt_sigma=self.tilt_sigma,
            yaw_sigma=self.yaw_sigma,
            position_sigma=self.position_sigma,
            velocity_sigma=self.velocity_sigma,
            gyro_bias_sigma=self.gyro_bias_sigma,
            accel_bias_sigma=self.accel_bias_sigma,
        )
