"""A recording that has been read and checked: samples in memory, images on disk."""

import logging
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from vioframe.checks import Stamps
from vioframe.conventions import seconds
from vioframe.data.recording import Finding, Recording
from vioframe.errors import DataError
from vioframe.types import Camera, Frame, Image, ImuBlock, Packet, SensorRig, Trajectory

log = logging.getLogger(__name__)

BLOCK_NS = 50_000_000
"""Longest inertial block: what a driver would deliver where no image cuts it earlier."""


class StoredRecording(Recording):
    """Samples in memory, images decoded one at a time as they are asked for.

    Inertial samples come in blocks that end with the first sample at or after each frame, followed by the
    frame, so that a synchronizer can close a window at once.

    Attributes:
        name: of the sequence.

    Args:
        name: of the sequence.
        rig: calibration, also of cameras whose images are not read (``has_images``).
        imu: all samples, IMU clock.
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
        self.name = name
        self.imu = imu
        self.frame_stamps_ns = frame_stamps_ns
        self._rig = rig
        self._image_paths = image_paths
        self._truth = truth
        self._findings = list(findings)
        self._color = color
        self._missing = missing_images
        self._corrupt = 0

    @property
    def rig(self) -> SensorRig:
        """Calibration."""
        return self._rig

    @property
    def frame_count(self) -> int:
        """Number of frames; corrupt ones, which are only met on the way, are counted here."""
        return len(self.frame_stamps_ns)

    @property
    def duration_s(self) -> float:
        """Seconds from the first to the last frame."""
        return seconds(int(self.frame_stamps_ns[-1] - self.frame_stamps_ns[0])) if self.frame_count else 0.0

    def ground_truth(self) -> Trajectory | None:
        """True poses of the IMU, or None."""
        return self._truth

    def findings(self) -> list[Finding]:
        """What the checks on opening found."""
        return list(self._findings)

    def counters(self) -> Mapping[str, int]:
        """Images that could not be decoded since :meth:`packets` began, and files that were not there."""
        counts = {"corrupt images": self._corrupt, "missing images": self._missing}
        return {name: count for name, count in counts.items() if count}

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

    def _blocks(self, start: int, end: int) -> Iterator[ImuBlock]:
        stamps_ns = self.imu.stamps_ns
        while start < end:
            stop = min(max(int(np.searchsorted(stamps_ns, stamps_ns[start] + BLOCK_NS)), start + 1), end)
            yield ImuBlock(
                stamps_ns=stamps_ns[start:stop], gyro=self.imu.gyro[start:stop], accel=self.imu.accel[start:stop]
            )
            start = stop

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


def size_mismatch(image: Image, camera: Camera) -> str:
    """What is wrong with the size of an image, or an empty text."""
    height, width = image.shape[:2]
    if (width, height) == tuple(camera.size_px):
        return ""
    return f"the image is {width}×{height} px but the calibration says {camera.size_px[0]}×{camera.size_px[1]}"


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
