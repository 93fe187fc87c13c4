"""Sensors that are not synchronised, while a training window is cut: what ``trainer.augmentation.sensors`` draws.

Told stamps are moved away from the true instants of the images. As in use, everything else follows the stamps that are
told: inertial samples are cut between them, and the truth that is learned is that at them; only what the VO answered is
the motion between the true instants. Images that are left out join the pairs on both sides of them, and inertial
samples of a stretch may be missing. All is drawn from the generator given, anew for each window.
"""

from dataclasses import dataclass, fields, replace

import numpy as np

from vioframe.checks import Array, Stamps, check_not_negative
from vioframe.conventions import NANOSECONDS
from vioframe.data.windows import PairAnswers, StoredSequence, TrainingWindow, make_window, samples_between
from vioframe.errors import ConfigError
from vioframe.geometry import se3
from vioframe.geometry.interpolation import interpolate_poses
from vioframe.types import ImuBlock

# Jitter leaves at least this share of an interval between two images.
_LEAST_STEP = 0.2
# Truth further apart than this is not taken for stamps between its poses (as when recordings are stored).
_MAX_TRUTH_GAP_NS = 110_000_000
# Windows of which an image would lie where the truth is unknown stay as they are told after this many attempts.
_ATTEMPTS = 3
# Holes between samples up to this length are interpolated across, as where windows go on without samples in use.
_BRIDGED_S = 0.2


@dataclass(frozen=True, slots=True, kw_only=True)
class Desynchronisation:
    """How far sensors may be out of step; nothing by default.

    Attributes:
        time_offset_s: most by which all images of a window are stamped too late or too early, uniformly drawn.
        stamp_jitter_s: standard deviation of what is added to each stamp; a drawn window has at most this.
        dropped_frames: most expected share of images that are left out, uniformly drawn.
        imu_gap_s: longest stretch without inertial samples, uniformly drawn.
        imu_gap: probability that a window has such a stretch.

    Raises:
        ConfigError: with the key and its value.
    """

    time_offset_s: float = 0.0
    stamp_jitter_s: float = 0.0
    dropped_frames: float = 0.0
    imu_gap_s: float = 0.0
    imu_gap: float = 0.0

    def __post_init__(self) -> None:
        check_not_negative(
            "trainer.augmentation.sensors",
            time_offset_s=self.time_offset_s,
            stamp_jitter_s=self.stamp_jitter_s,
            imu_gap_s=self.imu_gap_s,
        )
        if not 0.0 <= self.dropped_frames <= 0.5:
            raise ConfigError(
                f"trainer.augmentation.sensors.dropped_frames must lie in [0, 0.5], got {self.dropped_frames}"
            )
        if not 0.0 <= self.imu_gap <= 1.0:
            raise ConfigError(f"trainer.augmentation.sensors.imu_gap must lie in [0, 1], got {self.imu_gap}")

    @property
    def active(self) -> bool:
        """Whether anything is ever moved or left out."""
        return any((self.time_offset_s, self.stamp_jitter_s, self.dropped_frames, self.imu_gap and self.imu_gap_s))

    def settings(self) -> dict[str, object]:
        """The options as plain values, for the record."""
        return {each.name: getattr(self, each.name) for each in fields(self)}

    def cut(
        self, sequence: StoredSequence, start: int, pairs: int, recording: int, rng: np.random.Generator
    ) -> TrainingWindow | None:
        """A window that begins at image ``start``, out of step.

        Args:
            sequence: with truth around the images.
            start: number of the first image.
            pairs: in the window; where images are left out it reaches further.
            recording: number of the recording in the split.
            rng: what is drawn from.

        Returns:
            the window, or None where the truth is not known at the stamps that were drawn.
        """
        numbers = self._kept(sequence, start, pairs, rng)
        for _ in range(_ATTEMPTS):
            stamps = self._told(sequence.stamps_ns[numbers], rng)
            poses, covered = interpolate_poses(sequence.truth, stamps, max_gap_ns=_MAX_TRUTH_GAP_NS)
            if covered.all():
                return self._window(sequence, numbers, stamps, poses @ sequence.camera.T_body_cam, recording, rng)
        return None

    def _kept(self, sequence: StoredSequence, start: int, pairs: int, rng: np.random.Generator) -> Stamps:
        """Numbers (pairs + 1,) of the images that are not left out, the first and as many as are wanted."""
        share = rng.uniform(0.0, self.dropped_frames)
        # The unbroken images from here on, no more than may be needed.
        room = pairs + 1 + int(np.ceil(2.0 * share * pairs)) if share else pairs + 1
        while room > pairs + 1 and start not in sequence.starts(room - 1):
            room = (room + pairs + 1) // 2
        dropped = rng.uniform(size=room) < share
        dropped[0] = False
        # What is left out must leave enough.
        surplus = max(int(dropped.sum()) - (room - pairs - 1), 0)
        dropped[np.flatnonzero(dropped)[::-1][:surplus]] = False
        numbers: Stamps = start + np.flatnonzero(~dropped)[: pairs + 1]
        return numbers

    def _told(self, stamps_ns: Stamps, rng: np.random.Generator) -> Stamps:
        offset_s = rng.uniform(-1.0, 1.0) * self.time_offset_s
        jitter_s = rng.uniform() * self.stamp_jitter_s * rng.standard_normal(len(stamps_ns))
        # Stamps stay in order.
        most_s = 0.5 * (1.0 - _LEAST_STEP) * float(np.diff(stamps_ns).min()) / NANOSECONDS
        moved_s = offset_s + np.clip(jitter_s, -most_s, most_s)
        told: Stamps = stamps_ns + np.round(moved_s * NANOSECONDS).astype(np.int64)
        return told

    def _window(
        self,
        sequence: StoredSequence,
        numbers: Stamps,
        stamps: Stamps,
        T_world_cam: Array,
        recording: int,
        rng: np.random.Generator,
    ) -> TrainingWindow:
        answers = None if sequence.vo is None else joined_answers(sequence.vo, numbers)
        inertial = self._samples(sequence.imu, stamps, rng)
        return make_window(sequence, numbers, stamps, T_world_cam, inertial, answers, recording)

    def _samples(
        self, imu: ImuBlock | None, stamps: Stamps, rng: np.random.Generator
    ) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
        """Samples and times of each pair, less those of a stretch within the window."""
        happens, share, place = rng.uniform(size=3)
        samples, times = samples_between(imu, stamps)
        if imu is None or happens >= self.imu_gap or not self.imu_gap_s:
            return samples, times
        span_s = float(stamps[-1] - stamps[0]) / NANOSECONDS
        length_s = min(share * self.imu_gap_s, 0.5 * span_s)
        first_s = place * (span_s - length_s)
        if length_s <= _BRIDGED_S:
            hole = stamps[0] + np.round(np.array([first_s, first_s + length_s]) * NANOSECONDS).astype(np.int64)
            kept = (imu.stamps_ns < hole[0]) | (imu.stamps_ns > hole[1])
            rest = ImuBlock(stamps_ns=imu.stamps_ns[kept], gyro=imu.gyro[kept], accel=imu.accel[kept])
            return samples_between(rest, stamps)
        begins = (stamps[:-1] - stamps[0]) / NANOSECONDS
        pairs = zip(samples, times, begins, strict=True)
        left = [_without(values, at, first_s - begin, first_s + length_s - begin) for values, at, begin in pairs]
        return tuple(values for values, _ in left), tuple(at for _, at in left)


