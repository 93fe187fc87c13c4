"""One bag as a recording: samples in memory, images decoded one at a time."""

import logging
from collections.abc import Iterator, Sequence

import numpy as np

from vioframe.checks import Stamps
from vioframe.data.checked import CheckedRecording, size_mismatch
from vioframe.data.recording import Finding
from vioframe.errors import DataError
from vioframe.types import Camera, Frame, Image, ImuBlock, Packet, SensorRig, Trajectory
from vioframe_bags.bag import Bag
from vioframe_bags.messages import image_of

log = logging.getLogger(__name__)


class BagRecording(CheckedRecording):
    """A bag that has been read once and checked; images are decoded as they come by.

    Packets come in the order of recording: before each frame the inertial samples that were recorded before it.

    Args:
        name: of the sequence.
        bag: the file.
        rig: calibration.
        imu: samples to stream.
        topics: image topics of the rig's cameras.
        stamps_ns: by camera the F header stamps of its images; those of camera 0 stamp the frames.
        arrived: (F,) number of samples of ``imu`` that were recorded before the frame.
        truth: poses of the body on the IMU clock, or None.
        findings: what the checks on opening found.
        color: keep colours.
        mono16_bits: see :func:`vioframe_bags.messages.image_of`.
    """

    def __init__(
        self,
        *,
        name: str,
        bag: Bag,
        rig: SensorRig,
        imu: ImuBlock,
        topics: Sequence[str],
        stamps_ns: Sequence[Stamps],
        arrived: Stamps,
        truth: Trajectory | None,
        findings: Sequence[Finding],
        color: bool = False,
        mono16_bits: int = 16,
    ) -> None:
        super().__init__(name=name, rig=rig, imu=imu, frame_stamps_ns=stamps_ns[0], truth=truth, findings=findings)
        self._bag = bag
        self._topics = list(topics)
        self._stamps_ns = list(stamps_ns)
        self._arrived = arrived
        self._color = color
        self._mono16_bits = mono16_bits

    def packets(self) -> Iterator[Packet]:
        """Stream from the start; no more images are held than the cameras are apart in the bag."""
        self._corrupt = 0
        done = 0
        for index, images in self._frames():
            end = int(self._arrived[index])
            yield from self._blocks(done, end)
            done = max(done, end)
            if images is not None:
                yield Frame(stamp_ns=int(self.frame_stamps_ns[index]), images=images)
        yield from self._blocks(done, len(self.imu))

    def _frames(self) -> Iterator[tuple[int, tuple[Image, ...] | None]]:
        """Index and images of each frame in order; None instead of the images where one is corrupt."""
        if not self.rig.has_images:
            for index in range(self.frame_count):
                yield index, ()
            return
        cameras = {topic: camera for camera, topic in enumerate(self._topics)}
        waiting: dict[int, dict[int, Image | None]] = {}
        for message in self._bag.read(self._topics):
            camera = cameras[message.topic]
            known = self._stamps_ns[camera]
            index = int(np.searchsorted(known, message.stamp_ns))
            if index == len(known) or known[index] != message.stamp_ns:
                continue
            seen = waiting.setdefault(index, {})
            try:
                fields = message.decode()
                image = image_of(fields, message.kind, color=self._color, mono16_bits=self._mono16_bits)
                seen[camera] = check_size(image, self.rig.cameras[camera])
            except DataError as error:
                if not self._corrupt:
                    log.warning(
                        "%s: %s at stamp %d: %s; frame left out (further ones are only counted)",
                        self._bag.path,
                        message.topic,
                        message.stamp_ns,
                        error,
                    )
                self._corrupt += 1
                seen[camera] = None
            if len(seen) == len(self._topics):
                del waiting[index]
                images = tuple(image for _, image in sorted(seen.items()) if image is not None)
                yield index, images if len(images) == len(self._topics) else None


def check_size(image: Image, camera: Camera) -> Image:
    """The image itself.

    Raises:
        DataError: its size is not that of the calibration.
    """
    wrong = size_mismatch(image, camera)
    if wrong:
        raise DataError(wrong)
    return image
