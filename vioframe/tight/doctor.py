"""What an attempt to start found, in numbers and in one sentence."""

from dataclasses import dataclass, field

import numpy as np

from vioframe.types import InitialisationAttempt, Measure

NO_TEXTURE = "no texture"
TOO_FEW_POINTS = "too few points"
POINTS_BEHIND = "all points behind"
IMU_HOLES = "IMU samples missing"
SATURATED = "saturated gyro"
SATURATED_ACCEL = "saturated accelerometer"
STANDSTILL = "standstill"
NO_ROTATION = "no rotation"
NO_ACCELERATION = "no acceleration"
NO_PARALLAX = "no parallax"
SWAPPED_AXES = "swapped axes"
WRONG_EXTRINSICS = "wrong extrinsics"
TIME_OFFSET = "time offset"
DISAGREEMENT = "gyro and camera disagree"
GRAVITY_SIGN = "gravity upside down"
GRAVITY = "gravity"
SCALE = "uncertain scale"
POOR_FIT = "poor fit"
UNCONFIRMED = "unconfirmed"


@dataclass(slots=True)
class Examination:
    """Measures of one attempt as they are taken, and the first that is bad: causes are examined before effects.

    Attributes:
        measures: by name.
        fault: short name of what is missing, or empty.
        sentence: what, which value, what to do.
    """

    measures: dict[str, Measure] = field(default_factory=dict)
    fault: str = ""
    sentence: str = ""

    def note(self, name: str, value: float, unit: str = "") -> None:
        """A number that only informs."""
        self.measures[name] = Measure(value=float(value), unit=unit)

    def at_least(self, name: str, value: float, limit: float, unit: str, fault: str, sentence: str) -> bool:
        """A number that must not be smaller; True if it is not."""
        good = self.hold(name, value, limit, unit, good=value >= limit)
        if not good:
            self.blame(fault, sentence)
        return good

    def at_most(self, name: str, value: float, limit: float, unit: str, fault: str, sentence: str) -> bool:
        """A number that must not be larger; True if it is not."""
        good = self.hold(name, value, limit, unit, good=value <= limit)
        if not good:
            self.blame(fault, sentence)
        return good

    def blame(self, fault: str, sentence: str) -> None:
        """Name what is missing, unless something was named before."""
        if not self.fault:
            self.fault, self.sentence = fault, sentence

    def record(self, stamp_ns: int, method: str) -> InitialisationAttempt:
        """The attempt, which succeeded if nothing was bad."""
        return InitialisationAttempt(
            stamp_ns=stamp_ns,
            method=method,
            succeeded=not self.fault,
            fault=self.fault,
            sentence=self.sentence,
            measures=dict(self.measures),
        )

    def hold(self, name: str, value: float, limit: float, unit: str, *, good: bool) -> bool:
        """A number against its limit, the fault of which is named elsewhere."""
        # What cannot be computed is recorded as bad, not as a number.
        finite = float(value) if np.isfinite(value) else float(np.finfo(float).max)
        self.measures[name] = Measure(value=finite, unit=unit, limit=float(limit), good=bool(good))
        return bool(good)
