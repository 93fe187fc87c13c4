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

from vioframe.conventions import NANOSECONDS
from vioframe.data.exposure import ExposedFrame
from vioframe.data.inertial_damage import AXES, InertialDamage, Intervals, within
from vioframe.data.recording import Dataset, Finding, Recording
from vioframe.errors import ConfigError
from vioframe.geometry import so3
from vioframe.types import Frame, ImuBlock, Packet, SensorRig, Trajectory

Vector = tuple[float, float, float]

_GREY = 128
# Where jitter would bring a stamp to or before the one before it, it comes this much after.
_LEAST_STEP_NS = 1_000_000
_AXIS_STREAM = 6
_RANDOM = ("stamp_jitter_s", "rotation_random_deg", "dropped_frames", "missing_samples", "imu_gap_s")


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
        rotation_random_deg: angle of a further such rotation, about an axis that is drawn.
        position_m: in the body, from the cameras' true place to the one that the calibration tells.
        camera_lost_s: intervals without images.
        dropped_frames: 0…1, share of the images that never arrive.
        blank_images_s: intervals in which every pixel is of one grey.
        imu_lost_s: intervals without inertial samples.
        imu_gap_s: length of holes in the inertial samples that come again and again, at drawn instants.
        imu_gap_every_s: mean time from the start of one to that of the next; the first so much time has none.
        missing_samples: 0…1, share of the inertial samples that never arrive.
        imu_noise: factor on all noise densities of the rig, white noise and walk of the biases; what is missing to it
            is added. The rig goes on telling the old ones.
        gyro_limit: rad/s, end of the gyro's range an axis; 0 for none.
        imu_axes: which axis of the body each delivered axis reads, such as [y, -x, z].
        accel_negated: the accelerometer reads −g at rest.
    """

    seed: int = 0
    time_offset_s: float = 0.0
    stamp_jitter_s: float = 0.0
    rotation_deg: Vector = (0.0, 0.0, 0.0)
    rotation_random_deg: float = 0.0
    position_m: Vector = (0.0, 0.0, 0.0)
    camera_lost_s: Intervals = ()
    dropped_frames: float = 0.0
    blank_images_s: Intervals = ()
    imu_lost_s: Intervals = ()
    imu_gap_s: float = 0.0
    imu_gap_every_s: float = 5.0
    missing_samples: float = 0.0
    imu_noise: float = 1.0
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
        for name in ("stamp_jitter_s", "rotation_random_deg", "imu_gap_s", "gyro_limit", "seed"):
            if not getattr(self, name) >= 0:
                raise ConfigError(f"faults.{name} must not be negative, got {getattr(self, name)}")
        for name in ("dropped_frames", "missing_samples"):
            if not 0.0 <= getattr(self, name) < 1.0:
                raise ConfigError(f"faults.{name} must be a share from 0 to below 1, got {getattr(self, name)}")
        if not self.imu_gap_s < self.imu_gap_every_s:
            raise ConfigError(
                f"faults.imu_gap_s={self.imu_gap_s} must be shorter than faults.imu_gap_every_s={self.imu_gap_every_s}"
            )
        if not 1.0 <= self.imu_noise < float("inf"):
            raise ConfigError(f"faults.imu_noise must be 1 or more, got {self.imu_noise}: noise cannot be taken away")
        if not abs(self.time_offset_s) <= 10.0:
            raise ConfigError(f"faults.time_offset_s must lie within ±10 s, got {self.time_offset_s}")

    def describe(self) -> tuple[str, ...]:
        """Each fault that is on, as one would switch it on, with the seed where chance plays a part."""
        on = []
        for field in fields(self):
            value = getattr(self, field.name)
            # How often there are gaps says nothing where there are none.
            told = field.name != "seed" and (field.name != "imu_gap_every_s" or self.imu_gap_s)
            if told and value != field.default:
                on.append(f"{field.name}={_as_yaml(value)}")
        if self.seed and (self.imu_noise > 1.0 or any(getattr(self, name) for name in _RANDOM)):
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
        self._rig = _told(recording.rig, faults, recording.name)
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

    def seen_truth(self) -> Trajectory | None:
        """Poses of a body on which the cameras sit where they are told to, and see what the true ones see."""
        truth, true_rig = self._recording.seen_truth(), self._recording.rig
        if truth is None or self._rig is true_rig:
            return truth
        T_told_true = true_rig.cameras[0].T_body_cam @ np.linalg.inv(self._rig.cameras[0].T_body_cam)
        return Trajectory(stamps_ns=truth.stamps_ns, T_world_body=truth.T_world_body @ T_told_true)

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
        damage = _Damage(self._faults, self._recording.name, self._recording.rig, self._counts)
        for packet in self._recording.packets():
            spoilt = damage.of_frame(packet) if isinstance(packet, Frame) else damage.of_samples(packet)
            if spoilt is not None:
                yield spoilt


class _Damage:
    """What happens to the packets of one pass; each kind draws from a stream of its own."""

    def __init__(self, faults: Faults, name: str, rig: SensorRig, counts: Counter[str]) -> None:
        key = zlib.crc32(name.encode())
        self._jitter, self._drops = (np.random.default_rng((faults.seed, key, k)) for k in range(2))
        self._faults = faults
        self._delay_ns = rig.camera_delay_ns
        self._counts = counts
        self._first_ns: int | None = None
        self._last_ns: int | None = None
        self._samples = InertialDamage(
            lost_s=faults.imu_lost_s,
            gap_s=faults.imu_gap_s,
            gap_every_s=faults.imu_gap_every_s,
            missing=faults.missing_samples,
            noise=faults.imu_noise,
            gyro_limit=faults.gyro_limit,
            axes=faults.imu_axes,
            accel_negated=faults.accel_negated,
            densities=rig.imu,
            seed=(faults.seed, key),
            counts=counts,
        )

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
        if within(faults.camera_lost_s, now, self._first_ns)[0]:
            self._counts["frames lost with the camera"] += 1
            return None
        if dropped:
            self._counts["dropped frames"] += 1
            return None
        images = frame.images
        if within(faults.blank_images_s, now, self._first_ns)[0]:
            images = tuple(np.full_like(image, _GREY) for image in images)
            self._counts["blank frames"] += 1
        stamp_ns = frame.stamp_ns + round((jitter_s - faults.time_offset_s) * NANOSECONDS)
        if faults.stamp_jitter_s and self._last_ns is not None:
            stamp_ns = max(stamp_ns, self._last_ns + _LEAST_STEP_NS)
        self._last_ns = stamp_ns
        return ExposedFrame(stamp_ns=stamp_ns, images=images, exposed_ns=true_ns)

    def of_samples(self, block: ImuBlock) -> ImuBlock | None:
        """The samples that arrive, as they read, or None."""
        return self._samples.of(block, self._first_ns)


def _told(rig: SensorRig, faults: Faults, name: str) -> SensorRig:
    """The calibration that the estimators see."""
    if not rig.cameras or not (any(faults.rotation_deg) or faults.rotation_random_deg or any(faults.position_m)):
        return rig
    axis = np.random.default_rng((faults.seed, zlib.crc32(name.encode()), _AXIS_STREAM)).standard_normal(3)
    drawn = np.radians(faults.rotation_random_deg) * axis / np.linalg.norm(axis)
    T_body_cam0 = rig.cameras[0].T_body_cam
    turn = np.eye(4)
    turn[:3, :3] = so3.exp(np.radians(faults.rotation_deg)) @ so3.exp(drawn)
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
    if len(names) != 3 or {axis.removeprefix("-") for axis in names} != {"x", "y", "z"} or not set(names) <= set(AXES):
        raise ConfigError(f"faults.imu_axes must hold x, y and z once each, with or without a minus, got {value}")
    return names


def _as_yaml(value: object) -> str:
    if isinstance(value, tuple):
        return f"[{','.join(_as_yaml(part) for part in value)}]"
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(value)
