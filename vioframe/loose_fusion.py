"""What loosely coupled filters share around their equations: start, inertial step, standstill, status.

A filter of this kind is a :class:`LooseFuser` that says how a relative pose corrects its state; its options are
in :mod:`vioframe.fusion_options`.
"""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from vioframe.checks import Array
from vioframe.consistency import NoiseAdaptation
from vioframe.conventions import NANOSECONDS, seconds
from vioframe.error_state import InertialFilter
from vioframe.errors import ConfigError, StateError
from vioframe.fusion_options import InertialOptions, StandstillOptions, StartOptions, VisualOptions
from vioframe.increments import add_gap, coasting
from vioframe.interfaces import Fuser
from vioframe.types import (
    ImuBias,
    ImuNoise,
    InertialDelta,
    Measurement,
    NavState,
    SensorRig,
    Status,
    SyncedWindow,
)

# Beyond this factor on its translational noise the odometry is as good as refused.
_HARDLY_BELIEVED = 8.0
# Rounding turns a rotation off the group by about 1e-16 a window.
_NORMALISE_EVERY = 1000


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
        self._silent_s = 0.0
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
        supported = self._advance(step)
        self._account(step, supported)
        self._silent_s = 0.0 if supported or len(measurement.window.imu) else self._silent_s + step.delta.duration_s
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
        if not len(window.imu):
            self._count("windows without inertial samples")
            delta = self._coasting(seconds(window.current.stamp_ns - window.previous.stamp_ns))
        elif delta is None:
            raise StateError(f"{type(self).__name__}.update needs an inertial increment: set integrator=preintegration")
        else:
            delta = self._inertial.scaled(delta, self._adapted)
        if len(window.imu) and window.gap_ns > self._gap_allowed_ns:
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
        delta = self._coasting(seconds(window.previous.stamp_ns - self._stamp_ns))
        self._advance(Step(delta=delta, motion=None, at_rest=False, current_ns=window.previous.stamp_ns))
        self._silent_s += delta.duration_s

    def _coasting(self, duration_s: float) -> InertialDelta:
        """The increment of a stretch without samples."""
        options = self._inertial
        return coasting(
            self._filter.body,
            duration_s,
            self._filter.gravity,
            options.gap_rate_sigma,
            options.gap_accel_sigma,
            self._silent_s,
        )

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
