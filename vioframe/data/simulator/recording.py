"""One simulated sequence, streamed: nothing longer than about a second is ever held."""

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np

from vioframe.checks import Array, Stamps
from vioframe.conventions import GRAVITY, NANOSECONDS
from vioframe.data.recording import Finding, Recording
from vioframe.data.simulator.cameras import CameraSettings
from vioframe.data.simulator.degrade import Degradations
from vioframe.data.simulator.families import PlannedMotion
from vioframe.data.simulator.imu import BlockCutter, ImuSamples, ImuSettings, InertialSensor, exact_imu, join_stamps
from vioframe.types import Frame, ImuBlock, Packet, SensorRig, Trajectory

if TYPE_CHECKING:
    from vioframe.data.simulator.imaging import Imager

START_NS = 1_700_000_000 * NANOSECONDS
"""Stamp of time zero: as long as a real clock's, so that stamps kept as floats show."""


class SimulatedRecording(Recording):
    """A motion, sampled by an inertial sensor and seen by cameras.

    Args:
        name: of the sequence.
        plan: motion and place.
        seed: of everything random: sensors, world and degradations.
        duration_s: length.
        kit: camera kit where ``camera.kit`` is ``auto``.
        camera: cameras.
        imu: inertial sensor.
        degradations: what spoils the images.
        gravity: magnitude, m/s².
        world_seed: of the place alone; the sequence's seed by default.
    """

    def __init__(
        self,
        *,
        name: str,
        plan: PlannedMotion,
        seed: int,
        duration_s: float,
        kit: str = "euroc",
        camera: CameraSettings | None = None,
        imu: ImuSettings | None = None,
        degradations: Degradations | None = None,
        gravity: float = GRAVITY,
        world_seed: int | None = None,
    ) -> None:
        self.name = name
        self.motion = plan.motion
        self._plan = plan
        self._seed = seed
        self._world_seed = seed if world_seed is None else world_seed
        self._duration_s = duration_s
        self._camera = camera or CameraSettings()
        self._imu = imu or ImuSettings()
        self._degradations = degradations or Degradations()
        delay_ns = round(self._camera.delay_s * NANOSECONDS)
        self._rig = SensorRig(
            cameras=self._camera.build(kit),
            imu=self._imu.noise,
            gravity=gravity,
            camera_delay_ns=delay_ns,
            has_images=self._camera.images,
        )
        rate_hz = self._camera.frame_rate_hz(kit)
        index = np.arange(int(np.floor(duration_s * rate_hz + 1e-6)) + 1)
        kept = ~self._degradations.dropped(len(index), seed)
        self._dropped = int(np.count_nonzero(~kept))
        since_start_ns = np.round(index * (NANOSECONDS / rate_hz)).astype(np.int64)
        self._frames_ns: Stamps = START_NS + since_start_ns[kept]
        self._imager: Imager | None = None

    @property
    def rig(self) -> SensorRig:
        """Calibration."""
        return self._rig

    @property
    def frame_count(self) -> int:
        """Number of frames, without the dropped ones."""
        return len(self._frames_ns)

    @property
    def frame_stamps_ns(self) -> Stamps:
        """Instants (N,) at which the frames see the world, IMU clock."""
        return self._frames_ns

    @property
    def duration_s(self) -> float:
        """Seconds from the first to the last frame."""
        return float(self._frames_ns[-1] - self._frames_ns[0]) / NANOSECONDS

    @property
    def imager(self) -> "Imager":
        """Draws the frames; made when first asked for, since a world takes a second to build."""
        if self._imager is None:
            from vioframe.data.simulator.imaging import Imager

            self._imager = Imager(
                plan=self._plan,
                cameras=self._rig.cameras,
                settings=self._camera,
                degradations=self._degradations,
                seed=self._seed,
                world_seed=self._world_seed,
                duration_s=self._duration_s,
            )
        return self._imager

    def elapsed_s(self, stamps_ns: Stamps) -> Array:
        """Time (N,) in s on the motion of stamps on the IMU clock."""
        return (stamps_ns - START_NS) / NANOSECONDS

    def packets(self) -> Iterator[Packet]:
        """Stream the packets from the start: an image arrives after the inertial samples that precede it."""
        cutter = BlockCutter(samples.block for samples in self.samples())
        for stamp_ns in self._frames_ns:
            yield from cutter.until(int(stamp_ns))
            images = self.imager.images(float(self.elapsed_s(stamp_ns))) if self._camera.images else ()
            yield Frame(stamp_ns=int(stamp_ns) - self._rig.camera_delay_ns, images=images)
        yield from cutter.until(None)

    def samples(self) -> Iterator[ImuSamples]:
        """The inertial samples with the biases that they hide."""
        return self._sensor().stream()

    def exact_imu(self, stamps_ns: Stamps) -> ImuBlock:
        """What a perfect sensor would read at these stamps."""
        gyro, accel = exact_imu(self.motion, self.elapsed_s(stamps_ns), self._rig.gravity)
        return ImuBlock(stamps_ns=stamps_ns, gyro=gyro, accel=accel)

    def ground_truth(self) -> Trajectory:
        """Exact poses and velocities at the rate of the IMU and at every frame."""
        rate_hz = max(self._imu.rate_hz, 100.0)
        count = int(np.floor(self._duration_s * rate_hz + 1e-6)) + 1
        grid = START_NS + np.round(np.arange(count) * (NANOSECONDS / rate_hz)).astype(np.int64)
        # A pose a hair from another would spoil whoever differentiates.
        stamps = join_stamps(grid, self._frames_ns, apart_ns=int(0.2 * NANOSECONDS / rate_hz))
        T_world_body = np.empty((len(stamps), 4, 4))
        velocity = np.empty((len(stamps), 3))
        for begin in range(0, len(stamps), 20_000):
            part = slice(begin, begin + 20_000)
            state = self.motion.evaluate(self.elapsed_s(stamps[part]))
            T_world_body[part], velocity[part] = state.T_world_body, state.velocity
        return Trajectory(stamps_ns=stamps, T_world_body=T_world_body, v_world_body=velocity)

    def findings(self) -> list[Finding]:
        """What is in this simulated sequence."""
        width, height = self._rig.cameras[0].size_px
        holes = self._sensor().gaps()
        found = [
            Finding(
                level="good",
                subject="camera",
                text=f"{len(self._rig.cameras)} × {self._rig.cameras[0].model} {width}×{height}, "
                f"{self.frame_count} frames in {self.duration_s:.1f} s",
            ),
            Finding(level="good", subject="imu rate", text=f"{self._imu.rate_hz:g} Hz"),
        ]
        if len(holes):
            found.append(Finding(level="note", subject="imu gaps", text=f"{len(holes)} simulated holes"))
        if self._dropped:
            found.append(Finding(level="note", subject="frames", text=f"{self._dropped} frames dropped on purpose"))
        return found

    def counters(self) -> Mapping[str, int]:
        """Dropped frames and holes in the inertial samples."""
        counted = {"dropped frames": self._dropped, "imu gaps": len(self._sensor().gaps())}
        return {name: count for name, count in counted.items() if count}

    def _sensor(self) -> InertialSensor:
        return InertialSensor(
            self._imu,
            motion=self.motion,
            gravity=self._rig.gravity,
            start_ns=START_NS,
            duration_s=self._duration_s,
            seed=self._seed,
        )
