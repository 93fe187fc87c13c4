"""The states of a run, kept on disk: an hour of them would otherwise grow the process by a quarter gigabyte."""

import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import overload

import numpy as np

from vioframe.checks import Stamps
from vioframe.types import ImuBias, NavState, Status, Trajectory

_STATUSES: tuple[Status, ...] = ("starting", "tracking", "lost")
_RECORD = np.dtype(
    [
        ("stamp_ns", "i8"),
        ("T_world_body", "f8", (4, 4)),
        ("v_world_body", "f8", (3,)),
        ("bias", "f8", (6,)),
        ("covariance", "f8", (15, 15)),
        ("has_covariance", "?"),
        ("status", "u1"),
    ]
)
_CHUNK = 256


class StateLog(Sequence[NavState]):
    """Append-only sequence of states in a temporary file, read back in chunks.

    Args:
        folder: where the file is made; it is gone when the log is.
    """

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._file = tempfile.TemporaryFile(dir=folder)
        self._count = 0

    def append(self, state: NavState) -> None:
        """Add one state; the caller appends in the order of the stamps."""
        record = np.zeros((), dtype=_RECORD)
        record["stamp_ns"] = state.stamp_ns
        record["T_world_body"] = state.T_world_body
        record["v_world_body"] = state.v_world_body
        record["bias"][:3] = state.bias.gyro
        record["bias"][3:] = state.bias.accel
        record["status"] = _STATUSES.index(state.status)
        if state.covariance is not None:
            record["covariance"] = state.covariance
            record["has_covariance"] = True
        self._file.seek(0, 2)
        self._file.write(record.tobytes())
        self._count += 1

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[NavState]:
        for start in range(0, self._count, _CHUNK):
            for record in self._read(start, min(start + _CHUNK, self._count)):
                yield _state(record)

    @overload
    def __getitem__(self, index: int) -> NavState: ...
    @overload
    def __getitem__(self, index: slice) -> list[NavState]: ...
    def __getitem__(self, index: int | slice) -> NavState | list[NavState]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(self._count))]
        place = index + self._count if index < 0 else index
        if not 0 <= place < self._count:
            raise IndexError(f"state {index} of {self._count}")
        return _state(self._read(place, place + 1)[0])

    def stamps_ns(self) -> Stamps:
        """(N,) stamps of all states."""
        stamps: Stamps = self._read(0, self._count)["stamp_ns"].astype(np.int64)
        return stamps

    def trajectory(self) -> Trajectory:
        """All states as a causal trajectory."""
        records = self._read(0, self._count)
        return Trajectory(
            stamps_ns=records["stamp_ns"].astype(np.int64),
            T_world_body=records["T_world_body"].copy(),
            v_world_body=records["v_world_body"].copy(),
        )

    def _read(self, start: int, stop: int) -> np.ndarray:
        self._file.seek(start * _RECORD.itemsize)
        return np.frombuffer(self._file.read((stop - start) * _RECORD.itemsize), dtype=_RECORD)


def _state(record: np.ndarray) -> NavState:
    return NavState(
        stamp_ns=int(record["stamp_ns"]),
        T_world_body=record["T_world_body"],
        v_world_body=record["v_world_body"],
        bias=ImuBias(gyro=record["bias"][:3], accel=record["bias"][3:]),
        covariance=record["covariance"] if record["has_covariance"] else None,
        status=_STATUSES[int(record["status"])],
    )
