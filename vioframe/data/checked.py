"""A recording that has been read and checked when it was opened, and whose samples are in memory."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from vioframe.checks import Stamps
from vioframe.conventions import seconds
from vioframe.data.recording import CORRUPT_IMAGES, Finding, Recording
from vioframe.types import Camera, Image, ImuBlock, SensorRig, Trajectory

BLOCK_NS = 50_000_000
"""Longest inertial block: what a driver would deliver where no image cuts it earlier."""


class CheckedRecording(Recording):
    """What all recordings on disk have in common; where images come from is the business of ``packets``.

    Attributes:
        name: of the sequence.
        imu: all samples that are streamed, IMU clock.
        frame_stamps_ns: (F,) increasing, camera clock.

    Args:
        name: of the sequence.
        rig: calibration, also of cameras whose images are not read (``has_images``).
        imu: samples to stream.
        frame_stamps_ns: (F,) increasing, camera clock.
        truth: poses of the body on the IMU clock, or None.
        findings: what the checks on opening found.
    """

    def __init__(
        self,
        *,
        name: str,
        rig: SensorRig,
        imu: ImuBlock,
        frame_stamps_ns: Stamps,
        truth: Trajectory | None,
        findings: Sequence[Finding],
    ) -> None:
        self.name = name
        self.imu = imu
        self.frame_stamps_ns = frame_stamps_ns
        self._rig = rig
        self._truth = truth
        self._findings = list(findings)
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
        """True poses of the body, or None."""
        return self._truth

    def findings(self) -> list[Finding]:
        """What the checks on opening found."""
        return list(self._findings)

    def counters(self) -> Mapping[str, int]:
        """Images that could not be decoded since :meth:`packets` began."""
        return {CORRUPT_IMAGES: self._corrupt} if self._corrupt else {}

    def _blocks(self, start: int, end: int) -> Iterator[ImuBlock]:
        """Samples [start, end) in blocks of at most :data:`BLOCK_NS`."""
        stamps_ns = self.imu.stamps_ns
        while start < end:
            stop = min(max(int(np.searchsorted(stamps_ns, stamps_ns[start] + BLOCK_NS)), start + 1), end)
            yield self.imu.cut(start, stop)
            start = stop


def size_mismatch(image: Image, camera: Camera) -> str:
    """What is wrong with the size of an image, or an empty text."""
    height, width = image.shape[:2]
    if (width, height) == tuple(camera.size_px):
        return ""
    return f"the image is {width}×{height} px but the calibration says {camera.size_px[0]}×{camera.size_px[1]}"
