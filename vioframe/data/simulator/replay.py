"""``dataset=replay``: the motion of a recording, seen again through simulated eyes.

The recording gives ground truth, frame stamps, calibration and, if wanted, its own inertial samples; the
images are drawn along a smooth motion fitted to the ground truth. This is how long runs with real motion
and real inertial noise are had where the images themselves are too large to ship.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Literal, get_args

import numpy as np

from vioframe.checks import Array
from vioframe.conventions import NANOSECONDS
from vioframe.data import agreement
from vioframe.data.recording import Dataset, Finding, Recording
from vioframe.data.simulator.cameras import CameraSettings
from vioframe.data.simulator.degrade import Degradations
from vioframe.data.simulator.drawn import DrawnRecording
from vioframe.data.simulator.fit import fit_spline, longest_covered
from vioframe.data.simulator.imu import ImuSettings, InertialSensor, join_stamps
from vioframe.data.simulator.plan import Place, PlannedMotion
from vioframe.data.simulator.spline import MotionState, SplineMotion
from vioframe.errors import ConfigError, DataError
from vioframe.types import Frame, ImuBlock, SensorRig, Trajectory

ImuSource = Literal["recorded", "simulated"]
PlaceChoice = Literal["auto", "room", "hall", "corridor", "street"]

# Motions that reach further than this are driven, not carried.
_INDOORS_M = 40.0


class ReplayDataset(Dataset):
    """Sequences of another data set, drawn anew.

    Args:
        source: the data set; its images are not used.
        imu: ``recorded``: the source's own samples; ``simulated``: exact samples of the fitted motion with the
            noise of ``imu_settings``.
        place: what is built around the motion; ``auto`` by its extent.
        cameras: cameras to draw, 1 or 2, with the calibration of the source.
        images: False yields frames without pixels.
        knot_s: time between control poses of the fitted motion; never shorter than the step of the truth.
        max_gap_s: a longer hole in the ground truth cannot be bridged; the longest stretch is replayed.
        start_s: what to leave out at the start of the covered stretch.
        duration_s: how much to replay; None for all.
        seed: of the world, of image noise and of simulated inertial noise.
        noise_dn: sensor noise of the images, grey values.
        rolling_shutter_s: first to last row.
        imu_settings: of the simulated sensor; None takes the densities and the rate of the source.
        degradations: what spoils the images.

    Raises:
        ConfigError: a value that cannot be.
    """

    def __init__(
        self,
        *,
        source: Dataset,
        imu: ImuSource = "recorded",
        place: PlaceChoice = "auto",
        cameras: int = 1,
        images: bool = True,
        knot_s: float = 0.05,
        max_gap_s: float = 0.3,
        start_s: float = 0.0,
        duration_s: float | None = None,
        seed: int = 0,
        noise_dn: float = 1.0,
        rolling_shutter_s: float = 0.0,
        imu_settings: ImuSettings | None = None,
        degradations: Degradations | None = None,
    ) -> None:
        if not isinstance(source, Dataset):
            raise ConfigError(f"dataset.source must be a data set, got {type(source).__name__}")
        if imu not in get_args(ImuSource):
            raise ConfigError(f"dataset.imu must be recorded or simulated, got {imu!r}")
        if place not in get_args(PlaceChoice):
            raise ConfigError(f"dataset.place must be one of {', '.join(get_args(PlaceChoice))}, got {place!r}")
        if cameras not in (1, 2):
            raise ConfigError(f"dataset.cameras must be 1 or 2, got {cameras}")
        if not knot_s > 0.0 or not max_gap_s > 0.0:
            raise ConfigError(f"dataset.knot_s and dataset.max_gap_s must be positive, got {knot_s} and {max_gap_s}")
        if not start_s >= 0.0:
            raise ConfigError(f"dataset.start_s must not be negative, got {start_s}")
        if duration_s is not None and not duration_s > 0.0:
            raise ConfigError(f"dataset.duration_s must be positive, got {duration_s}")
        if not isinstance(seed, int) or seed < 0:
            raise ConfigError(f"dataset.seed must be a whole number from 0, got {seed!r}")
        self._source = source
        self._imu = imu
        self._place = place
        self._cameras = cameras
        self._camera_settings = CameraSettings(noise_dn=noise_dn, rolling_shutter_s=rolling_shutter_s, images=images)
        self._knot_s = knot_s
        self._max_gap_s = max_gap_s
        self._start_s = start_s
        self._duration_s = duration_s
        self._seed = seed
        self._imu_settings = imu_settings
        self._degradations = degradations or Degradations()

    @property
    def sequences(self) -> Sequence[str]:
        """Those of the source."""
        return self._source.sequences

    def open(self, sequence: str) -> "ReplayRecording":
        """Fit the motion of one sequence.

        Raises:
            DataError: the source has no ground truth or no calibrated camera, or nothing is left to replay.
        """
        recording = self._source.open(sequence)
        truth = recording.ground_truth()
        if truth is None:
            raise DataError(f"{sequence}: a replay needs ground truth, and this recording has none")
        cameras = recording.rig.cameras
        if len(cameras) < self._cameras:
            raise DataError(
                f"{sequence}: a replay with {self._cameras} camera(s) needs their calibration, and the source has "
                f"that of {len(cameras)}: set dataset.source.cameras"
            )
        covered = longest_covered(truth, self._max_gap_s)
        begin_ns = int(covered.stamps_ns[0]) + round(self._start_s * NANOSECONDS)
        end_ns = int(covered.stamps_ns[-1])
        if self._duration_s is not None:
            end_ns = min(end_ns, begin_ns + round(self._duration_s * NANOSECONDS))
        step_s = float(np.median(np.diff(covered.stamps_ns))) / NANOSECONDS
        motion = fit_spline(covered, max(self._knot_s, step_s))
        rig = replace(recording.rig, cameras=cameras[: self._cameras])
        settings = self._imu_settings
        if settings is None:
            noise = rig.imu
            settings = ImuSettings(
                rate_hz=noise.rate_hz,
                gyro_noise=noise.gyro_noise,
                gyro_walk=noise.gyro_walk,
                accel_noise=noise.accel_noise,
                accel_walk=noise.accel_walk,
            )
        if self._imu == "simulated":
            rig = replace(rig, imu=settings.noise)
        return ReplayRecording(
            source=recording,
            rig=rig,
            plan=PlannedMotion(motion=motion, place=self._choose_place(motion)),
            origin_ns=int(covered.stamps_ns[0]),
            begin_ns=begin_ns,
            end_ns=end_ns,
            simulated=settings if self._imu == "simulated" else None,
            camera=self._camera_settings,
            degradations=self._degradations,
            seed=self._seed,
        )

    def _choose_place(self, motion: SplineMotion) -> Place:
        if self._place != "auto":
            return self._place
        extent = np.ptp(motion.positions, axis=0)
        if extent[:2].max() > _INDOORS_M:
            return "street"
        return "hall" if extent[2] > 2.0 or extent[:2].max() > 10.0 else "room"


class ReplayRecording(DrawnRecording):
    """One recording drawn anew; made by :class:`ReplayDataset`.

    Attributes:
        name: of the source's sequence.
        motion: fitted; its time zero is ``origin_ns``.

    Args:
        source: where inertial samples and frame stamps come from.
        rig: calibration of what is yielded.
        plan: motion and place.
        origin_ns: stamp of the motion's time zero, IMU clock.
        begin_ns, end_ns: what is replayed, IMU clock.
        simulated: inertial sensor, or None for the source's samples.
        camera: shutter, sensor noise, and whether to draw at all.
        degradations: what spoils the images.
        seed: of all that is random.
    """

    def __init__(
        self,
        *,
        source: Recording,
        rig: SensorRig,
        plan: PlannedMotion,
        origin_ns: int,
        begin_ns: int,
        end_ns: int,
        simulated: ImuSettings | None,
        camera: CameraSettings,
        degradations: Degradations,
        seed: int,
    ) -> None:
        # With a rolling shutter the last row, too, must lie on the motion.
        readout_ns = round(camera.rolling_shutter_s * NANOSECONDS)
        arrivals = [packet.stamp_ns + rig.camera_delay_ns for packet in source.packets() if isinstance(packet, Frame)]
        stamps = np.array(arrivals, dtype=np.int64)
        super().__init__(
            name=source.name,
            rig=rig,
            plan=plan,
            origin_ns=origin_ns,
            frames_ns=stamps[(stamps >= begin_ns) & (stamps <= end_ns - readout_ns)],
            camera=camera,
            degradations=degradations,
            seed=seed,
            world_seed=seed,
            duration_s=plan.motion.duration_s,
        )
        self._source = source
        self._span_ns = begin_ns, end_ns
        self._simulated = simulated
        if self.frame_count < 2:
            raise DataError(
                f"{source.name}: fewer than two frames lie within the replayed part of the ground truth "
                f"({begin_ns}…{end_ns} ns): check dataset.start_s and dataset.duration_s"
            )

    def _blocks(self) -> Iterator[ImuBlock]:
        begin_ns, end_ns = self._span_ns
        if self._simulated is not None:
            yield from (samples.block for samples in self._sensor(self._simulated).stream())
            return
        for packet in self._source.packets():
            if not isinstance(packet, ImuBlock):
                continue
            inside = (packet.stamps_ns >= begin_ns) & (packet.stamps_ns <= end_ns)
            if inside.all():
                yield packet
            elif inside.any():
                yield ImuBlock(stamps_ns=packet.stamps_ns[inside], gyro=packet.gyro[inside], accel=packet.accel[inside])

    def _sensor(self, settings: ImuSettings) -> InertialSensor:
        begin_ns, end_ns = self._span_ns
        return InertialSensor(
            settings,
            motion=_Shifted(self.motion, float(self.elapsed_s(begin_ns))),
            gravity=self._rig.gravity,
            start_ns=begin_ns,
            duration_s=(end_ns - begin_ns) / NANOSECONDS,
            seed=self._seed,
        )

    def ground_truth(self) -> Trajectory:
        """The fitted motion at 200 Hz and at every frame."""
        begin_ns, end_ns = self._span_ns
        grid = np.arange(begin_ns, end_ns + 1, NANOSECONDS // 200, dtype=np.int64)
        stamps = join_stamps(grid, self._frames_ns, apart_ns=NANOSECONDS // 1000)
        state = self.motion.evaluate(self.elapsed_s(stamps))
        return Trajectory(stamps_ns=stamps, T_world_body=state.T_world_body, v_world_body=state.velocity)

    def findings(self) -> list[Finding]:
        """Those of the source, and how well the fitted motion agrees with its inertial samples."""
        found = list(self._source.findings())
        begin_ns, end_ns = self._span_ns
        text = (
            f"{(end_ns - begin_ns) / NANOSECONDS:.1f} s of ground truth drawn anew in a {self._plan.place}, "
            f"{self.frame_count} frames"
        )
        found.append(Finding(level="note", subject="replay", text=text))
        measured, fitted = self._mean_rates()
        if not agreement.turns_enough(fitted):
            text = "too little to compare the gyro with"
            return [*found, Finding(level="note", subject="replayed rotation", text=text)]
        values = agreement.correlations(measured, fitted)
        text = "gyro and fitted motion correlate by " + ", ".join(f"{value:.4f}" for value in values)
        # Axes about which the body hardly turns show the noise of the truth.
        if values[np.argmax(fitted.std(axis=0))] > 0.9:
            return [*found, Finding(level="good", subject="replayed rotation", text=text)]
        text += "; check clocks and axes of the recording"
        return [*found, Finding(level="bad", subject="replayed rotation", text=text)]

    def agreement(self, window_s: float = 0.1) -> tuple[float, float, float]:
        """Correlation, by axis, of the recorded gyro with the rate of the fitted motion, as means over ``window_s``.

        Averaging leaves out vibration, which no ground truth follows.
        """
        first, second, third = (float(value) for value in agreement.correlations(*self._mean_rates(window_s)))
        return first, second, third

    def _mean_rates(self, window_s: float = 0.1) -> tuple[Array, Array]:
        """Rates (M, 3) rad/s of the recorded gyro and of the fitted motion, means over ``window_s``."""
        begin_ns, end_ns = self._span_ns
        blocks = [packet for packet in self._source.packets() if isinstance(packet, ImuBlock)]
        stamps = np.concatenate([block.stamps_ns for block in blocks])
        gyro = np.concatenate([block.gyro for block in blocks])
        inside = (stamps >= begin_ns) & (stamps <= end_ns)
        stamps, gyro = stamps[inside], gyro[inside]
        rate = self.exact_imu(stamps).gyro
        cell = ((stamps - begin_ns) // round(window_s * NANOSECONDS)).astype(np.int64)
        _, cell = np.unique(cell, return_inverse=True)
        count = np.bincount(cell)
        measured, fitted = (
            np.stack([np.bincount(cell, values[:, axis]) / count for axis in range(3)], axis=1)
            for values in (gyro, rate)
        )
        return measured, fitted

    def counters(self) -> Mapping[str, int]:
        """Dropped frames."""
        return {"dropped frames": self._dropped} if self._dropped else {}


class _Shifted:
    """A motion whose time zero is later."""

    def __init__(self, motion: SplineMotion, offset_s: float) -> None:
        self._motion = motion
        self._offset_s = offset_s

    @property
    def duration_s(self) -> float:
        """What is left, s."""
        return self._motion.duration_s - self._offset_s

    def evaluate(self, t_s: Array | float) -> MotionState:
        """State at times (...) in s after the new zero."""
        return self._motion.evaluate(np.asarray(t_s) + self._offset_s)
