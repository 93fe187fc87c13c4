"""Where a tightly coupled estimator begins: at rest, in motion, or from a state that is given."""

import logging
from collections import deque
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

from vioframe.conventions import seconds
from vioframe.errors import ConfigError
from vioframe.fusion_options import StartOptions
from vioframe.initialisation import RestInitialiser
from vioframe.tight.motion_options import MotionStartOptions
from vioframe.tight.motion_start import MotionStart
from vioframe.tight.options import CalibrationOptions
from vioframe.tight.step import Start
from vioframe.types import InitialisationAttempt, Measurement, NavState, SensorRig

log = logging.getLogger(__name__)

# A start takes a second or two; what is missing until then is in the record, but no news.
_PATIENCE_S = 3.0
# A quarter of an hour at four attempts a second.
_MOST_ATTEMPTS = 4000

StartMethod = Literal["auto", "rest", "motion"]


@dataclass(frozen=True, slots=True, kw_only=True)
class TightStartOptions(StartOptions):
    """What is assumed of the first state, and how it is found.

    Attributes:
        method: ``rest`` waits for a standstill, ``motion`` for enough motion, ``auto`` takes what comes first.
        motion: what a start in motion needs.
    """

    method: StartMethod = "auto"
    motion: MotionStartOptions = field(default_factory=MotionStartOptions)

    def __post_init__(self) -> None:
        StartOptions.__post_init__(self)
        if self.method not in get_args(StartMethod):
            raise ConfigError(
                f"fuser.start.method must be one of {', '.join(get_args(StartMethod))}, got {self.method!r}"
            )


class Starter:
    """Looks at windows until there is a state to start from, and keeps a record of every attempt.

    Args:
        rig: calibration.
        options: how to begin.
        calibration: whether the camera's rotation on the body must be found first.
    """

    def __init__(self, rig: SensorRig, options: TightStartOptions, calibration: CalibrationOptions) -> None:
        self._rig = rig
        self._options = options
        self._calibration = calibration
        self._rest = self._new_rest()
        self._motion = None if options.method == "rest" else MotionStart(rig, options.motion, calibration)
        self._given: NavState | None = None
        self._first_ns: int | None = None
        self._said = ""
        self.attempts: deque[InitialisationAttempt] = deque(maxlen=_MOST_ATTEMPTS)

    def give(self, state: NavState) -> None:
        """Begin from this state at the next window's ``previous``."""
        self._given = state

    def interrupt(self) -> None:
        """A stretch passed for which no window came: forget what was seen before it."""
        self._rest = self._new_rest()
        if self._motion is not None:
            self._motion.clear()

    def push(self, measurement: Measurement) -> Start | None:
        """Take the next window; return where to begin, or None as long as something is missing."""
        stamp_ns = measurement.window.current.stamp_ns
        delay_s = seconds(measurement.window.camera_delay_ns)
        if self._given is not None:
            state, self._given = self._given, None
            self._record(InitialisationAttempt(stamp_ns=stamp_ns, method="given", succeeded=True))
            state = replace(state, covariance=self._options.covariance_of(state))
            return Start(state=state, method="given", camera_delay_s=delay_s, replay=(measurement,))
        if self._first_ns is None:
            self._first_ns = stamp_ns
        if self._rest is not None:
            state_at_rest = self._rest.push(measurement.window, measurement.features)
            # At rest nothing tells how the camera sits on the body.
            if state_at_rest is not None and self._calibration.extrinsics != "find":
                self._record(InitialisationAttempt(stamp_ns=stamp_ns, method="rest", succeeded=True))
                return Start(state=state_at_rest, method="rest", camera_delay_s=delay_s)
        if self._motion is None:
            return None
        start, attempt = self._motion.push(measurement)
        if attempt is not None:
            self._record(attempt)
        return start

    def _new_rest(self) -> RestInitialiser | None:
        if self._options.method == "motion":
            return None
        # Where motion will do as well, waiting for a standstill is nothing to complain about.
        return self._options.at_rest(self._rig, complain=self._options.method == "rest")

    def _record(self, attempt: InitialisationAttempt) -> None:
        self.attempts.append(attempt)
        waited = 0.0 if self._first_ns is None else seconds(attempt.stamp_ns - self._first_ns)
        if attempt.fault and attempt.fault != self._said and waited > _PATIENCE_S:
            log.warning("not started after %.1f s, %s: %s", waited, attempt.fault, attempt.sentence)
            self._said = attempt.fault
