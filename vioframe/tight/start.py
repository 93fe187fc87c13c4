"""Where a tightly coupled estimator begins: at rest, in motion, or from a state that is given."""

from dataclasses import dataclass, replace
from typing import Literal, get_args

from vioframe.errors import ConfigError
from vioframe.fusion_options import StartOptions
from vioframe.tight.options import CalibrationOptions
from vioframe.tight.step import Start
from vioframe.types import InitialisationAttempt, Measurement, NavState, SensorRig

StartMethod = Literal["auto", "rest", "motion"]


@dataclass(frozen=True, slots=True, kw_only=True)
class TightStartOptions(StartOptions):
    """What is assumed of the first state, and how it is found.

    Attributes:
        method: ``rest`` waits for a standstill, ``motion`` for enough motion, ``auto`` takes what comes first.
    """

    method: StartMethod = "auto"

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
        self._rest = options.at_rest(rig)
        self._given: NavState | None = None
        self.attempts: list[InitialisationAttempt] = []

    def give(self, state: NavState) -> None:
        """Begin from this state at the next window's ``previous``."""
        self._given = state

    def interrupt(self) -> None:
        """A stretch passed for which no window came: forget what was seen before it."""
        self._rest = self._options.at_rest(self._rig)

    def push(self, measurement: Measurement) -> Start | None:
        """Take the next window; return where to begin, or None as long as something is missing."""
        if self._given is not None:
            state, self._given = self._given, None
            self._record(measurement, "given")
            state = replace(state, covariance=self._options.covariance_of(state))
            return Start(state=state, method="given", replay=(measurement,))
        state_at_rest = self._rest.push(measurement.window, measurement.features)
        if state_at_rest is None:
            return None
        self._record(measurement, "rest")
        return Start(state=state_at_rest, method="rest")

    def _record(self, measurement: Measurement, method: str) -> None:
        stamp_ns = measurement.window.current.stamp_ns
        self.attempts.append(InitialisationAttempt(stamp_ns=stamp_ns, method=method, succeeded=True))
