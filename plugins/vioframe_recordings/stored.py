"""A recording whose samples are in memory, and whose images are files."""

import logging
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from vioframe.checks import Stamps
from vioframe.data.checked import CheckedRecording, size_mismatch
from vioframe.data.recording import Finding
from vioframe.data.selection import sample_span
from vioframe.errors import DataError
from vioframe.types import Camera, Frame, Image, ImuBlock, Packet, SensorRig, Trajectory

log = logging.getLogger(__name__)


class StoredRecording(CheckedRecording):
    """Images are decoded one at a time as they are asked for.

    Inertial samples come in blocks that end with the first sample at or after each frame, followed by the
    frame, so that a synchronizer can close a window at once.

    Args:
        name: of the sequence.
        rig: calibration, also of cameras whose images are not read (``has_images``).
        imu: all samples, IMU clock; those long before the first and after the last frame are left out.
        frame_stamps_ns: (F,) increasing, camera clock.
        image_paths: for each streamed camera the F files; empty streams stamps only.
        truth: poses of the body on the IMU clock, or None.
        findings: what the checks found.
        color: decode to RGB instead of gray.
        missing_images: frames left out on opening because their file is not there.
    """

    def __init__(
        self,
        *,
        name: str,
        rig: SensorRig,
        imu: ImuBlock,
        frame_stamps_ns: Stamps,
        image_paths: Sequence[Sequence[Path]],
        truth: Trajectory | None,
        findings: Sequence[Finding],
        color: bool = False,
        missing_images: int = 0,
    ) -> None:
        trimmed = imu.cut(*sample_span(imu, frame_stamps_ns + rig.camera_delay_ns))
        super().__init__(
            name=name, rig=rig, imu=trimmed, frame_stamps_ns=frame_stamps_ns, truth=truth, findings=findings
        )
        self._image_paths = image_paths
        self._color = color
        self._missing = missing_images

    def counters(self) -> Mapping[str, int]:
        """Images that could not be decoded since :meth:`packets` began, and files that were not there."""
        missing = {"missing images": self._missing} if self._missing else {}
        return {**super().counters(), **missing}

    def packets(self) -> Iterator[Packet]:
        """Stream from the start; memory stays flat, since an image lives as long as its frame is held."""
        self._corrupt = 0
        arrivals_ns = self.frame_stamps_ns + self.rig.camera_delay_ns
        ends = np.minimum(np.searchsorted(self.imu.stamps_ns, arrivals_ns, side="left") + 1, len(self.imu))
        done = 0
        for index, end in enumerate(ends):
            yield from self._blocks(done, int(end))
            done = max(done, int(end))
            frame = self._frame(index)
            if frame is not None:
                yield frame
        yield from self._blocks(done, len(self.imu))

    def _frame(self, index: int) -> Frame | None:
        images = []
        # Stamps alone have no paths, though their cameras are known.
        for paths, camera in zip(self._image_paths, self.rig.cameras, strict=self.rig.has_images):
            image = read_image(paths[index], color=self._color)
            wrong = "cannot be decoded" if image is None else size_mismatch(image, camera)
            if image is None or wrong:
                if not self._corrupt:
                    log.warning("%s: %s; frame left out (further ones are only counted)", paths[index], wrong)
                self._corrupt += 1
                return None
            images.append(image)
        return Frame(stamp_ns=int(self.frame_stamps_ns[index]), images=tuple(images))


def read_image(path: Path, *, color: bool = False) -> Image | None:
    """(H, W) or (H, W, 3) RGB uint8, or None where the file cannot be decoded."""
    import cv2

    try:
        encoded = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    except OSError:
        return None
    if not encoded.size:
        return None
    # Decoding from memory keeps OpenCV from printing its own warnings about files to the terminal.
    image = cv2.imdecode(encoded, cv2.IMREAD_COLOR_RGB if color else cv2.IMREAD_GRAYSCALE)
    return None if image is None else np.asarray(image, dtype=np.uint8)


def check_first_images(
    image_paths: Sequence[Sequence[Path]], cameras: Sequence[Camera], calibration: str, *, color: bool = False
) -> None:
    """Decode one image of each camera, and compare its size with the calibration.

    Args:
        image_paths: the files, by camera.
        cameras: their calibration.
        calibration: where the calibration is written, for the message.
        color: as in :class:`StoredRecording`.

    Raises:
        DataError: none of the first images can be decoded, or its size is not that of the calibration.
    """
    for paths, camera in zip(image_paths, cameras, strict=True):
        attempts = list(paths[:5])
        decoded = ((path, read_image(path, color=color)) for path in attempts)
        path, image = next(((p, i) for p, i in decoded if i is not None), (None, None))
        if path is None or image is None:
            raise DataError(
                f"{attempts[0]}: neither this image nor the {len(attempts) - 1} after it can be decoded: "
                "fetch the images again"
            )
        wrong = size_mismatch(image, camera)
        if wrong:
            raise DataError(f"{path}: {wrong} ({calibration}): take the calibration of these images")
