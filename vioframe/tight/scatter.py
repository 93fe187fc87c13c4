"""How much more the samples of an inertial sensor scatter than its data sheet says."""

import numpy as np

from vioframe.checks import Array
from vioframe.conventions import NANOSECONDS, seconds
from vioframe.types import ImuBlock, ImuNoise, SyncedWindow

# Stands for a sensor that is said to have no noise at all.
_LEAST_DENSITY = 1e-9
# s, over which the scatter is averaged.
_MEMORY_S = 1.0


class SampleScatter:
    """Follows the scatter of successive samples, as a multiple of the stated white noise.

    A sample is held against the straight line through its two neighbours, which leaves white noise and vibration and,
    at a hundred samples a second and more, next to nothing of the motion. A sensor that does not shake gives 1
    (EuRoC's on the ground: 0.7 to 1.0); on EuRoC's vehicle in flight the gyro gives 17 and the accelerometer 40.
    Vibration is not white, though, and adds far less to an increment than white noise of that scatter would: the
    ratio says whether a sensor shakes, not by what factor its increments are worse. A hole between samples reads as
    vibration too: what follows it is trusted less for a second or so.

    Args:
        stated: noise densities of the rig, and its rate.
    """

    def __init__(self, stated: ImuNoise) -> None:
        densities = np.maximum([stated.gyro_noise, stated.accel_noise], _LEAST_DENSITY)
        self._variances = np.repeat(stated.rate_hz * np.square(densities), 3)
        self._squares = np.zeros(2)
        self._weight = 0.0

    @property
    def ratios(self) -> tuple[float, float] | None:
        """Scatter of gyro and accelerometer, each over the stated; None before three samples in a row were seen."""
        if not self._weight:
            return None
        gyro, accel = np.sqrt(self._squares / self._weight).tolist()
        return gyro, accel

    def push(self, window: SyncedWindow) -> None:
        """Take the samples of one more window."""
        imu = window.imu
        # The first and the last are interpolated to the images, which smooths them.
        inside = ImuBlock(stamps_ns=imu.stamps_ns[1:-1], gyro=imu.gyro[1:-1], accel=imu.accel[1:-1])
        if len(inside.stamps_ns) < 3:
            return
        squares = _off_the_line(inside) / self._variances
        fading = float(np.exp(-seconds(window.current.stamp_ns - window.previous.stamp_ns) / _MEMORY_S))
        self._squares = fading * self._squares + np.array([squares[:, :3].sum(), squares[:, 3:].sum()])
        self._weight = fading * self._weight + 3.0 * len(squares)


def _off_the_line(imu: ImuBlock) -> Array:
    """Squared distances (N − 2, 6) of samples from the line through their neighbours, of variance 1 for noise of 1."""
    times = (imu.stamps_ns - imu.stamps_ns[0]) / NANOSECONDS
    values = np.concatenate([imu.gyro, imu.accel], axis=1)
    later = ((times[1:-1] - times[:-2]) / (times[2:] - times[:-2]))[:, None]
    distances = values[1:-1] - (1.0 - later) * values[:-2] - later * values[2:]
    squares: Array = np.square(distances) / (1.0 + (1.0 - later) ** 2 + later**2)
    return squares
