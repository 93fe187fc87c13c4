"""What loosely coupled filters share around their equations: start, inertial step, standstill, status.

A filter of this kind is a :class:`LooseFuser` that says how a relative pose corrects its state; its options
come in the small groups below, which the plugins' YAML files nest.
"""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from vioframe.checks import Array
from vioframe.consistency import NoiseAdaptation, StandstillTest, chi_square_limit
from vioframe.conventions import NANOSECONDS, seconds
from vioframe.error_state import InertialFilter
from vioframe.errors import ConfigError, StateError
from vioframe.increments import add_gap, coasting
from vioframe.initialisation import RestInitialiser, StillnessDetector, initial_covariance
from vioframe.interfaces import Fuser
from vioframe.types import (
    ImuBias,
    ImuNoise,
    InertialDelta,
    Measurement,
    NavState,
    RelativePose,
    SensorRig,
    Status,
    SyncedWindow,
)

# Beyond this factor on its translational noise the odometry is as good as refused.
_HARDLY_BELIEVED = 8.0
# Rounding turns a rotation off the group by about 1e-16 a window.
_NORMALISE_EVERY = 1000


def _check_positive(group: str, **values: float) -> None:
    for name, value in values.items():
        if not value > 0.0:
            raise ConfigError(f"fuser.{group}.{name} must be positive, got {value}")


