"""Which sequences, frames and samples of a recording are streamed."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vioframe.checks import Mask, Stamps
from vioframe.conventions import NANOSECONDS
from vioframe.data import screening
from vioframe.data.recording import Finding
from vioframe.errors import ConfigError, DataError
from vioframe.types import ImuBlock, Trajectory

STEREO_TOLERANCE_NS = 1_000_000
"""Two images belong together if their stamps are closer; cameras triggered in hardware agree exactly."""

LEAD_NS = 2 * NANOSECONDS
"""Inertial samples that are kept before the first frame."""


def as_names(chosen: str | int | Sequence[str | int] | None) -> list[str]:
    """An option that is one name, a list of names or null; YAML makes numbers of names that look like them."""
    if chosen is None:
        return []
    if isinstance(chosen, str | int):
        return [str(chosen)]
    return [str(name) for name in chosen]


def check_given(key: str, value: str | None, advice: str) -> str:
    """An option without a default.

    Raises:
        ConfigError: it is not set.
    """
    # One that is left at ??? arrives as that text.
    if not value or value == "???":
        raise ConfigError(f"dataset.{key} is not set: {advice}")
    return value


def check_camera_count(cameras: int) -> int:
    """``dataset.cameras``.

    Raises:
        ConfigError: neither 1 nor 2.
    """
    if cameras not in (1, 2):
        raise ConfigError(f"dataset.cameras must be 1 or 2, got {cameras}")
    return cameras


def check_gravity(gravity: float) -> float:
    """``dataset.gravity``, m/s².

    Raises:
        ConfigError: not positive.
    """
    if not gravity > 0.0:
        raise ConfigError(f"dataset.gravity must be positive, got {gravity}")
    return gravity


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameSelection:
    """The options ``dataset.every``, ``dataset.start_s`` and ``dataset.duration_s``.

    Attributes:
        every: stream each such frame, from 1.
        start_s: seconds to leave out at the start.
        duration_s: seconds to stream; None streams to the end.
        stretch: shares of all usable frames at which the recording begins and ends, before the others are applied.
            What ends where another begins shares no frame with it, and both together leave none out.

    Raises:
        ConfigError: with the key and its value.
    """

    every: int
    start_s: float
    duration_s: float | None
    stretch: Sequence[float] = (0.0, 1.0)

    def __post_init__(self) -> None:
        numbers = len(self.stretch) == 2 and all(isinstance(share, int | float) for share in self.stretch)
        if not numbers or not 0.0 <= self.stretch[0] < self.stretch[1] <= 1.0:
            raise ConfigError(
                f"dataset.stretch must be two shares [from, to] with 0 ≤ from < to ≤ 1, got {list(self.stretch)}"
            )
        if not self.every >= 1:
            raise ConfigError(f"dataset.every must be 1 or more, got {self.every}")
        if not self.start_s >= 0.0:
            raise ConfigError(f"dataset.start_s must not be negative, got {self.start_s}")
        if self.duration_s is not None and not self.duration_s > 0.0:
            raise ConfigError(f"dataset.duration_s must be positive or null, got {self.duration_s}")

    @property
    def part(self) -> str:
        """What the stretch is called, in per cent of the recording, such as ``90-100``; empty for all of it."""
        first, last = (f"{100.0 * share:g}" for share in self.stretch)
        return "" if (first, last) == ("0", "100") else f"{first}-{last}"

    def choose(self, stamps_ns: Stamps, usable: Mask, where: str) -> Stamps:
        """Indices of the frames to stream.

        Args:
            stamps_ns: (F,) of all frames.
            usable: (F,) frames to choose from.
            where: file or topic, for messages.

        Raises:
            DataError: fewer than two are left.
        """
        usable = self._within_stretch(usable)
        first = int(stamps_ns[usable][0]) if usable.any() else int(stamps_ns[0])
        begin = first + round(self.start_s * NANOSECONDS)
        end = int(stamps_ns[-1]) if self.duration_s is None else begin + round(self.duration_s * NANOSECONDS)
        kept: Stamps = np.flatnonzero(usable & (stamps_ns >= begin) & (stamps_ns <= end))[:: self.every]
        if len(kept) < 2:
            raise DataError(
                f"{where}: {len(kept)} of {len(stamps_ns)} frames are left by dataset.start_s={self.start_s:g}, "
                f"duration_s={self.duration_s}, every={self.every} and stretch={list(self.stretch)}, but two are "
                "needed: change them"
            )
        return kept

    def _within_stretch(self, usable: Mask) -> Mask:
        numbers = np.flatnonzero(usable)
        # Rounded the same way at both ends: where one stretch ends the next begins.
        begin, end = (round(share * len(numbers)) for share in self.stretch)
        inside = np.zeros_like(usable)
        inside[numbers[begin:end]] = True
        return inside


def match_stamps(left_ns: Stamps, right_ns: Stamps) -> tuple[Stamps, Stamps]:
    """Indices of the pairs closer than :data:`STEREO_TOLERANCE_NS`, both increasing."""
    after = np.clip(np.searchsorted(right_ns, left_ns), 0, len(right_ns) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(np.abs(right_ns[after] - left_ns) < np.abs(left_ns - right_ns[before]), after, before)
    close = np.abs(right_ns[nearest] - left_ns) <= STEREO_TOLERANCE_NS
    return np.flatnonzero(close), nearest[close]


def sample_span(imu: ImuBlock, arrivals_ns: Stamps) -> tuple[int, int]:
    """Range [start, end) of the samples from :data:`LEAD_NS` before the first frame to just after the last.

    Args:
        imu: all samples.
        arrivals_ns: (F,) stamps of the frames, IMU clock.
    """
    start = int(np.searchsorted(imu.stamps_ns, arrivals_ns[0] - LEAD_NS))
    end = int(np.searchsorted(imu.stamps_ns, arrivals_ns[-1], side="left")) + 1
    return start, min(end, len(imu))


def choose_frames(
    stamps_ns: Stamps,
    imu: ImuBlock | None,
    selection: FrameSelection,
    *,
    delay_ns: int,
    where: str,
    truth: Trajectory | None,
    usable: Mask | None = None,
) -> tuple[Stamps, list[Finding]]:
    """Indices of the frames to stream, which the inertial samples cover, and what there is to tell of them.

    Args:
        stamps_ns: (F,) of all frames, camera clock.
        imu: all samples; None where images alone are streamed.
        selection: the options.
        delay_ns: ``t_imu = t_cam + delay``.
        where: file or topic of the stamps, for messages.
        truth: poses of the body, or None.
        usable: (F,) frames that have all their images; None for all.

    Raises:
        ClockError: the clocks of camera and IMU do not overlap.
        DataError: fewer than two frames are left.
    """
    findings: list[Finding] = []
    covered = np.ones(len(stamps_ns), dtype=np.bool_)
    if imu is not None:
        covered, clocks = screening.check_frame_clock(stamps_ns, imu, delay_ns, where)
        findings.append(clocks)
    kept = selection.choose(stamps_ns, covered if usable is None else covered & usable, where)
    findings.append(screening.check_frame_steps(stamps_ns[kept]))
    if truth is not None:
        findings.append(screening.check_truth_of_frames(stamps_ns[kept] + delay_ns, truth))
    return kept, findings
