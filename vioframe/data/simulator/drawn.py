"""What a simulated sequence and a replayed one have in common: stamps of frames that are drawn along a motion."""

from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from vioframe.checks import Array, Mask, Stamps
from vioframe.conventions import NANOSECONDS
from vioframe.data.recording import Recording
from vioframe.data.simulator.cameras import CameraSettings
from vioframe.data.simulator.degrade import Degradations
from vioframe.data.simulator.imu import BlockCutter, exact_imu
from vioframe.data.simulator.plan import PlannedMotion
from vioframe.types import Frame, ImuBlock, Packet, SensorRig

if TYPE_CHECKING:
    from vioframe.data.simulator.imaging import Imager


class DrawnRecording(Recording):
    """Frames drawn along a motion, among inertial samples that a subclass has.

    Attributes:
        name: of the sequence.
        motion: of the body.

    Args:
        name: of the sequence.
        rig: calibration of what is yielded.
        plan: motion and place.
        origin_ns: stamp of the motion's time zero, IMU clock.
        frames_ns: (N,) instants at which the frames would see the world, IMU clock; some are dropped.
        camera: shutter, sensor noise, and whether to draw at all.
        degradations: what spoils the images.
        seed: of all that is random.
        world_seed: of the place alone.
        duration_s: of the motion, for what changes with time.
    """

    def __init__(
        self,
        *,
        name: str,
        rig: SensorRig,
        plan: PlannedMotion,
        origin_ns: int,
        frames_ns: Stamps,
        camera: CameraSettings,
        degradations: Degradations,
        seed: int,
        world_seed: int,
        duration_s: float,
    ) -> None:
        self.name = name
        self.motion = plan.motion
        # A replay draws images for a recording whose own are not read.
        self._rig = replace(rig, has_images=camera.images)
        self._plan = plan
        self._origin_ns = origin_ns
        self._camera = camera
        self._degradations = degradations
        self._seed = seed
        self._world_seed = world_seed
        self._duration_s = duration_s
        kept = ~degradations.dropped(len(frames_ns), seed)
        self._dropped = int(np.count_nonzero(~kept))
        self._frames_ns: Stamps = frames_ns[kept]
        self._imager: Imager | None = None

    @property
    def rig(self) -> SensorRig:
        """Calibration of what is yielded."""
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

    def elapsed_s(self, stamps_ns: Stamps | int) -> Array:
        """Time (N,) in s on the motion of stamps on the IMU clock."""
        return np.asarray(stamps_ns - self._origin_ns) / NANOSECONDS

    def packets(self) -> Iterator[Packet]:
        """Stream from the start: an image arrives after the inertial samples that precede it."""
        cutter = BlockCutter(self._blocks())
        for stamp_ns in self._frames_ns:
            yield from cutter.until(int(stamp_ns))
            images = self.imager.images(float(self.elapsed_s(stamp_ns))) if self._camera.images else ()
            yield Frame(stamp_ns=int(stamp_ns) - self._rig.camera_delay_ns, images=images)
        yield from cutter.until(None)

    def exact_flow(self, first_ns: int, second_ns: int, camera: int = 0) -> tuple[Array, Mask]:
        """Where the pixels of one image are in another, without error.

        Args:
            first_ns, second_ns: instants, IMU clock, such as two of :attr:`frame_stamps_ns`; in any order.
            camera: of the rig.

        Returns:
            displacement (H, W, 2) px on the grid of the first image, and seen (H, W): False where the point leaves
            the image, is hidden in the second, or the camera is blind.
        """
        return self.imager.flow(float(self.elapsed_s(first_ns)), float(self.elapsed_s(second_ns)), camera)

    @abstractmethod
    def _blocks(self) -> Iterator[ImuBlock]:
        """Inertial samples in order."""

    def exact_imu(self, stamps_ns: Stamps) -> ImuBlock:
        """What a perfect sensor on this motion would read at these stamps."""
        gyro, accel = exact_imu(self.motion, self.elapsed_s(stamps_ns), self._rig.gravity)
        return ImuBlock(stamps_ns=stamps_ns, gyro=gyro, accel=accel)
