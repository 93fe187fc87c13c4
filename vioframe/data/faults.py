"""Faults injected on purpose between a recording and the pipeline, to see what a system makes of them.

They are of the kinds that real rigs have: a clock that is off, a camera told to sit elsewhere than it does, a cable
that comes loose, an axis mixed up in a driver. The calibration and the data disagree then, and nobody tells the
estimator; the protocol of every number does.
"""

import zlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from vioframe.checks import Array, Mask, Stamps
from vioframe.conventions import NANOSECONDS
from vioframe.data.recording import Dataset, Finding, Recording
from vioframe.errors import ConfigError
from vioframe.geometry import so3
from vioframe.types import Frame, ImuBlock, Packet, SensorRig, Trajectory

Vector = tuple[float, float, float]
Intervals = tuple[tuple[float, float], ...]

_AXES = {"x": (0, 1.0), "y": (1, 1.0), "z": (2, 1.0), "-x": (0, -1.0), "-y": (1, -1.0), "-z": (2, -1.0)}
_GREY = 128
# Where jitter would bring a stamp to or before the one before it, it comes this much after.
_LEAST_STEP_NS = 1_000_000
_RANDOM = ("stamp_jitter_s", "dropped_frames", "missing_samples")


@dataclass(frozen=True, slots=True, kw_only=True)
class Faults:
    """Which faults are injected; the group ``faults`` of the configuration. All are off by default.

    Intervals are pairs [start, length] in s, from the first image on; a length of ``inf`` never ends.

    Attributes:
        seed: of all that is random.
        time_offset_s: the camera's true delay exceeds what the calibration tells by this much: with it,
            ``t_imu = t_cam + rig.camera_delay + time_offset``.
        stamp_jitter_s: standard deviation of the error of each image's stamp; the order of images stays.
        rotation_deg: rotation vector, in camera 0, from its true orientation to the one that the calibration tells.
            All cameras turn together about camera 0.
        position_m: in the body, from the cameras' true place to the one that the calibration tells.
        camera_lost_s: intervals without images.
        dropped_frames: 0…1, share of the images that never arrive.
        blank_images_s: intervals in which every pixel is of one grey.
        imu_lost_s: intervals without inertial samples.
        missing_samples: 0…1, share of the inertial samples that never arrive.
        gyro_limit: rad/s, end of the gyro's range an axis; 0 for none.
        imu_axes: which axis of the body each delivered axis reads, such as [y, -x, z].
        accel_negated: the accelerometer reads −g at rest.
    """

    seed: int = 0
    time_offset_s: float = 0.0
    stamp_jitter_s: float = 0.0
    rotation_deg: Vector = (0.0, 0.0, 0.0)
    position_m: Vector = (0.0, 0.0, 0.0)
    camera_lost_s: Intervals = ()
    dropped_frames: float = 0.0
    blank_images_s: Intervals = ()
    imu_lost_s: Intervals = ()
    missing_samples: float = 0.0
    gyro_limit: float = 0.0
    imu_axes: tuple[str, str, str] = ("x", "y", "z")
    accel_negated: bool = False

    def __post_init__(self) -> None:
        # A list out of a YAML file becomes the tuple that the annotation promises.
        for name in ("rotation_deg", "position_m"):
            object.__setattr__(self, name, _checked_vector(name, getattr(self, name)))
        for name in ("camera_lost_s", "blank_images_s", "imu_lost_s"):
            object.__setattr__(self, name, _checked_intervals(name, getattr(self, name)))
        object.__setattr__(self, "imu_axes", _checked_axes(self.imu_axes))
        for name in ("stamp_jitter_s", "gyro_limit", "seed"):
            if not getattr(self, name) >= 0:
                raise ConfigError(f"faults.{name} must not be negative, got {getattr(self, name)}")
        for name in ("dropped_frames", "missing_samples"):
            if not 0.0 <= getattr(self, name) < 1.0:
                raise ConfigError(f"faults.{name} must be a share from 0 to below 1, got {getattr(self, name)}")
        if not abs(self.time_offset_s) <= 10.0:
            raise ConfigError(f"faults.time_offset_s must lie within ±10 s, got {self.time_offset_s}")

    def describe(self) -> tuple[str, ...]:
        """Each fault that is on, as one would switch it on, with the seed where chance plays a part."""
        on = []
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name != "seed" and value != field.default:
                on.append(f"{field.name}={_as_yaml(value)}")
        if self.seed and any(getattr(self, name) for name in _RANDOM):
            on.append(f"seed={self.seed}")
        return tuple(on)

    def inject(self, dataset: Dataset) -> Dataset:
        """The data set with these faults; itself where none is on."""
        return FaultyDataset(dataset, self) if self.describe() else dataset


