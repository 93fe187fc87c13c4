"""Samples at the stamps of the frames by taking the nearest."""

import numpy as np

from vioframe.types import ImuBlock
from vioframe_sync.buffered import BufferedSynchronizer


class NearestSynchronizer(BufferedSynchronizer):
    """Windows whose first and last inertial samples are the nearest ones, stamped anew.

    What simple systems do, and exact where the camera is triggered with the IMU. Otherwise the sample at a
    frame is up to half an interval off: use it to see what that costs.
    """

    def _cut(self, samples: ImuBlock, start_ns: int, end_ns: int) -> ImuBlock:
        start, end = _nearest(samples, start_ns), _nearest(samples, end_ns)
        after_start = int(np.searchsorted(samples.stamps_ns, start_ns, side="right"))
        at_end = int(np.searchsorted(samples.stamps_ns, end_ns, side="left"))
        # A sample inside the window that was moved to an end must not appear a second time.
        inner = np.arange(max(after_start, start + 1), min(at_end, end))
        picked = np.concatenate([[start], inner, [end]])
        stamps_ns = samples.stamps_ns[picked]
        stamps_ns[0], stamps_ns[-1] = start_ns, end_ns
        return ImuBlock(stamps_ns=stamps_ns, gyro=samples.gyro[picked], accel=samples.accel[picked])


def _nearest(samples: ImuBlock, stamp_ns: int) -> int:
    """Index of the sample nearest to a stamp; of two equally near, the earlier."""
    after = int(np.searchsorted(samples.stamps_ns, stamp_ns, side="left"))
    if after == 0:
        return 0
    earlier = stamp_ns - samples.stamps_ns[after - 1] <= samples.stamps_ns[after] - stamp_ns
    return after - 1 if earlier else after
