"""From a recording to windows of consecutive images for training: numpy only, and no truth for any estimator.

A :class:`StoredSequence` holds one recording as training needs it: decoded images of camera 0 at the size of the net,
the inertial samples between them, and the true motion of the camera. A fuser learns from what a VO answered instead
(:class:`PairAnswers`), and needs no images. :class:`WindowIndex` says where windows may begin: nowhere across a missing
image or where the truth is unknown. Splits are made of whole recordings.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from vioframe.checks import Array, Mask, Stamps, check_array, check_increasing, check_pose
from vioframe.conventions import NANOSECONDS
from vioframe.errors import ConfigError, DataError, ShapeError
from vioframe.geometry import se3
from vioframe.geometry.interpolation import differentiate_positions
from vioframe.types import Camera, Image, ImuBlock, Trajectory

# A pair further apart than this many usual intervals is not two consecutive images: some are missing between them.
_LONGEST_STEP = 1.5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PairAnswers:
    """What a VO answered for P pairs of consecutive images.

    Attributes:
        T_prev_cur: (P, 4, 4) motion of camera 0, metres; the identity where it is not valid.
        covariance: (P, 6, 6) in the tangent (rotation, translation) at the later image; zero where none was stated.
        valid: (P,) whether the VO stands by its answer.
    """

    T_prev_cur: Array
    covariance: Array
    valid: Mask

    def __post_init__(self) -> None:
        count = len(self.valid)
        check_array("PairAnswers.valid", self.valid, (count,), np.bool_)
        check_array("PairAnswers.T_prev_cur", self.T_prev_cur, (count, 4, 4))
        check_array("PairAnswers.covariance", self.covariance, (count, 6, 6))
        check_pose("PairAnswers.T_prev_cur", self.T_prev_cur, tolerance=1e-4)

    def __len__(self) -> int:
        return len(self.valid)

    def cut(self, start: int, stop: int) -> Self:
        """Those of pairs ``start`` to ``stop - 1``."""
        kept = slice(start, stop)
        return replace(self, T_prev_cur=self.T_prev_cur[kept], covariance=self.covariance[kept], valid=self.valid[kept])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StoredSequence:
    """One recording, decoded and resized.

    Attributes:
        name: of the sequence.
        images: (F, H, W, C) uint8, C = 1 or 3 (RGB), of camera 0; may be mapped from disk; (F, 0, 0, 1) where none are
            needed.
        stamps_ns: (F,) IMU clock.
        T_world_cam: (F, 4, 4) true poses of camera 0; the identity where unknown.
        known: (F,) whether the pose is known.
        imu: samples around and between the images, or None.
        camera: camera 0 as it is after resizing.
        gravity: m/s².
        truth: poses and velocities of the body, as closely spaced as they are known.
        vo: what a VO answered for the F - 1 pairs, or None.
    """

    name: str
    images: Image
    stamps_ns: Stamps
    T_world_cam: Array
    known: Mask
    imu: ImuBlock | None
    camera: Camera
    gravity: float
    truth: Trajectory
    vo: PairAnswers | None = None

    def __post_init__(self) -> None:
        count = len(self.stamps_ns)
        if self.images.ndim != 4 or len(self.images) != count or self.images.shape[-1] not in (1, 3):
            raise ShapeError(f"StoredSequence.images must have shape ({count}, H, W, 1 or 3), got {self.images.shape}")
        check_array("StoredSequence.known", self.known, (count,), np.bool_)
        check_array("StoredSequence.T_world_cam", self.T_world_cam, (count, 4, 4))
        check_pose("StoredSequence.T_world_cam", self.T_world_cam, tolerance=1e-4)
        check_increasing("StoredSequence.stamps_ns", self.stamps_ns)
        if self.truth.v_world_body is None:
            raise ShapeError("StoredSequence.truth must have velocities; differentiate_positions makes some")
        if self.vo is not None and len(self.vo) != count - 1:
            raise ShapeError(f"StoredSequence.vo must answer for {count - 1} pairs, got {len(self.vo)}")

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def starts(self, pairs: int) -> Stamps:
        """Numbers (K,) of the images at which a window of ``pairs`` pairs may begin."""
        steps = np.diff(self.stamps_ns)
        if len(steps) < pairs:
            return np.zeros(0, dtype=np.int64)
        sound = (steps <= _LONGEST_STEP * np.median(steps)) & self.known[:-1] & self.known[1:]
        run = np.concatenate([[0], np.cumsum(sound)])
        starts: Stamps = np.flatnonzero(run[pairs:] - run[:-pairs] == pairs)
        return starts

    def motions(self) -> Array:
        """True motion (F - 1, 4, 4) of the camera over each pair; meaningless where a pose is unknown."""
        return se3.inverse(self.T_world_cam[:-1]) @ self.T_world_cam[1:]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrainingWindow:
    """S pairs of consecutive images with the inertial samples between them and the true motion.

    Attributes:
        images: (S + 1, H, W, C) uint8.
        stamps_ns: (S + 1,) IMU clock.
        T_prev_cur: (S, 4, 4) motion of camera 0, metres.
        imu: for each pair (N, 6) gyro rad/s and specific force m/s², body; the ends lie at the images; N may be 0.
        imu_time_s: for each pair (N,) seconds since its first image.
        intrinsics_px: (4,) fx, fy, cx, cy.
        T_body_cam: (4, 4).
        gravity: m/s².
        velocity_body: (S + 1, 3) m/s, true velocity of the body at the images, in the body.
        gravity_body: (S + 1, 3) m/s², true gravity, which points down, in the body.
        vo: what a VO answered for the pairs, or None.
        recording: number of the recording in the split.
        start: number of the first image in the recording.
    """

    images: Image
    stamps_ns: Stamps
    T_prev_cur: Array
    imu: tuple[Array, ...]
    imu_time_s: tuple[Array, ...]
    intrinsics_px: Array
    T_body_cam: Array
    gravity: float
    velocity_body: Array
    gravity_body: Array
    vo: PairAnswers | None = None
    recording: int = 0
    start: int = 0

    @property
    def pairs(self) -> int:
        """S."""
        return len(self.T_prev_cur)


def cut_window(sequence: StoredSequence, start: int, pairs: int, recording: int = 0) -> TrainingWindow:
    """The window of ``pairs`` pairs that begins at image ``start``; its images are a copy."""
    stop = start + pairs + 1
    stamps = sequence.stamps_ns[start:stop].astype(np.int64)
    poses = sequence.T_world_cam[start:stop]
    answers = None if sequence.vo is None else sequence.vo.cut(start, stop - 1)
    return make_window(
        sequence,
        np.arange(start, stop),
        stamps,
        poses,
        samples_between(sequence.imu, stamps),
        answers,
        recording,
    )


def make_window(
    sequence: StoredSequence,
    numbers: Stamps,
    stamps_ns: Stamps,
    T_world_cam: Array,
    inertial: tuple[tuple[Array, ...], tuple[Array, ...]],
    vo: PairAnswers | None,
    recording: int,
) -> TrainingWindow:
    """A window of given images, with the truth that goes with the stamps it is told.

    Args:
        sequence: that it is cut from.
        numbers: (S + 1,) of its images.
        stamps_ns: (S + 1,) IMU clock, which may differ from those of the images.
        T_world_cam: (S + 1, 4, 4) true poses of camera 0 at these stamps.
        inertial: samples and their times of each pair, as :func:`samples_between` returns them.
        vo: what was answered for its pairs, or None.
        recording: number of the recording in the split.
    """
    samples, times = inertial
    velocity, gravity = states_in_body(sequence, stamps_ns, T_world_cam)
    return TrainingWindow(
        images=np.array(sequence.images[numbers]),
        stamps_ns=stamps_ns,
        T_prev_cur=se3.inverse(T_world_cam[:-1]) @ T_world_cam[1:],
        imu=samples,
        imu_time_s=times,
        intrinsics_px=sequence.camera.intrinsics_px,
        T_body_cam=sequence.camera.T_body_cam,
        gravity=sequence.gravity,
        velocity_body=velocity,
        gravity_body=gravity,
        vo=vo,
        recording=recording,
        start=int(numbers[0]),
    )


def states_in_body(sequence: StoredSequence, stamps_ns: Stamps, T_world_cam: Array) -> tuple[Array, Array]:
    """True velocity (K, 3) m/s and gravity (K, 3) m/s² in the body, at stamps and poses of the camera (K,…)."""
    truth = sequence.truth
    # Relative to the first before they become floats: absolute nanoseconds would lose digits.
    at_ns, known_ns = stamps_ns - stamps_ns[0], truth.stamps_ns - stamps_ns[0]
    v_world = np.stack([np.interp(at_ns, known_ns, axis) for axis in differentiate_positions(truth).T], axis=1)
    R_body_world = sequence.camera.T_body_cam[:3, :3] @ np.swapaxes(T_world_cam[:, :3, :3], 1, 2)
    return np.einsum("kij,kj->ki", R_body_world, v_world), -sequence.gravity * R_body_world[:, :, 2]


def samples_between(imu: ImuBlock | None, stamps_ns: Stamps) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    """Samples (N, 6) and times (N,) s of each pair of consecutive stamps (K,), one exactly at both, interpolated.

    Times are since the pair's first stamp. A pair that lies partly beyond the samples there are has N = 0.
    """
    pairs = len(stamps_ns) - 1
    nothing = np.zeros((0, 6)), np.zeros(0)
    if imu is None or len(imu) < 2:
        return (nothing[0],) * pairs, (nothing[1],) * pairs
    first, last = np.searchsorted(imu.stamps_ns, stamps_ns[[0, -1]])
    around = slice(max(int(first) - 1, 0), int(last) + 1)
    values = np.concatenate([imu.gyro[around], imu.accel[around]], axis=1)
    known_ns = imu.stamps_ns[around]
    if len(known_ns) < 2:
        return (nothing[0],) * pairs, (nothing[1],) * pairs
    # Relative to the window before they become floats: absolute nanoseconds would lose digits.
    known_s, at_s = (known_ns - stamps_ns[0]) / NANOSECONDS, (stamps_ns - stamps_ns[0]) / NANOSECONDS
    at_images = np.stack([np.interp(at_s, known_s, axis) for axis in values.T], axis=1)
    other = ~np.isin(known_ns, stamps_ns)
    known_s, values = known_s[other], values[other]
    places = np.searchsorted(known_s, at_s)
    values, time_s = np.insert(values, places, at_images, axis=0), np.insert(known_s, places, at_s)
    places = places + np.arange(len(places))
    covered = (stamps_ns >= known_ns[0]) & (stamps_ns <= known_ns[-1])
    samples, times = [], []
    for pair in range(pairs):
        block = slice(places[pair], places[pair + 1] + 1) if covered[pair] and covered[pair + 1] else slice(0)
        samples.append(values[block])
        times.append(time_s[block] - at_s[pair])
    return tuple(samples), tuple(times)


class WindowIndex:
    """All windows of some recordings, in order.

    Args:
        sequences: of one split.
        pairs: pairs of images in each window.
        split: what the recordings are for, for messages.

    Raises:
        ConfigError: ``pairs`` below 1.
        DataError: recordings whose images differ in size or colour; no window at all.
    """

    def __init__(self, sequences: Sequence[StoredSequence], pairs: int, *, split: str) -> None:
        if pairs < 1:
            raise ConfigError(f"trainer.pairs must be 1 or more, got {pairs}")
        shapes = {sequence.images.shape[1:]: sequence.name for sequence in sequences}
        if len(shapes) > 1:
            told = ", ".join(f"{name} has {shape[1]}×{shape[0]}×{shape[2]}" for shape, name in shapes.items())
            raise DataError(f"the recordings for {split} must all give images of one size, but {told}")
        self.sequences = tuple(sequences)
        self.pairs = pairs
        found = [sequence.starts(pairs) for sequence in sequences]
        self._recording = np.repeat(np.arange(len(found)), [len(starts) for starts in found])
        self._start = np.concatenate([*found, np.zeros(0, dtype=np.int64)])
        if len(self._start) == 0:
            told = ", ".join(f"{sequence.name} has {len(sequence)} images" for sequence in sequences) or "none is given"
            raise DataError(
                f"no window of {pairs + 1} consecutive images with known motion in the recordings for {split} "
                f"({told}): give longer ones, or a smaller trainer.pairs"
            )

    def __len__(self) -> int:
        return len(self._start)

    def __getitem__(self, index: int) -> TrainingWindow:
        sequence, start, recording = self.place(index)
        return cut_window(sequence, start, self.pairs, recording)

    def place(self, index: int) -> tuple[StoredSequence, int, int]:
        """Where a window is: recording, number of its first image, number of the recording."""
        recording = int(self._recording[index])
        return self.sequences[recording], int(self._start[index]), recording

    @property
    def shortest_run(self) -> int:
        """Pairs of images of the shortest unbroken run that holds a window."""
        return min(len(run) for run in self._runs()) + self.pairs - 1

    @property
    def longest_run(self) -> int:
        """Pairs of images of the longest unbroken run."""
        return max(len(run) for run in self._runs()) + self.pairs - 1

    def _runs(self) -> Iterator[np.ndarray]:
        """Numbers of the windows of each unbroken run of images."""
        for recording in range(len(self.sequences)):
            members = np.flatnonzero(self._recording == recording)
            runs = np.split(members, np.flatnonzero(np.diff(self._start[members]) != 1) + 1)
            yield from (run for run in runs if len(run))

    def tiled(self, advance: int) -> Self:
        """The windows that cover each unbroken run of images once, when each answers for its last ``advance`` pairs.

        The last window of a run is moved back so that it ends with it, and answers some pairs again.
        """
        kept = [int(number) for run in self._runs() for number in (*run[:-1:advance], run[-1])]
        other = object.__new__(type(self))
        other.sequences, other.pairs = self.sequences, self.pairs
        other._recording, other._start = self._recording[kept], self._start[kept]
        return other


def check_split(training: Sequence[str], validation: Sequence[str]) -> None:
    """Refuse a recording that is in both splits.

    Raises:
        ConfigError: with its name.
    """
    both = sorted(set(training) & set(validation))
    if both:
        raise ConfigError(
            f"training_data: {', '.join(both)} is both trained on and validated with: give each recording one purpose"
        )


def check_no_shared_images(training: Sequence[StoredSequence], validation: Sequence[StoredSequence]) -> None:
    """Refuse stretches of one recording that overlap.

    Raises:
        ConfigError: with their names.
    """
    for one, other in itertools.product(training, validation):
        # A stretch of a recording is called 06.0-90, the whole 06.
        same = one.name.partition(".")[0] == other.name.partition(".")[0]
        if same and np.intersect1d(one.stamps_ns, other.stamps_ns).size:
            raise ConfigError(
                f"training_data: {one.name}, which is trained on, and {other.name}, which is validated with, share "
                "images: give stretches that do not overlap"
            )
