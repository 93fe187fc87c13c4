"""Whether measurements fit a filter: the χ² limit, the test for standstill, noise that follows contradictions."""

import numpy as np

from vioframe.checks import Array
from vioframe.error_state import Body
from vioframe.initialisation import StillnessDetector
from vioframe.types import SyncedWindow


def chi_square_limit(probability: float, degrees: int) -> float:
    """Value that a χ² variable with this many degrees of freedom stays below with this probability."""
    from scipy.special import chdtri

    return float(chdtri(degrees, 1.0 - probability))


class StandstillTest:
    """Says whether the body is at rest, so that a filter may measure its motion as none.

    A body that coasts smoothly looks the same to its inertial sensors, so the filter must also find its own
    speed near zero; the measurement then still has to pass the filter's χ² gate.

    Args:
        detector: on the inertial samples.
        gyro_limit: rad/s; a mean rate that differs more from the estimated bias is a turn.
        speed_limit: m/s; a larger estimated speed is motion.
    """

    def __init__(self, detector: StillnessDetector, *, gyro_limit: float, speed_limit: float) -> None:
        self._detector = detector
        self._gyro_limit = gyro_limit
        self._speed_limit = speed_limit

    def push(self, window: SyncedWindow, body: Body) -> bool:
        """Take one more window, and what the filter believes at its start."""
        stillness = self._detector.push(window)
        if stillness is None or self._detector.motion(stillness) is not None:
            return False
        return bool(
            np.linalg.norm(stillness.gyro_mean - body.bias.gyro) < self._gyro_limit
            and np.linalg.norm(body.v) < self._speed_limit
        )


class NoiseAdaptation:
    """Raises the stated noise of both sensors while they contradict each other more than it allows.

    Data sheets state the noise of a sensor that does not shake; on a vehicle it is larger, by a factor that
    depends on the vehicle. Odometry states the noise of its points, and its steps share the error of the map.
    A filter that believes both refuses good measurements. Here the logarithm of a variance factor follows the
    innovations (after Mehra, "Approaches to adaptive filtering", IEEE TAC 1972): with χ² that of a block of
    three, over τ seconds it moves by ``min(χ²/3, 9) − 1.6``, never below zero. Where the noise is as stated,
    χ²/3 has a mean of 1, and the factor stays at 1.

    Rotation is where cameras are good, so what contradicts there is the inertial sensor, and what shakes its
    gyro shakes its accelerometer. Translation over one step is where the inertial sensor is good.

    Args:
        time_s: τ.
        most: largest factor on a standard deviation; 1 adapts nothing.
    """

    _TARGET = 1.6
    _CAP = 9.0

    def __init__(self, time_s: float, most: float) -> None:
        self._time_s = time_s
        self._most = 2.0 * float(np.log(most))
        self._logs = np.zeros(2)

    @property
    def inertial(self) -> float:
        """Factor on the standard deviations of the inertial increments."""
        return float(np.exp(0.5 * self._logs[0]))

    @property
    def translation(self) -> float:
        """Factor on the standard deviations of the odometry's translation."""
        return float(np.exp(0.5 * self._logs[1]))

    def learn(self, residual: Array, S: Array, duration_s: float) -> None:
        """Take the innovation (6,), ordered (rotation, translation), of one window, and its covariance (6, 6)."""
        squares = np.array(
            [residual[part] @ np.linalg.solve(S[part, part], residual[part]) for part in (slice(0, 3), slice(3, 6))]
        )
        step = np.minimum(squares / 3.0, self._CAP) - self._TARGET
        self._logs = np.clip(self._logs + duration_s / self._time_s * step, 0.0, self._most)

    def believe_translation(self) -> None:
        """Take the odometry's translation at its word again."""
        self._logs[1] = 0.0