def _check_not_negative(group: str, **values: float) -> None:
    for name, value in values.items():
        if not value >= 0.0:
            raise ConfigError(f"fuser.{group}.{name} must not be negative, got {value}")


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
        _check_positive(
            "inertial",
            gyro_noise_scale=self.gyro_noise_scale,
            accel_noise_scale=self.accel_noise_scale,
            adapt_s=self.adapt_s,
            gap_allowed_s=self.gap_allowed_s,
        )
        if not self.adapt_most >= 1.0:
            raise ConfigError(f"fuser.inertial.adapt_most must be at least 1, got {self.adapt_most}; 1 adapts nothing")
        _check_not_negative(
            "inertial",
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
        _check_positive(
            "visual",
            covariance_scale=self.covariance_scale,
            rotation_sigma=self.rotation_sigma,
            lost_after_s=self.lost_after_s,
            recover_after_s=self.recover_after_s,
        )
        _check_not_negative(
            "visual",
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
        _check_positive(
            "standstill",
            rotation_sigma=self.rotation_sigma,
            position_sigma=self.position_sigma,
            velocity_sigma=self.velocity_sigma,
        )
        _check_not_negative("standstill", speed=self.speed)
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
        _check_positive(
            "start",
            tilt_sigma=self.tilt_sigma,
            yaw_sigma=self.yaw_sigma,
            position_sigma=self.position_sigma,
            velocity_sigma=self.velocity_sigma,
            gyro_bias_sigma=self.gyro_bias_sigma,
            accel_bias_sigma=self.accel_bias_sigma,
        )

    def at_rest(self, rig: SensorRig) -> RestInitialiser:
        """What waits for a standstill in a sequence."""
        return RestInitialiser(
            rig,
            duration_s=self.rest_duration_s,
            gyro_threshold=self.rest_gyro,
            accel_threshold=self.rest_accel,
            accel_bias_sigma=self.rest_accel_bias_sigma,
            max_flow_deg=self.rest_flow_deg,
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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class VisualMotion:
    """A relative pose that the VO stands by: T_prev_cur (4, 4) of the camera and its covariance (6, 6), VO's unit."""

    T_prev_cur: Array
    covariance: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Step:
    """One window as a loosely coupled filter sees it.

    Attributes:
        delta: inertial increment with the stated trust in it, holes included.
        motion: relative pose, or None.
        at_rest: the body seems to stand still.
        current_ns: stamp at the end.
    """

    delta: InertialDelta
    motion: VisualMotion | None
    at_rest: bool
    current_ns: int


class LooseFuser(Fuser):
    """A filter that propagates with inertial increments and corrects with relative poses.

    Args:
        visual: trust in the relative poses.
        inertial: trust in the inertial increments.
        standstill: measuring no motion at rest.
        start: what is assumed of the first state.
    """

    def __init__(
        self,
        *,
        visual: VisualOptions | None = None,
        inertial: InertialOptions | None = None,
        standstill: StandstillOptions | None = None,
        start: StartOptions | None = None,
    ) -> None:
        self._visual = visual or VisualOptions()
        self._inertial = inertial or InertialOptions()
        self._standstill = standstill or StandstillOptions()
        self._start = start or StartOptions()
        self._standstill_gate = self._standstill.gate()
        self._gap_allowed_ns = round(self._inertial.gap_allowed_s * NANOSECONDS)
        self._ready = False

    def setup(self, rig: SensorRig) -> None:
        """Forget the last sequence and take the next one's calibration.

        Raises:
            ConfigError: the rig has no camera, so the lever arm of the relative poses is unknown.
        """
        if not rig.cameras:
            raise ConfigError(
                f"{type(self).__name__} needs the place of the camera on the body (rig.cameras[0].T_body_cam), "
                "but the recording has no camera: choose fuser=imu_only, or a recording with a camera"
            )
        self._T_body_cam: Array = rig.cameras[0].T_body_cam
        walk = self._inertial.walk_scale
        self._noise: ImuNoise = replace(
            rig.imu, gyro_walk=rig.imu.gyro_walk * walk, accel_walk=rig.imu.accel_walk * walk
        )
        self._gravity = rig.gravity
        self._rest = self._start.at_rest(rig)
        self._standstill_test = self._standstill.test(rig)
        self._given: NavState | None = None
        self._adapted = NoiseAdaptation(self._inertial.adapt_s, self._inertial.adapt_most)
        self._begun = False
        self._stamp_ns = 0
        self._supported_ns = 0
        self._refused_s = 0.0
        self._windows = 0
        self._counts: dict[str, int] = {}
        self._ready = True
        self._filter = self._new_filter()

    def start_from(self, state: NavState) -> None:
        """Start from a given state; without a covariance the sigmas of ``start`` stand in."""
        self._given = state

    def bias(self) -> ImuBias:
        """The estimated bias."""
        return self._filter.body.bias if self._ready else ImuBias()

    def counters(self) -> Mapping[str, int]:
        """Relative poses missing and refused, windows with holes, standstill measurements."""
        return dict(self._counts)

    def update(self, measurement: Measurement) -> list[NavState]:
        """Propagate over the window, then correct; empty until the filter has a first state."""
        if not self._ready:
            raise StateError(f"{type(self).__name__}.update was called before setup(rig): set the fuser up first")
        window = measurement.window
        states = []
        if not self._begun:
            if self._given is None:
                state = self._rest.push(window, measurement.features)
                if state is not None:
                    states.append(self._begin(state, self._start.covariance_of(state), window.current.stamp_ns))
                return states
            covariance = self._start.covariance_of(self._given)
            states.append(self._begin(self._given, covariance, window.previous.stamp_ns))
            self._given = None
        step = self._prepare(measurement)
        self._account(step, self._advance(step))
        self._stamp_ns = step.current_ns
        self._windows += 1
        if self._windows % _NORMALISE_EVERY == 0:
            self._filter.normalise()
        states.append(self._emit())
        return states

    def _begin(self, state: NavState, covariance: Array, stamp_ns: int) -> NavState:
        self._filter.start(state, covariance)
        self._begun = True
        self._stamp_ns = self._supported_ns = stamp_ns
        self._started()
        return self._emit()

    def _prepare(self, measurement: Measurement) -> Step:
        window, pose = measurement.window, measurement.relative_pose
        if window.previous.stamp_ns != self._stamp_ns:
            self._coast_to(window)
        delta = measurement.inertial_delta
        if delta is None:
            raise StateError(f"{type(self).__name__}.update needs an inertial increment: set integrator=preintegration")
        delta = self._inertial.scaled(delta, self._adapted)
        if window.gap_ns > self._gap_allowed_ns:
            self._count("inertial gaps")
            delta = add_gap(
                delta, seconds(window.gap_ns), self._inertial.gap_rate_sigma, self._inertial.gap_accel_sigma
            )
        at_rest = self._standstill.enabled and self._standstill_test.push(window, self._filter.body)
        motion = None
        if pose is None or not pose.valid:
            self._count("missing VO updates")
        else:
            factor = np.repeat([1.0, self._adapted.translation], 3)
            covariance = factor[:, None] * self._visual.covariance_of(pose) * factor
            motion = VisualMotion(T_prev_cur=pose.T_prev_cur, covariance=covariance)
        return Step(delta=delta, motion=motion, at_rest=at_rest, current_ns=window.current.stamp_ns)

    def _coast_to(self, window: SyncedWindow) -> None:
        """Cross a stretch for which no window came."""
        self._count("missing windows")
        duration = seconds(window.previous.stamp_ns - self._stamp_ns)
        options = self._inertial
        delta = coasting(
            self._filter.body, duration, self._filter.gravity, options.gap_rate_sigma, options.gap_accel_sigma
        )
        self._advance(Step(delta=delta, motion=None, at_rest=False, current_ns=window.previous.stamp_ns))

    def _stand_still(self) -> bool:
        """Measure no motion since the clone; False if the measurement does not fit."""
        options = self._standstill
        H, residual, noise = self._filter.standstill_measurement(
            options.rotation_sigma, options.position_sigma, options.velocity_sigma
        )
        if self._filter.innovation(H, residual, noise)[1] > self._standstill_gate:
            self._count("gated standstills")
            return False
        self._correct(H, residual, noise)
        self._count("standstill updates")
        return True

    def _account(self, step: Step, supported: bool) -> None:
        """Keep count of how long measurements have been missing, refused or hardly believed."""
        if supported:
            self._supported_ns = step.current_ns
        if step.motion is not None and (not supported or self._adapted.translation > _HARDLY_BELIEVED):
            self._refused_s += step.delta.duration_s
        elif supported:
            self._refused_s = 0.0
        if self._refused_s > self._visual.recover_after_s:
            # Odometry that disagrees all the time is more likely right than a filter that never looks.
            self._filter.doubt(self._visual.recover_tilt_sigma, self._visual.recover_velocity_sigma)
            self._adapted.believe_translation()
            self._count("recoveries")
            self._refused_s = 0.0

    def _count(self, what: str) -> None:
        self._counts[what] = self._counts.get(what, 0) + 1

    def _status(self) -> Status:
        elapsed = seconds(self._stamp_ns - self._supported_ns)
        return "lost" if elapsed > self._visual.lost_after_s else "tracking"

    def _emit(self) -> NavState:
        return self._filter.nav_state(self._stamp_ns, self._status())

    def _new_filter(self) -> InertialFilter:
        """A filter with the errors that the plugin appends."""
        return InertialFilter(extra=0, noise=self._noise, gravity=self._gravity)

    def _started(self) -> None:
        """The filter has just taken its first state."""

    def _correct(self, H: Array, residual: Array, noise: Array) -> None:
        """Update the filter, and what the plugin appended to it."""
        self._filter.correct(H, residual, noise)

    @abstractmethod
    def _advance(self, step: Step) -> bool:
        """Propagate over a window and correct; True if a measurement supports the new state."""
