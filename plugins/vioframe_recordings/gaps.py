"""What to do with holes in the inertial samples."""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, get_args

import numpy as np

from vioframe.checks import Stamps
from vioframe.conventions import NANOSECONDS
from vioframe.data.recording import Finding
from vioframe.data.screening import check_gaps, describe_gaps, find_gaps
from vioframe.errors import ClockError, ConfigError, DataError
from vioframe.types import ImuBlock
from vioframe_recordings.folders import FolderDataset

GapPolicy = Literal["keep", "fill", "split", "refuse"]
"""``keep`` leaves holes to the synchronizer, which reports them; ``fill`` puts interpolated samples in them;
``split`` makes each stretch without a hole a sequence of its own; ``refuse`` raises."""


PART_MARK = ".part"
"""Between the name of a sequence and the number of its part, with ``split``."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GapTreatment:
    """The options ``dataset.gap_policy``, ``dataset.max_gap_s`` and ``dataset.max_fill_s``.

    Attributes:
        policy: see :data:`GapPolicy`.
        max_gap_s: a longer step is a hole.
        max_fill_s: a longer hole is not filled.
    """

    policy: GapPolicy
    max_gap_s: float
    max_fill_s: float

    def __post_init__(self) -> None:
        if self.policy not in get_args(GapPolicy):
            known = ", ".join(get_args(GapPolicy))
            raise ConfigError(f"dataset.gap_policy must be one of {known}, got {self.policy!r}")
        for name in ("max_gap_s", "max_fill_s"):
            if not getattr(self, name) >= 0.0:
                raise ConfigError(f"dataset.{name} must not be negative, got {getattr(self, name)}")

    @property
    def max_gap_ns(self) -> int:
        """A longer step is a hole."""
        return round(self.max_gap_s * NANOSECONDS)

    def split_name(self, sequence: str) -> tuple[str, int | None]:
        """Name of the recording and number of the part that a sequence is, or None where it is not one."""
        name, mark, number = sequence.rpartition(PART_MARK)
        return (name, int(number)) if self.policy == "split" and mark and number.isdigit() else (sequence, None)

    def part_names(self, name: str, stamps_ns: Stamps) -> list[str]:
        """Names of the stretches without a hole; the name itself where there is only one."""
        count = len(stretches(stamps_ns, self.max_gap_ns))
        return [name] if count < 2 else [f"{name}{PART_MARK}{index}" for index in range(count)]

    def treat(self, imu: ImuBlock, sequence: str, where: str) -> tuple[ImuBlock, list[Finding]]:
        """Samples of a sequence.

        Args:
            imu: all samples.
            sequence: its name, which may be that of a part.
            where: file, for messages.

        Returns:
            The samples, filled if so wished, and what to tell of them.

        Raises:
            ClockError: a hole with ``refuse``, or one that is too long for ``fill``.
            DataError: there is no such part.
        """
        _, part = self.split_name(sequence)
        if part is not None:
            return self._take(imu, part, sequence, where)
        before = find_gaps(imu.stamps_ns, self.max_gap_ns)
        if not len(before) or self.policy in ("keep", "split"):
            return imu, [check_gaps(imu.stamps_ns, self.max_gap_ns)]
        summary = describe_gaps(imu.stamps_ns, before)
        if self.policy == "refuse":
            raise ClockError(
                f"{where}: {summary}, and dataset.gap_policy=refuse: choose keep, fill or split, or mend the recording"
            )
        if np.diff(imu.stamps_ns).max() > self.max_fill_s * NANOSECONDS:
            raise ClockError(
                f"{where}: {summary}, too long to fill (dataset.max_fill_s={self.max_fill_s:g}): "
                "choose dataset.gap_policy=split or keep"
            )
        filled = _fill(imu, before)
        text = f"{summary}; {len(filled) - len(imu)} samples were put in by linear interpolation"
        return filled, [Finding(level="note", subject="imu gaps", text=text)]

    def _take(self, imu: ImuBlock, part: int, sequence: str, where: str) -> tuple[ImuBlock, list[Finding]]:
        ranges = stretches(imu.stamps_ns, self.max_gap_ns)
        if part >= len(ranges):
            raise DataError(
                f"{where}: has {len(ranges)} stretches without a hole, so there is no {sequence}: set dataset.sequence "
                "to the name of the recording"
            )
        text = f"stretch {part + 1} of {len(ranges)} without a hole"
        return imu.cut(*ranges[part]), [Finding(level="note", subject="imu gaps", text=text)]


def stretches(stamps_ns: Stamps, max_gap_ns: int) -> list[tuple[int, int]]:
    """Index ranges [start, end) without a hole, of at least ten samples."""
    cuts = [0, *(int(i) + 1 for i in find_gaps(stamps_ns, max_gap_ns)), len(stamps_ns)]
    return [(start, end) for start, end in pairwise(cuts) if end - start >= 10]


class PartedDataset(FolderDataset):
    """A data set in which each stretch without a hole can be a sequence of its own.

    Attributes:
        gap_treatment: the options, set by the constructor of the data set, with ``_chosen``, names of recordings.
    """

    gap_treatment: GapTreatment
    _chosen: Sequence[str]
    _names: list[str] | None = None

    @property
    def sequences(self) -> Sequence[str]:
        """Names of the sequences; with ``gap_policy: split`` the parts of each recording."""
        if self._names is None:
            split = self.gap_treatment.policy == "split"
            self._names = [part for name in self._chosen for part in (self._parts(name) if split else [name])]
        return self._names

    def _parts(self, name: str) -> list[str]:
        try:
            return self.gap_treatment.part_names(name, self._imu_stamps(name))
        except DataError:
            # Opening it will say what is wrong; the other recordings can still run.
            return [name]

    @abstractmethod
    def _imu_stamps(self, name: str) -> Stamps:
        """Stamps of all inertial samples of a recording, or ``DataError``."""


def _fill(imu: ImuBlock, before: Stamps) -> ImuBlock:
    """Samples on a grid of about the usual step inside each hole, linear between its ends."""
    step = float(np.median(np.diff(imu.stamps_ns)))
    extra = []
    for index in before:
        start, end = int(imu.stamps_ns[index]), int(imu.stamps_ns[index + 1])
        pieces = max(round((end - start) / step), 1)
        extra.append(start + (np.arange(1, pieces) * (end - start)) // pieces)
    stamps_ns = np.sort(np.concatenate([imu.stamps_ns, *extra])).astype(np.int64)
    # Differences are small enough for floats; absolute stamps are not.
    known, wanted = imu.stamps_ns - stamps_ns[0], stamps_ns - stamps_ns[0]
    gyro, accel = (
        np.stack([np.interp(wanted, known, values[:, axis]) for axis in range(3)], axis=1)
        for values in (imu.gyro, imu.accel)
    )
    return ImuBlock(stamps_ns=stamps_ns, gyro=gyro, accel=accel)
