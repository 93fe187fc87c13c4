"""What a data set and a recording are to the rest of vioframe."""

import queue
import threading
from abc import ABC, abstractmethod
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from vioframe.types import Packet, SensorRig, Trajectory

CORRUPT_IMAGES = "corrupt images"
"""Counted by recordings whose images may turn out to be damaged, or of another size than calibrated."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """One thing ``task=doctor`` has to say about a recording.

    Attributes:
        level: ``good`` (checked and right), ``note`` (worth knowing), ``bad`` (will spoil results).
        subject: what was looked at, such as ``"imu rate"``.
        text: what was found, with the value and the unit, and for ``bad`` what to do.
    """

    level: Literal["good", "note", "bad"]
    subject: str
    text: str


class Recording(ABC):
    """One sequence: calibration, packets in the order of arrival, and the truth where it is known.

    Opening one checks it: whatever would make it unusable raises ``DataError`` there, not in mid-run.
    """

    name: str

    @property
    @abstractmethod
    def rig(self) -> SensorRig:
        """Calibration."""

    @abstractmethod
    def packets(self) -> Iterator[Packet]:
        """Stream the packets from the start; each call begins anew, and memory stays flat."""

    @property
    @abstractmethod
    def frame_count(self) -> int:
        """Number of frames :meth:`packets` will yield, for progress bars and completion."""

    @property
    @abstractmethod
    def duration_s(self) -> float:
        """Seconds from the first to the last frame."""

    def ground_truth(self) -> Trajectory | None:
        """True poses of the body (IMU clock, world with z up), or None."""
        return None

    def seen_truth(self) -> Trajectory | None:
        """The truth for parts that simulate a camera from it: ``T_world_body @ T_body_cam``, as told, is where it was.

        It is the ground truth, unless the calibration was spoilt on purpose.
        """
        return self.ground_truth()

    def findings(self) -> list[Finding]:
        """What the checks found, good and bad, for ``task=doctor``."""
        return []

    def faults(self) -> tuple[str, ...]:
        """What was spoilt on purpose, such as ``("dropped_frames=0.1",)``; goes into the protocol of every number."""
        return ()

    def counters(self) -> Mapping[str, int]:
        """What happened while streaming, such as ``{"corrupt images": 1}``; goes into the table."""
        return {}


class Dataset(ABC):
    """What ``dataset=`` builds: names the test sequences and opens them one at a time."""

    @property
    @abstractmethod
    def sequences(self) -> Sequence[str]:
        """Names of the sequences to run, in order."""

    @abstractmethod
    def open(self, sequence: str) -> Recording:
        """Open and check one sequence.

        Raises:
            DataError: what is wrong, in which file and line, and what to do.
        """


class _Failure:
    def __init__(self, error: BaseException) -> None:
        self.error = error


def prefetch(packets: Iterable[Packet], depth: int = 16) -> Generator[Packet, None, None]:
    """Read ahead in a background thread, at most ``depth`` packets, so that decoding overlaps with estimation.

    Errors of the reader are raised at the place in the stream where they happened; leaving the loop early
    stops the thread.
    """
    buffer: queue.Queue[Packet | _Failure | None] = queue.Queue(maxsize=depth)
    stopped = threading.Event()

    def put(item: Packet | _Failure | None) -> None:
        while not stopped.is_set():
            try:
                buffer.put(item, timeout=0.1)
            except queue.Full:
                continue
            return

    def read() -> None:
        try:
            for packet in packets:
                put(packet)
                if stopped.is_set():
                    return
            put(None)
        except BaseException as error:  # noqa: BLE001 - handed over to the consumer, which raises it
            put(_Failure(error))

    thread = threading.Thread(target=read, name="vioframe-prefetch", daemon=True)
    thread.start()
    try:
        while (item := buffer.get()) is not None:
            if isinstance(item, _Failure):
                raise item.error
            yield item
    finally:
        stopped.set()
        thread.join(timeout=5.0)
