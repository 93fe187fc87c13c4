"""Samples at the stamps of the frames by linear interpolation."""

import numpy as np

from vioframe.checks import Array
from vioframe.types import ImuBlock
from vioframe_sync.buffered import BufferedSynchronizer


class InterpolateSynchronizer(BufferedSynchronizer):
    """Windows whose first and last inertial samples are interpolated linearly to the stamps of the frames.

    The integral of the piecewise linear signal over adjoining windows is that over their union, so nothing
    is lost or counted twice where two windows meet.
    """

    def _cut(self, samples: ImuBlock, start_ns: int, end_ns: int) -> ImuBlock:
        stamps_ns = samples.stamps_ns
        after_start = int(np.searchsorted(stamps_ns, start_ns, side="right"))
        at_end = int(np.searchsorted(stamps_ns, end_ns, side="left"))
        inner = slice(after_start, at_end)
        start = _between(samples, after_start - 1, start_ns)
        end = _between(samples, at_end if stamps_ns[at_end] == end_ns else at_end - 1, end_ns)
        return ImuBlock(
            stamps_ns=np.concatenate([[start_ns], stamps_ns[inner], [end_ns]]),
            gyro=np.concatenate([start[:1], samples.gyro[inner], end[:1]]),
            accel=np.concatenate([start[1:], samples.accel[inner], end[1:]]),
        )


def _between(samples: ImuBlock, before: int, stamp_ns: int) -> Array:
    """Gyro and accel, (2, 3), at a stamp between the samples ``before`` and ``before + 1``."""
    known_ns = samples.stamps_ns[before]
    if known_ns == stamp_ns:
        return np.stack([samples.gyro[before], samples.accel[before]])
    after = before + 1
    fraction = float(stamp_ns - known_ns) / float(samples.stamps_ns[after] - known_ns)
    earlier = np.stack([samples.gyro[before], samples.accel[before]])
    later = np.stack([samples.gyro[after], samples.accel[after]])
    value: Array = earlier + fraction * (later - earlier)
    return value
