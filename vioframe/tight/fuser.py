"""The shell of a tightly coupled estimator: everything around its equations."""

import logging
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np

from vioframe.checks import Array
from vioframe.consistency import StandstillTest
from vioframe.conventions import seconds
from vioframe.error_state import Body
from vioframe.errors import ConfigError, ShapeError, StateError
from vioframe.fusion_options import StandstillOptions
from vioframe.geometry import se3, so3
from vioframe.interfaces import INERTIAL_DELTA, STEREO_TRACKS, TRACKS, Fuser
from vioframe.tight.failure import FailureMonitor
from vioframe.tight.options import CalibrationOptions, FailureOptions, InertialTrust
from vioframe.tight.restart import DeadReckoning, coast_across, coast_through
from vioframe.tight.scatter import SampleScatter
from vioframe.tight.start import Starter, TightStartOptions
from vioframe.tight.step import Start, Step, Support
from vioframe.types import (
    ImuBias,
    InitialisationAttempt,
    Measure,
    Measurement,
    NavState,
    SensorRig,
    Status,
    SyncedWindow,
    Tracks,
)

log = logging.getLogger(__name__)


class TightFuser(Fuser):
    """Starts an estimator, moves it on window by window, watches it, and starts it again when it failed.

    A method derives from this and says in :meth:`_begin` how it takes a first state, in :meth:`_advance` how a
    window moves it on, and in :meth:`_estimate` what it believes.

    Args:
        stereo: True needs the points in camera 1 too, False leaves them out, None takes what the front end gives.
        inertial: trust in the inertial increments.
        calibration: what of the calibration is estimated.
        standstill: measuring no motion at rest.
        start: how it begins.
        failure: when it is not believed any more.
    """

    requires: ClassVar[frozenset[str]] = frozenset({INERTIAL_DELTA, TRACKS})

    def __init__(
        self,
        *,
        stereo: bool | None = None,
        inertial: InertialTrust | None = None,
        calibration: CalibrationOptions | None = None,
        standstill: StandstillOptions | None = None,
        start: TightStartOptions | None = None,
        failure: FailureOptions | None = None,
    ) -> None:
        if stereo:
            # What it needs depends on its options, so the instance says it, not the class.
            self.requires = self.requires | {STEREO_TRACKS}  # type: ignore[misc]
        self._uses_stereo = stereo is not False
        self._inertial = inertial or InertialTrust()
        self._calibration = calibration or CalibrationOptions()
        self._standstill = standstill or StandstillOptions()
        self._start_options = start or TightStartOptions()
        self._failure = failure or FailureOptions()
        self._ready = False

    def setup(self, rig: SensorRig) -> None:
        """Forget the last sequence and take the next one's calibration.

        Raises:
            ConfigError: the rig has no camera.
        """
        if not rig.cameras:
            raise ConfigError(
                f"{type(self).__name__} follows image points and needs a calibrated camera, but the recording has "
                "none: choose fuser=imu_only, or a recording with a camera"
            )
        self._rig = rig
        self._noise = self._inertial.noise(rig.imu, self._inertial.scales(None))
        self._scatter = SampleScatter(rig.imu)
        self._counts: dict[str, int] = {}
        self._attempts: list[InitialisationAttempt] = []
        self._stamp_ns: int | None = None
        self._running = False
        self._past: DeadReckoning | None = None
        self._ready = True
        self._new_start()

    def start_from(self, state: NavState) -> None:
        """Start from a given state; without a covariance the sigmas of ``start`` stand in."""
        self._starter.give(state)

    def bias(self) -> ImuBias:
        """The estimated bias; while it starts again, that of the dead reckoning."""
        if not self._ready:
            return ImuBias()
        if self._running:
            return self._newest.bias
        return ImuBias() if self._past is None else self._past.bias

    def T_body_cam(self) -> Array:
        """Place of camera 0 on the body, (4, 4), as estimated now; as calibrated where it is not."""
        return self._rig.cameras[0].T_body_cam

    def calibration(self) -> Mapping[str, Measure]:
        """Delay, rotation and position of camera 0 as estimated now, each as the change from the rig's."""
        if not self._ready or not self._running:
            return {}
        found = {}
        delay_ns = self.camera_delay_ns()
        if delay_ns is not None:
            change_ns = delay_ns - self._rig.camera_delay_ns
            found["camera delay"] = Measure(value=1e3 * seconds(change_ns), unit="ms")
        if self._calibration.estimates_extrinsics:
            change = se3.inverse(self._rig.cameras[0].T_body_cam) @ self.T_body_cam()
            found["camera turned by"] = Measure(value=float(np.degrees(so3.angle(change[:3, :3]))), unit="°")
            found["camera moved by"] = Measure(value=1e3 * float(np.linalg.norm(change[:3, 3])), unit="mm")
        return found

    def counters(self) -> Mapping[str, int]:
        """Restarts, windows with holes, missing windows, standstill measurements, and what the method counts."""
        return dict(self._counts)

    def attempts(self) -> Sequence[InitialisationAttempt]:
        """Every attempt to start since ``setup``, oldest first."""
        return (*self._attempts, *self._starter.attempts)

    def update(self, measurement: Measurement) -> list[NavState]:
        """Move on by one window; empty until there is a first state, dead reckoned while starting again."""
        if not self._ready:
            raise StateError(f"{type(self).__name__}.update was called before setup(rig): set the fuser up first")
        window = measurement.window
        if self._stamp_ns is not None and self._stamp_ns != window.previous.stamp_ns:
            self._cross_hole(window)
        if not len(window.imu) and measurement.inertial_delta is None:
            return self._go_without_samples(measurement)
        self._scatter.push(window)
        states: list[NavState] = []
        if self._running:
            self._move_on(measurement)
        else:
            if self._past is not None:
                self._past.move_on(self._step(measurement, at_rest=False))
            states = self._try_to_start(measurement)
        self._stamp_ns = window.current.stamp_ns
        return [*states, *self._current(self._stamp_ns)]

    def _current(self, stamp_ns: int) -> list[NavState]:
        """The state now, where there is one."""
        if self._running:
            return [replace(self._newest, stamp_ns=stamp_ns, status=self._status())]
        return [] if self._past is None else [self._past.state(stamp_ns)]

    def _go_without_samples(self, measurement: Measurement) -> list[NavState]:
        """Move on by a window whose inertial samples never came: coast, with what the images say."""
        self._count("windows without inertial samples")
        if not self._running:
            self._starter.interrupt()
        if self._running or self._past is not None:
            # What there is a state of has a stamp.
            begin = self._current(measurement.window.previous.stamp_ns)[0]
            coasted = coast_through(begin, measurement, self._rig.gravity, self._inertial)
            if self._past is not None:
                self._past.move_on(self._step(coasted, at_rest=False))
            else:
                self._move_on(coasted)
        self._stamp_ns = measurement.window.current.stamp_ns
        return self._current(self._stamp_ns)

    def _new_start(self) -> None:
        self._starter = Starter(self._rig, self._start_options, self._calibration)
        self._standstill_test: StandstillTest = self._standstill.test(self._rig)
        self._monitor = FailureMonitor(self._failure)

    def _try_to_start(self, measurement: Measurement) -> list[NavState]:
        """Give the window to the starter; where it has a start, begin there and go through what it has seen."""
        if self._past is not None and not self._failure.restart:
            return []
        start = self._starter.push(measurement)
        if start is None:
            return []
        state = start.state
        if self._past is not None:
            state = self._past.brought_into_frame(state)
            self._count("restarts")
        self._begin(replace(start, state=state))
        self._newest = self._estimate()
        self._running = True
        self._past = None
        self._monitor.begin(state)
        before = []
        if state.stamp_ns == measurement.window.previous.stamp_ns and self._stamp_ns is None:
            before = [replace(self._newest, stamp_ns=state.stamp_ns, status="tracking")]
        for past in start.replay:
            if self._running:
                self._move_on(past)
        return before

    def _move_on(self, measurement: Measurement) -> None:
        step = self._prepare(measurement)
        before = self._newest
        try:
            support = self._advance(step)
            self._newest = self._estimate()
            reason = self._monitor.judge(step, before, self._newest, support)
        except (ShapeError, np.linalg.LinAlgError):
            # A NavState refuses what is not finite, and a covariance that is none has no factor.
            reason = self._monitor.note_collapse(step)
        else:
            if support.at_rest:
                self._count("standstill updates")
        if reason is not None:
            self._give_up(reason)

    def _give_up(self, reason: str) -> None:
        """Believe the estimate no more: dead reckon from before it failed, and look for a new start."""
        self._count(f"failures: {reason}")
        log.warning(
            "%s: the estimate failed (%s) at %s ns; dead reckoning until it starts again",
            type(self).__name__,
            reason,
            self._stamp_ns,
        )
        self._past = self._monitor.dead_reckoning(self._noise, self._rig.gravity)
        self._running = False
        self._attempts += self._starter.attempts
        self._new_start()

    def _prepare(self, measurement: Measurement) -> Step:
        body = Body.of(self._newest)
        at_rest = self._standstill_test.push(measurement.window, body) and self._standstill.enabled
        if self._inertial.has_gap(measurement.window.gap_ns):
            self._count("inertial gaps")
        return self._step(measurement, at_rest=at_rest)

    def _step(self, measurement: Measurement, *, at_rest: bool) -> Step:
        delta, features = measurement.inertial_delta, measurement.features
        if delta is None:
            raise StateError(f"{type(self).__name__}.update needs an inertial increment: set integrator=preintegration")
        bias = self.bias()
        if not (np.array_equal(delta.bias.gyro, bias.gyro) and np.array_equal(delta.bias.accel, bias.accel)):
            delta = delta.at(bias)
        scales = self._inertial.scales(self._scatter.ratios)
        return Step(
            window=measurement.window,
            delta=self._inertial.trusted(delta, measurement.window.gap_ns, scales),
            noise=self._inertial.noise(self._rig.imu, scales),
            tracks=Tracks.none() if features is None or features.tracks is None else features.tracks,
            stereo=features.stereo if features is not None and self._uses_stereo else None,
            at_rest=at_rest,
            untracked=None if features is None else features.untracked,
        )

    def _cross_hole(self, window: SyncedWindow) -> None:
        """Cross a stretch for which no window came, at constant velocity and with little trust in it."""
        self._count("missing windows")
        if self._stamp_ns is None:
            return
        if not self._running:
            self._starter.interrupt()
            if self._past is None:
                return
        state = self._past.state(self._stamp_ns) if self._past is not None else self._newest
        hole = coast_across(state, window, self._rig.gravity, self._inertial)
        if self._past is not None:
            self._past.move_on(self._step(hole, at_rest=False))
        else:
            self._move_on(hole)

    def _status(self) -> Status:
        return "lost" if self._monitor.is_lost else "tracking"

    def _count(self, what: str, by: int = 1) -> None:
        self._counts[what] = self._counts.get(what, 0) + by

    @abstractmethod
    def _begin(self, start: Start) -> None:
        """Forget everything and take a first state, and the calibration where the start found one."""

    @abstractmethod
    def _advance(self, step: Step) -> Support:
        """Move the estimate on to ``step.stamp_ns``, with what the images say."""

    @abstractmethod
    def _estimate(self) -> NavState:
        """The newest state, with its covariance."""