def _without(values: Array, times: Array, first_s: float, last_s: float) -> tuple[Array, Array]:
    """Samples of a pair less those of a hole; its ends keep the value next to them, and most of it missing is all."""
    if not len(times) or last_s <= 0.0 or first_s >= times[-1]:
        return values, times
    kept = (times < first_s) | (times > last_s)
    missing_s = min(last_s, times[-1]) - max(first_s, 0.0)
    if missing_s > 0.5 * times[-1] or not kept.any():
        return np.zeros((0, 6)), np.zeros(0)
    inner = np.flatnonzero(kept)
    ends = np.unique([0, *inner, len(times) - 1])
    source = np.clip(ends, inner[0], inner[-1])
    return values[source], times[ends]


def joined_answers(answers: PairAnswers, numbers: Stamps) -> PairAnswers:
    """Answers for the pairs of the images that are left, chained over those that are not.

    Args:
        answers: for all pairs.
        numbers: (K + 1,) of the images that are left, increasing.
    """
    if len(numbers) == numbers[-1] - numbers[0] + 1:
        return answers.cut(int(numbers[0]), int(numbers[-1]))
    one = answers.cut(int(numbers[0]), int(numbers[0]) + 1)
    T_prev_cur = np.repeat(one.T_prev_cur, len(numbers) - 1, axis=0)
    covariance = np.zeros((len(numbers) - 1, 6, 6))
    valid = np.zeros(len(numbers) - 1, dtype=np.bool_)
    for pair, (first, last) in enumerate(zip(numbers[:-1].tolist(), numbers[1:].tolist(), strict=True)):
        T, stated = answers.T_prev_cur[first], answers.covariance[first]
        for number in range(first + 1, last):
            step = answers.T_prev_cur[number]
            # An error before a motion is, after it, that error seen from there.
            later = se3.adjoint(se3.inverse(step))
            T, stated = T @ step, later @ stated @ later.T + answers.covariance[number]
        T_prev_cur[pair], covariance[pair] = T, stated
        valid[pair] = bool(answers.valid[first:last].all())
    return replace(answers, T_prev_cur=T_prev_cur, covariance=covariance, valid=valid)
