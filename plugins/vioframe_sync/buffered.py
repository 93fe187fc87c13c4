"""What both synchronizers share: the queues, the waiting and the counting."""

import itertools
import logging
from abc import abstractmethod
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import replace
from statistics import median

import numpy as np

from vioframe.conventions import NANOSECONDS, seconds
from vioframe.errors import ConfigError, StateError
from vioframe.interfaces import Synchronizer
from vioframe.types import Frame, ImuBlock, Packet, SensorRig, SyncedWindow

log = logging.getLogger(__name__)

DROPPED_FRAMES = "dropped frames"
MISSING_FRAMES = "missing frames"
INERTIAL_GAPS = "inertial gaps"
DROPPED_SAMPLES = "dropped inertial samples"

# The usual interval is the median of this many; fewer than the second number say nothing yet.
_INTERVALS, _ENOUGH_INTERVALS = 15, 5


class BufferedSynchronizer(Synchronizer):
    """Holds frames until inertial samples reach past them, and samples until a frame has used them.

    Time is that of the stamps, never the wall clock, so a recording gives the same windows at any speed.
    Windows follow each other without a break: a hole in the samples or a lost frame makes a longer window,
    and ``gap_ns`` says how long nothing was measured. Samples are kept from the last frame on, so memory
    is bounded by the longest time without a frame.

    Where the rig has no inertial sensor nothing is waited for: each frame makes a window, without samples,
    with the one before.

    Args:
        max_wait_s: how long a frame waits for inertial samples, s of stream time, before it is dropped; also
            how far the packets of the two sensors may be out of order.
        max_gap_s: spacing of samples that counts as an inertial gap, s (at least 2.5 nominal intervals).

    Raises:
        ConfigError: a value that is not positive.
    """

    def __init__(self, *, max_wait_s: float = 1.0, max_gap_s: float = 0.05) -> None:
        for name, value in (("max_wait_s", max_wait_s), ("max_gap_s", max_gap_s)):
            if not value > 0.0:
                raise ConfigError(f"synchronizer.{name} must be positive, got {value}")
        self._max_wait_ns = round(max_wait_s * NANOSECONDS)
        self._max_gap_s = max_gap_s
        self._ready = False

    def setup(self, rig: SensorRig) -> None:
        """Empty the queues and take the camera delay and the inertial rate of the next sequence."""
        self._delay_ns = rig.camera_delay_ns
        self._has_imu = rig.has_imu
        self._max_gap_ns = round(max(self._max_gap_s, 2.5 / rig.imu.rate_hz) * NANOSECONDS)
        self._blocks: deque[ImuBlock] = deque()
        self._newest_imu_ns: int | None = None
        self._waiting: list[Frame] = []
        self._delays: dict[int, int] = {}
        self._previous: Frame | None = None
        self._newest_frame_ns: int | None = None
        self._intervals: deque[int] = deque(maxlen=_INTERVALS)
        self._emitted = False
        self._counts: Counter[str] = Counter(
            {DROPPED_FRAMES: 0, MISSING_FRAMES: 0, INERTIAL_GAPS: 0, DROPPED_SAMPLES: 0}
        )
        self._ready = True

    def assume_camera_delay(self, delay_ns: int) -> None:
        """Stamp the frames to come with this delay; those that wait keep theirs."""
        self._delay_ns = delay_ns

    def counters(self) -> Mapping[str, int]:
        """Frames dropped here, frames that never came, holes in the samples, samples out of order."""
        return dict(self._counts) if self._ready else {}

    def push(self, packet: Packet) -> list[SyncedWindow]:
        """Take a frame (camera clock) or a block of samples (IMU clock); return the windows it completes."""
        if not self._ready:
            raise StateError(f"{type(self).__name__}.push was called before setup(rig): set the synchronizer up first")
        if isinstance(packet, Frame):
            self._take_frame(packet)
        else:
            self._take_samples(packet)
        if not self._waiting:
            windows = []
        else:
            windows = self._complete() if self._has_imu else self._pair()
        self._forget()
        return windows

    def flush(self) -> list[SyncedWindow]:
        """The recording has ended: frames after the last inertial sample are dropped and counted."""
        if not self._ready:
            return []
        for frame in self._waiting:
            self._drop(frame, "no inertial sample follows it to the end of the recording")
        self._waiting = []
        if self._has_imu and not self._emitted and self._newest_frame_ns is not None:
            log.warning(
                "no frame could be paired with inertial samples: the last frame is at %d ns, the last sample at %s ns "
                "(IMU clock); check that both clocks overlap",
                self._newest_frame_ns,
                self._newest_imu_ns,
            )
        return []

    @abstractmethod
    def _cut(self, samples: ImuBlock, start_ns: int, end_ns: int) -> ImuBlock:
        """Samples from ``start_ns`` to ``end_ns`` with one exactly at both; ``samples`` reaches to or past both."""

    def _take_frame(self, frame: Frame) -> None:
        if self._delay_ns:
            frame = replace(frame, stamp_ns=frame.stamp_ns + self._delay_ns)
        stamp_ns = frame.stamp_ns
        self._delays[stamp_ns] = self._delay_ns
        if self._newest_frame_ns is not None and stamp_ns > self._newest_frame_ns:
            self._count_missing(stamp_ns - self._newest_frame_ns, stamp_ns)
        self._newest_frame_ns = stamp_ns if self._newest_frame_ns is None else max(stamp_ns, self._newest_frame_ns)
        if self._previous is not None and stamp_ns <= self._previous.stamp_ns:
            self._drop(frame, "a frame at or after its stamp has been used")
            return
        place = len(self._waiting)
        while place and self._waiting[place - 1].stamp_ns > stamp_ns:
            place -= 1
        if place and self._waiting[place - 1].stamp_ns == stamp_ns:
            self._drop(frame, "its stamp repeats")
            return
        self._waiting.insert(place, frame)

    def _count_missing(self, interval_ns: int, stamp_ns: int) -> None:
        if len(self._intervals) >= _ENOUGH_INTERVALS:
            usual_ns = median(self._intervals)
            if interval_ns > 1.5 * usual_ns:
                self._count(
                    MISSING_FRAMES,
                    round(interval_ns / usual_ns) - 1,
                    f"{seconds(interval_ns):.3f} s without a frame before {stamp_ns} ns",
                )
        self._intervals.append(interval_ns)

    def _take_samples(self, block: ImuBlock) -> None:
        if not len(block):
            return
        newest = self._newest_imu_ns
        if newest is not None and block.stamps_ns[0] <= newest:
            fresh = block.stamps_ns > newest
            late = len(block) - int(fresh.sum())
            self._count(
                DROPPED_SAMPLES, late, f"{late} inertial samples came at or after a later one, before {newest} ns"
            )
            if late == len(block):
                return
            block = ImuBlock(stamps_ns=block.stamps_ns[fresh], gyro=block.gyro[fresh], accel=block.accel[fresh])
        stamps_ns = block.stamps_ns
        if newest is not None and stamps_ns[0] - newest > self._max_gap_ns:
            text = f"{seconds(stamps_ns[0] - newest):.3f} s without inertial samples after {newest} ns"
            self._count(INERTIAL_GAPS, 1, text)
        if len(stamps_ns) > 1:
            steps = stamps_ns[1:] - stamps_ns[:-1]
            if steps.max() > self._max_gap_ns:
                holes = np.flatnonzero(steps > self._max_gap_ns)
                first = int(holes[0])
                text = f"{seconds(steps[first]):.3f} s without inertial samples after {stamps_ns[first]} ns"
                self._count(INERTIAL_GAPS, len(holes), text)
        self._blocks.append(block)
        self._newest_imu_ns = int(stamps_ns[-1])

    def _complete(self) -> list[SyncedWindow]:
        """Turn the waiting frames that samples have reached into windows, oldest first."""
        windows: list[SyncedWindow] = []
        newest = self._newest_imu_ns
        # Packets of the two sensors may arrive crosswise: only the stream's own time says what is late.
        now_ns = self._waiting[-1].stamp_ns
        while self._waiting:
            frame = self._waiting[0]
            if newest is None or frame.stamp_ns > newest:
                if now_ns - frame.stamp_ns <= self._max_wait_ns:
                    break
                self._waiting.pop(0)
                self._drop(frame, f"no inertial sample reached it in {seconds(self._max_wait_ns):.3g} s")
                continue
            self._waiting.pop(0)
            if self._previous is None and frame.stamp_ns < self._blocks[0].stamps_ns[0]:
                self._drop(frame, f"it is before the first inertial sample kept, at {self._blocks[0].stamps_ns[0]} ns")
                continue
            if self._previous is not None:
                windows.append(self._window(self._previous, frame))
            self._previous = frame
        return windows

    def _window(self, previous: Frame, current: Frame) -> SyncedWindow:
        samples = self._joined()
        stamps_ns = samples.stamps_ns
        first = int(np.searchsorted(stamps_ns, previous.stamp_ns, side="right")) - 1
        last = int(np.searchsorted(stamps_ns, current.stamp_ns, side="left"))
        around = stamps_ns[first : last + 1]
        imu = self._cut(samples, previous.stamp_ns, current.stamp_ns)
        self._emitted = True
        delay_ns = self._delays[current.stamp_ns]
        waiting = {frame.stamp_ns for frame in self._waiting}
        self._delays = {stamp_ns: delay for stamp_ns, delay in self._delays.items() if stamp_ns in waiting}
        return SyncedWindow(
            previous=previous,
            current=current,
            imu=imu,
            gap_ns=int((around[1:] - around[:-1]).max()),
            camera_delay_ns=delay_ns,
        )

    def _pair(self) -> list[SyncedWindow]:
        """Windows of the waiting frames alone."""
        frames = self._waiting if self._previous is None else [self._previous, *self._waiting]
        windows = [
            SyncedWindow(
                previous=previous,
                current=current,
                imu=ImuBlock.none(),
                gap_ns=current.stamp_ns - previous.stamp_ns,
                camera_delay_ns=self._delays[current.stamp_ns],
            )
            for previous, current in itertools.pairwise(frames)
        ]
        self._previous = frames[-1]
        self._waiting = []
        self._delays.clear()
        return windows

    def _joined(self) -> ImuBlock:
        if len(self._blocks) > 1:
            blocks = self._blocks
            # The first block may be an old one that a single sample keeps: take from that sample on.
            used_ns = self._blocks[0].stamps_ns[0] if self._previous is None else self._previous.stamp_ns
            start = int(np.searchsorted(blocks[0].stamps_ns, used_ns, side="right")) - 1
            joined = ImuBlock(
                stamps_ns=np.concatenate([block.stamps_ns for block in blocks])[start:],
                gyro=np.concatenate([block.gyro for block in blocks])[start:],
                accel=np.concatenate([block.accel for block in blocks])[start:],
            )
            self._blocks = deque([joined])
        return self._blocks[0]

    def _forget(self) -> None:
        """Drop the blocks that no frame still to come can need."""
        if len(self._blocks) < 2:
            return
        if self._previous is not None:
            horizon = self._previous.stamp_ns
        elif self._waiting:
            horizon = self._waiting[0].stamp_ns
        elif self._newest_imu_ns is not None:
            horizon = self._newest_imu_ns - self._max_wait_ns
        else:
            return
        while len(self._blocks) > 1 and self._blocks[1].stamps_ns[0] <= horizon:
            self._blocks.popleft()

    def _drop(self, frame: Frame, reason: str) -> None:
        self._count(DROPPED_FRAMES, 1, f"the frame at {frame.stamp_ns} ns is dropped: {reason}")

    def _count(self, name: str, how_many: int, text: str) -> None:
        # The first of a kind is worth a line; the table has the number.
        log.log(logging.DEBUG if self._counts[name] else logging.WARNING, "%s (counted as %s)", text, name)
        self._counts[name] += how_many
