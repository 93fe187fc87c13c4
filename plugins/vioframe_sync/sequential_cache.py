"""Windows at the rate of the images that go on when a sensor falls silent."""

import logging
from collections import deque
from statistics import median

import numpy as np

from vioframe.conventions import NANOSECONDS, seconds
from vioframe.errors import ConfigError, StateError
from vioframe.resampling import resample
from vioframe.types import Frame, ImuBlock, Packet, SensorRig, SyncedWindow
from vioframe_sync.buffered import MISSING_FRAMES, BufferedSynchronizer
from vioframe_sync.held import held_samples

log = logging.getLogger(__name__)

STAND_INS = "stand-ins for images"
EMPTY_WINDOWS = "windows without inertial samples"

# Fewer intervals between images than this say nothing yet of the usual one.
_ENOUGH_INTERVALS = 2
# An image this many usual intervals after the one before is still its successor.
_LATE = 1.5
# No camera is faster; two stamps that nearly repeat must not make thousands of windows of the next hole.
_LEAST_INTERVAL_NS = 2_000_000


class SequentialCacheSynchronizer(BufferedSynchronizer):
    """A window for every image, with inertial samples at N even intervals, and windows where a sensor is silent.

    Images that come with jitter, late or not at all for up to ``max_stretch_s`` make windows of another length. Where
    none comes for longer, windows go on at the usual interval; their ``current`` is a stand-in
    (``Frame.missing``) until the images are back. Where inertial samples stop, windows have an empty ``imu``. Either
    may be missing from the start. Where both are silent there is one window from the last sign of life to the next.
    See the README for what happens at the ends of a hole.

    Time is that of the stamps and each decision waits until ``max_wait_s`` more of the stream is known, so the
    windows do not depend on the order in which packets of the two sensors arrive within that time.

    Args:
        poses: N, inertial intervals an image, whatever the sensor's rate; None leaves the samples as they came.
        max_wait_s: how long an image waits for inertial samples, and a stand-in for the image, s of stream time.
        max_gap_s: spacing of samples that counts as an inertial gap, s (at least 2.5 nominal intervals).
        max_bridge_s: longest hole between samples that is interpolated across, s (at least 2.5 nominal intervals);
            inside a longer one there are no samples.
        max_stretch_s: longest time between two images that makes one window, s (at least 1.5 usual intervals).
        image_interval_s: taken as the usual one before images have shown it, s.

    Raises:
        ConfigError: a value that is not positive, or a wait shorter than the longest bridge.
    """

    def __init__(
        self,
        *,
        poses: int | None = 10,
        max_wait_s: float = 0.5,
        max_gap_s: float = 0.05,
        max_bridge_s: float = 0.2,
        max_stretch_s: float = 0.35,
        image_interval_s: float = 0.1,
    ) -> None:
        super().__init__(max_wait_s=max_wait_s, max_gap_s=max_gap_s)
        for name, value in (
            ("max_bridge_s", max_bridge_s),
            ("max_stretch_s", max_stretch_s),
            ("image_interval_s", image_interval_s),
        ):
            if not value > 0.0:
                raise ConfigError(f"synchronizer.{name} must be positive, got {value}")
        if poses is not None and poses < 1:
            raise ConfigError(f"synchronizer.poses must be 1 or more, or null for the samples as they are, got {poses}")
        if max_bridge_s > max_wait_s:
            raise ConfigError(
                f"synchronizer.max_bridge_s={max_bridge_s} must not exceed max_wait_s={max_wait_s}: a hole is bridged "
                "only once the sample after it has come"
            )
        self._poses = poses
        self._max_bridge_s = max_bridge_s
        self._max_stretch_ns = round(max_stretch_s * NANOSECONDS)
        self._first_interval_ns = round(image_interval_s * NANOSECONDS)

    def setup(self, rig: SensorRig) -> None:
        """Empty the queues and take the camera delay and the inertial rate of the next sequence."""
        super().setup(rig)
        self._counts[STAND_INS] = self._counts[EMPTY_WINDOWS] = 0
        self._bridge_ns = round(max(self._max_bridge_s, 2.5 / rig.imu.rate_hz) * NANOSECONDS)
        self._usual_ns = self._first_interval_ns
        self._last_image_ns: int | None = None
        self._first_sample_ns: int | None = None
        self._told_rate = False

    def push(self, packet: Packet) -> list[SyncedWindow]:
        """Take a frame (camera clock) or a block of samples (IMU clock); return the windows that are now certain."""
        if not self._ready:
            raise StateError(f"{type(self).__name__}.push was called before setup(rig): set the synchronizer up first")
        if isinstance(packet, Frame):
            self._take_frame(packet)
        else:
            self._take_samples(packet)
            if self._first_sample_ns is None and len(packet):
                self._first_sample_ns = int(packet.stamps_ns[0])
        if not self._has_imu:
            return self._pair() if self._waiting else []
        windows = self._proceed(ended=False)
        self._forget()
        return windows

    def flush(self) -> list[SyncedWindow]:
        """The recording has ended: nothing is waited for any longer."""
        if not self._ready or not self._has_imu:
            return []
        windows = self._proceed(ended=True)
        if not self._emitted and self._newest_frame_ns is not None:
            log.warning(
                "no inertial sample lies between two frames: the last frame is at %d ns, the last sample at %s ns "
                "(IMU clock); check that both clocks overlap",
                self._newest_frame_ns,
                self._newest_imu_ns,
            )
        return windows

    def _count_missing(self, interval_ns: int, stamp_ns: int) -> None:
        """Counted when an image is used: only then are its neighbours certain."""

    def _cut(self, samples: ImuBlock, start_ns: int, end_ns: int) -> ImuBlock:
        return held_samples(samples, start_ns, end_ns, self._bridge_ns)[0]

    def _proceed(self, *, ended: bool) -> list[SyncedWindow]:
        windows = []
        while (frame := self._next(ended)) is not None:
            previous, self._previous = self._previous, frame
            self._note(frame)
            if previous is not None:
                windows.append(self._between(previous, frame))
        return windows

    def _next(self, ended: bool) -> Frame | None:
        """The next image, or a stand-in for one, whose window is certain; None where more must be waited for."""
        if self._previous is None:
            return self._first(ended)
        start_ns = self._previous.stamp_ns
        limit_ns = round(_LATE * self._usual_ns)
        if not self._previous.missing:
            limit_ns = max(limit_ns, self._max_stretch_ns)
        if self._waiting and self._waiting[0].stamp_ns - start_ns <= limit_ns:
            return self._waiting.pop(0) if self._certain(self._waiting[0].stamp_ns, ended) else None
        if self._waiting:
            # Where no sample is known either, one may yet come between the hole and the image.
            silent = self._sample_after(start_ns) is None
            next_ns = self._waiting[0].stamp_ns if silent else start_ns + self._usual_ns
            return self._over_hole(start_ns) if self._certain(next_ns, ended) else None
        newest_ns = self._newest_imu_ns
        patience_ns = 0 if ended else self._max_wait_ns
        if newest_ns is None or newest_ns - start_ns <= limit_ns + patience_ns:
            return None
        return self._over_hole(start_ns)

    def _over_hole(self, start_ns: int) -> Frame | None:
        """The next step through a hole between images: after the usual interval, or where there is a sign of life."""
        expected_ns = start_ns + self._usual_ns
        sample_ns = self._sample_after(start_ns)
        alive_ns = expected_ns if sample_ns is None else max(expected_ns, sample_ns)
        if self._waiting and (sample_ns is None or self._waiting[0].stamp_ns - alive_ns <= self._usual_ns // 2):
            return self._waiting.pop(0)
        return None if sample_ns is None else self._stand_in(alive_ns)

    def _sample_after(self, stamp_ns: int) -> int | None:
        for block in self._blocks:
            if block.stamps_ns[-1] > stamp_ns:
                return int(block.stamps_ns[np.searchsorted(block.stamps_ns, stamp_ns, side="right")])
        return None

    def _first(self, ended: bool) -> Frame | None:
        """Where the windows begin: at the first image, or at the first sample if images are long in coming."""
        begun_ns, newest_ns = self._first_sample_ns, self._newest_imu_ns
        if self._waiting:
            image_ns = self._waiting[0].stamp_ns
            if not self._certain(image_ns, ended):
                return None
            if begun_ns is None or image_ns - begun_ns <= self._max_stretch_ns:
                return self._waiting.pop(0)
            return self._stand_in(begun_ns)
        if begun_ns is None or newest_ns is None:
            return None
        patience_ns = 0 if ended else self._max_wait_ns
        return self._stand_in(begun_ns) if newest_ns - begun_ns > self._max_stretch_ns + patience_ns else None

    def _certain(self, stamp_ns: int, ended: bool) -> bool:
        """Whether the samples up to a stamp have come, or need not be waited for."""
        if ended or (self._newest_imu_ns is not None and self._newest_imu_ns >= stamp_ns):
            return True
        return self._newest_frame_ns is not None and self._newest_frame_ns - stamp_ns > self._max_wait_ns

    def _stand_in(self, stamp_ns: int) -> Frame:
        self._delays[stamp_ns] = self._delay_ns
        if not self._counts[STAND_INS]:
            log.warning("no image since before %d ns: windows go on without (counted as %s)", stamp_ns, STAND_INS)
        self._counts[STAND_INS] += 1
        return Frame(stamp_ns=stamp_ns, missing=True)

    def _note(self, frame: Frame) -> None:
        """Learn the usual interval from images as they are used, which does not depend on their order of arrival."""
        if frame.missing:
            return
        if self._last_image_ns is not None:
            interval_ns = frame.stamp_ns - self._last_image_ns
            if interval_ns > _LATE * self._usual_ns and len(self._intervals) >= _ENOUGH_INTERVALS:
                text = f"{seconds(interval_ns):.3f} s without an image before {frame.stamp_ns} ns"
                self._count(MISSING_FRAMES, round(interval_ns / self._usual_ns) - 1, text)
            self._intervals.append(interval_ns)
            if len(self._intervals) >= _ENOUGH_INTERVALS:
                self._usual_ns = max(round(median(self._intervals)), _LEAST_INTERVAL_NS)
        self._last_image_ns = frame.stamp_ns

    def _between(self, previous: Frame, current: Frame) -> SyncedWindow:
        samples = self._samples_from(previous.stamp_ns)
        imu, gap_ns = held_samples(samples, previous.stamp_ns, current.stamp_ns, self._bridge_ns)
        self._emitted = self._emitted or (len(imu) > 0 and not previous.missing and not current.missing)
        delay_ns = self._delays[current.stamp_ns]
        waiting = {frame.stamp_ns for frame in self._waiting}
        self._delays = {stamp_ns: delay for stamp_ns, delay in self._delays.items() if stamp_ns in waiting}
        if not len(imu):
            text = f"no inertial samples from {previous.stamp_ns} to {current.stamp_ns} ns"
            self._count(EMPTY_WINDOWS, 1, text)
        elif self._poses is not None:
            resampled = resample(imu, self._poses)
            if resampled is not imu and not self._told_rate and gap_ns <= self._max_gap_ns:
                self._told_rate = True
                log.info("%d inertial intervals an image are resampled to %d", len(imu) - 1, self._poses)
            imu = resampled
        return SyncedWindow(previous=previous, current=current, imu=imu, gap_ns=gap_ns, camera_delay_ns=delay_ns)

    def _samples_from(self, stamp_ns: int) -> ImuBlock:
        """All that has come from the last sample at or before a stamp on."""
        self._forget_before(stamp_ns)
        if len(self._blocks) > 1:
            joined = ImuBlock(
                stamps_ns=np.concatenate([block.stamps_ns for block in self._blocks]),
                gyro=np.concatenate([block.gyro for block in self._blocks]),
                accel=np.concatenate([block.accel for block in self._blocks]),
            )
            start = int(np.searchsorted(joined.stamps_ns, stamp_ns, side="right")) - 1
            self._blocks = deque([joined.cut(max(start, 0), len(joined))])
        return self._blocks[0] if self._blocks else ImuBlock.none()

    def _forget(self) -> None:
        # Until there is a first window every sample may still be where it begins; that is decided soon.
        if self._previous is not None:
            self._forget_before(self._previous.stamp_ns)

    def _forget_before(self, stamp_ns: int) -> None:
        while len(self._blocks) > 1 and self._blocks[1].stamps_ns[0] <= stamp_ns:
            self._blocks.popleft()
