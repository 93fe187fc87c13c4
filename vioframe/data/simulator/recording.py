"""One simulated sequence, streamed: nothing longer than about a second is ever held."""

from collections.abc import Iterator, Mapping

import numpy as np

from vioframe.conventions import GRAVITY, NANOSECONDS
from vioframe.data.recording import Finding
from vioframe.data.simulator.cameras import CameraSettings
from vioframe.data.simulator.degrade import Degradations
from vioframe.data.simulator.drawn import DrawnRecording
from vioframe.data.simulator.imu import ImuSamples, ImuSettings, InertialSensor, join_stamps
from vioframe.data.simulator.plan import PlannedMotion
from vioframe.types import ImuBlock, SensorRig, Trajectory

START_NS = 1_700_000_000 * NANOSECONDS
"""Stamp of time zero: as long as a real clock's, so that stamps kept as floats show."""


class SimulatedRecording(DrawnRecording):
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
        camera = camera or CameraSettings()
        degradations = degradations or Degradations()
        self._imu = imu or ImuSettings()
        rate_hz = camera.frame_rate_hz(kit)
        index = np.arange(int(np.floor(duration_s * rate_hz + 1e-6)) + 1)
        super().__init__(
            name=name,
            rig=SensorRig(
                cameras=camera.build(kit),
                imu=self._imu.noise,
                gravity=gravity,
                camera_delay_ns=round(camera.delay_s * NANOSECONDS),
            ),
            plan=plan,
            origin_ns=START_NS,
            frames_ns=START_NS + np.round(index * (NANOSECONDS / rate_hz)).astype(np.int64),
            camera=camera,
            degradations=degradations,
            seed=seed,
            world_seed=seed if world_seed is None else world_seed,
            duration_s=duration_s,
        )

    def _blocks(self) -> Iterator[ImuBlock]:
        return (samples.block for samples in self.samples())

    def samples(self) -> Iterator[ImuSamples]:
        """The inertial samples with the biases that they hide."""
        return self._sensor().stream()

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