class FaultyDataset(Dataset):
    """A data set whose recordings have faults.

    Args:
        dataset: as it is.
        faults: what to do to it.
    """

    def __init__(self, dataset: Dataset, faults: Faults) -> None:
        self._dataset = dataset
        self._faults = faults

    @property
    def sequences(self) -> Sequence[str]:
        """Those of the data set."""
        return self._dataset.sequences

    def open(self, sequence: str) -> Recording:
        """Open and check one sequence, then spoil it."""
        return FaultyRecording(self._dataset.open(sequence), self._faults)


class FaultyRecording(Recording):
    """A recording with faults; its truth is still the truth.

    Attributes:
        name: of the sequence.

    Args:
        recording: as it is.
        faults: what to do to it.
    """

    def __init__(self, recording: Recording, faults: Faults) -> None:
        self.name = recording.name
        self._recording = recording
        self._faults = faults
        self._rig = _told(recording.rig, faults)
        self._counts: Counter[str] = Counter()

    @property
    def rig(self) -> SensorRig:
        """Calibration as it is told, which may be wrong."""
        return self._rig

    @property
    def frame_count(self) -> int:
        """Frames of the recording before any was lost, so that completion shows what the loss cost."""
        return self._recording.frame_count

    @property
    def duration_s(self) -> float:
        """Seconds from the first to the last frame of the recording as it is."""
        return self._recording.duration_s

    def ground_truth(self) -> Trajectory | None:
        """True poses of the body, which no fault touches."""
        return self._recording.ground_truth()

    def findings(self) -> list[Finding]:
        """Those of the recording as it is, and the faults."""
        text = f"{', '.join(self.faults())}; everything else said here is of the recording without them"
        return [*self._recording.findings(), Finding(level="note", subject="injected faults", text=text)]

    def faults(self) -> tuple[str, ...]:
        """Each fault that is on."""
        return (*self._recording.faults(), *self._faults.describe())

    def counters(self) -> Mapping[str, int]:
        """Those of the recording, and what was injected since :meth:`packets` began."""
        counted = {f"injected: {name}": count for name, count in self._counts.items() if count}
        return {**self._recording.counters(), **counted}

    def packets(self) -> Iterator[Packet]:
        """Stream from the start, spoilt in the same way each time."""
        self._counts.clear()
        damage = _Damage(self._faults, self._recording.name, self._recording.rig.camera_delay_ns, self._counts)
        for packet in self._recording.packets():
            spoilt = damage.of_frame(packet) if isinstance(packet, Frame) else damage.of_samples(packet)
            if spoilt is not None:
                yield spoilt


