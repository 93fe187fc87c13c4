"""What to do with holes in the inertial samples."""

from itertools import pairwise
from typing import Literal, get_args

import numpy as np

from vioframe.checks import Stamps
from vioframe.conventions import seconds
from vioframe.data.recording import Finding
from vioframe.errors import ClockError, ConfigError
from vioframe.types import ImuBlock

GapPolicy = Literal["keep", "fill", "split", "refuse"]
"""``keep`` leaves holes to the synchronizer, which reports them; ``fill`` puts interpolated samples in them;
``split`` makes each stretch without a hole a sequence of its own; ``refuse`` raises."""


def check_policy(policy: str) -> GapPolicy:
    """The policy, if it is one.

    Raises:
        ConfigError: it is not.
    """
    for known in get_args(GapPolicy):
        if policy == known:
            return known  # type: ignore[no-any-return]
    raise ConfigError(f"dataset.gap_policy must be one of {', '.join(get_args(GapPolicy))}, got {policy!r}")


def find_gaps(stamps_ns: Stamps, max_gap_ns: int) -> Stamps:
    """Indices of the samples before holes: steps longer than ``max_gap_ns`` and than twice the usual one."""
    if len(stamps_ns) < 2:
        return np.zeros(0, dtype=np.int64)
    steps = np.diff(stamps_ns)
    found: Stamps = np.flatnonzero(steps > max(max_gap_ns, 2 * float(np.median(steps)))).astype(np.int64)
    return found


def stretches(stamps_ns: Stamps, max_gap_ns: int) -> list[tuple[int, int]]:
    """Index ranges [start, end) without a hole, of at least ten samples."""
    cuts = [0, *(int(i) + 1 for i in find_gaps(stamps_ns, max_gap_ns)), len(stamps_ns)]
    return [(start, end) for start, end in pairwise(cuts) if end - start >= 10]


def cut(imu: ImuBlock, start: int, end: int) -> ImuBlock:
    """Samples [start, end)."""
    return ImuBlock(stamps_ns=imu.stamps_ns[start:end], gyro=imu.gyro[start:end], accel=imu.accel[start:end])


def apply_policy(
    imu: ImuBlock, policy: GapPolicy, max_gap_ns: int, max_fill_ns: int, where: str
) -> tuple[ImuBlock, list[Finding]]:
    """Treat the holes by a policy other than ``split``, which is the business of who names the sequences.

    Args:
        imu: all samples.
        policy: see :data:`GapPolicy`.
        max_gap_ns: a longer step is a hole.
        max_fill_ns: a longer hole is not filled.
        where: file, for messages.

    Returns:
        The samples, filled if so wished, and what to tell of them.

    Raises:
        ClockError: a hole with ``refuse``, or one that is too long for ``fill``.
    """
    before = find_gaps(imu.stamps_ns, max_gap_ns)
    if not len(before):
        return imu, [Finding(level="good", subject="imu gaps", text="none")]
    lengths = imu.stamps_ns[before + 1] - imu.stamps_ns[before]
    longest = int(np.argmax(lengths))
    summary = (
        f"{len(before)} hole{'s' if len(before) > 1 else ''}, the longest {seconds(int(lengths[longest])):.3f} s "
        f"after stamp {int(imu.stamps_ns[before[longest]])}"
    )
    if policy == "refuse":
        raise ClockError(
            f"{where}: {summary}, and dataset.gap_policy=refuse: choose keep, fill or split, or mend the recording"
        )
    if policy == "fill":
        if lengths[longest] > max_fill_ns:
            raise ClockError(
                f"{where}: {summary}, too long to fill (dataset.max_fill_s={seconds(max_fill_ns):g}): "
                "choose dataset.gap_policy=split or keep"
            )
        filled = _fill(imu, before)
        added = len(filled) - len(imu)
        text = f"{summary}; {added} samples were put in by linear interpolation"
        return filled, [Finding(level="note", subject="imu gaps", text=text)]
    return imu, [Finding(level="note", subject="imu gaps", text=f"{summary}; kept as they are")]


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