class _Damage:
    """What happens to the packets of one pass; each kind draws from a stream of its own."""

    def __init__(self, faults: Faults, name: str, delay_ns: int, counts: Counter[str]) -> None:
        key = zlib.crc32(name.encode())
        self._jitter, self._drops, self._misses = (np.random.default_rng((faults.seed, key, k)) for k in range(3))
        self._faults = faults
        self._delay_ns = delay_ns
        self._counts = counts
        self._first_ns: int | None = None
        self._last_ns: int | None = None
        columns, signs = zip(*(_AXES[axis] for axis in faults.imu_axes), strict=True)
        self._columns, self._signs = list(columns), np.array(signs)

    def of_frame(self, frame: Frame) -> Frame | None:
        """The frame as it arrives, or None."""
        faults = self._faults
        true_ns = frame.stamp_ns + self._delay_ns
        if self._first_ns is None:
            self._first_ns = true_ns
        # Both are drawn for every frame, so that a loss does not change which of the others are lost.
        dropped = self._drops.random() < faults.dropped_frames
        jitter_s = faults.stamp_jitter_s * float(self._jitter.standard_normal())
        now = np.array([true_ns])
        if self._within(faults.camera_lost_s, now)[0]:
            self._counts["frames lost with the camera"] += 1
            return None
        if dropped:
            self._counts["dropped frames"] += 1
            return None
        images = frame.images
        if self._within(faults.blank_images_s, now)[0]:
            images = tuple(np.full_like(image, _GREY) for image in images)
            self._counts["blank frames"] += 1
        stamp_ns = frame.stamp_ns + round((jitter_s - faults.time_offset_s) * NANOSECONDS)
        if faults.stamp_jitter_s and self._last_ns is not None:
            stamp_ns = max(stamp_ns, self._last_ns + _LEAST_STEP_NS)
        self._last_ns = stamp_ns
        return Frame(stamp_ns=stamp_ns, images=images)

    def of_samples(self, block: ImuBlock) -> ImuBlock | None:
        """The samples that arrive, as they read, or None."""
        faults = self._faults
        lost = self._within(faults.imu_lost_s, block.stamps_ns)
        missing = (self._misses.random(len(block)) < faults.missing_samples) & ~lost
        self._counts["samples lost with the IMU"] += int(lost.sum())
        self._counts["missing samples"] += int(missing.sum())
        kept = ~(lost | missing)
        gyro = self._turned(block.gyro[kept])
        if faults.gyro_limit:
            beyond = np.abs(gyro) > faults.gyro_limit
            self._counts["saturated samples"] += int(beyond.any(axis=1).sum())
            gyro = np.clip(gyro, -faults.gyro_limit, faults.gyro_limit)
        accel = self._turned(block.accel[kept])
        accel = -accel if faults.accel_negated else accel
        return ImuBlock(stamps_ns=block.stamps_ns[kept], gyro=gyro, accel=accel) if kept.any() else None

    def _turned(self, values: Array) -> Array:
        turned: Array = values[:, self._columns] * self._signs
        return turned

    def _within(self, intervals: Intervals, stamps_ns: Stamps) -> Mask:
        """Which stamps (N,), IMU clock, lie in an interval; none before the first image has come."""
        inside: Mask = np.zeros(len(stamps_ns), dtype=bool)
        if self._first_ns is not None:
            elapsed = (stamps_ns - self._first_ns) / NANOSECONDS
            for start, length in intervals:
                inside |= (elapsed >= start) & (elapsed < start + length)
        return inside


def _told(rig: SensorRig, faults: Faults) -> SensorRig:
    """The calibration that the estimators see."""
    if not rig.cameras or not (any(faults.rotation_deg) or any(faults.position_m)):
        return rig
    T_body_cam0 = rig.cameras[0].T_body_cam
    turn = np.eye(4)
    turn[:3, :3] = so3.exp(np.radians(faults.rotation_deg))
    # The error in the body's frame: what it makes of camera 0 it makes of the others, so the pair stays calibrated.
    error = T_body_cam0 @ turn @ np.linalg.inv(T_body_cam0)
    error[:3, 3] += faults.position_m
    cameras = tuple(replace(camera, T_body_cam=error @ camera.T_body_cam) for camera in rig.cameras)
    return replace(rig, cameras=cameras)


def _checked_vector(name: str, value: Sequence[float]) -> Vector:
    values = tuple(float(part) for part in value) if isinstance(value, list | tuple) else ()
    if len(values) != 3 or not np.isfinite(values).all():
        raise ConfigError(f"faults.{name} must be three numbers [x, y, z], got {value}")
    return values


def _checked_intervals(name: str, value: Sequence[Sequence[float]]) -> Intervals:
    good = isinstance(value, list | tuple) and all(isinstance(pair, list | tuple) and len(pair) == 2 for pair in value)
    if not good or not all(start >= 0.0 and length > 0.0 for start, length in value):
        raise ConfigError(
            f"faults.{name} must be a list of pairs [start, length] in s with start ≥ 0 and length > 0, such as "
            f"[[10, 1]], got {value}"
        )
    return tuple((float(start), float(length)) for start, length in value)


def _checked_axes(value: Sequence[str]) -> tuple[str, str, str]:
    # YAML 1.1 reads a bare y as text in Hydra, but as true elsewhere.
    names = tuple(str(axis) for axis in value) if isinstance(value, list | tuple) else ()
    if len(names) != 3 or {axis.removeprefix("-") for axis in names} != {"x", "y", "z"} or not set(names) <= set(_AXES):
        raise ConfigError(f"faults.imu_axes must hold x, y and z once each, with or without a minus, got {value}")
    return names


def _as_yaml(value: object) -> str:
    if isinstance(value, tuple):
        return f"[{','.join(_as_yaml(part) for part in value)}]"
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(value)
