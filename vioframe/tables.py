"""Numeric text tables: read fast, keep integer stamps exact, and name file and line of what is wrong."""

from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from vioframe.checks import Array, Stamps
from vioframe.conventions import NANOSECONDS
from vioframe.errors import ClockError, DataError

# No sensor in reach of this project samples a megahertz: shorter steps mean that the unit is not nanoseconds.
SHORTEST_STEP_NS = 1_000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Table:
    """Rows of numbers from a text file, with where each came from.

    Attributes:
        path: the file.
        first: text of the first column, (N,), for stamps that a float would round.
        values: (N, columns) all columns as floats, finite.
        lines: (N,) line number of each row in the file, from 1.
        comments: lines that start with ``#``, without it.
    """

    path: Path
    first: list[str]
    values: Array
    lines: Stamps
    comments: list[str]

    def __len__(self) -> int:
        return len(self.values)

    def where(self, row: int) -> str:
        """``file:line`` of a row."""
        return f"{self.path}:{int(self.lines[row])}"


def read_table(
    path: Path, *, what: str, columns: Sequence[int] | None = None, delimiter: str | None = None, finite: bool = True
) -> Table:
    """Read a table of numbers.

    Args:
        path: text file; ``#`` starts a comment line.
        what: what the file holds, for messages, such as ``"IMU samples"``.
        columns: numbers of columns that are allowed; None takes whatever the first row has.
        delimiter: between columns; None takes a comma where the first row has one, else white space.
        finite: refuse NaN and infinity.

    Raises:
        DataError: missing, unreadable or empty file; a row with another number of columns, something that
            is not a number, NaN; with file and line.
    """
    kept, lines, comments = _split(path, what)
    if delimiter is None and "," in kept[0]:
        delimiter = ","
    rows = [line.split(delimiter) for line in kept]
    width = len(rows[0])
    if columns is not None and width not in columns:
        wanted = " or ".join(map(str, columns))
        raise DataError(
            f"{path}:{lines[0]}: {what} need {wanted} columns, got {width} ({_shorten(kept[0])}): "
            "check that this is the right file and format"
        )
    for index, row in enumerate(rows):
        if len(row) != width:
            raise DataError(
                f"{path}:{lines[index]}: this row has {len(row)} columns where the first has {width} "
                f"({_shorten(kept[index])}): the file is damaged or truncated, fetch it again or remove the row"
            )
    try:
        values = np.array([float(token) for row in rows for token in row]).reshape(len(rows), width)
    except ValueError as error:
        raise _not_a_number(path, rows, lines, what) from error
    if finite and not np.isfinite(values).all():
        bad_row, bad_column = (int(i) for i in np.argwhere(~np.isfinite(values))[0])
        raise DataError(
            f"{path}:{lines[bad_row]}: column {bad_column + 1} is {rows[bad_row][bad_column].strip()}, but {what} must "
            "be finite: remove or repair the row"
        )
    return Table(
        path=path,
        first=[row[0].strip() for row in rows],
        values=values,
        lines=np.array(lines, dtype=np.int64),
        comments=comments,
    )


def _split(path: Path, what: str) -> tuple[list[str], list[int], list[str]]:
    """Data lines, their numbers from 1, and comments."""
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise DataError(f"{path}: no such file; it should hold the {what}: check the folder") from None
    except UnicodeDecodeError:
        raise DataError(f"{path}: not a text file; it should hold the {what}") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}); it should hold the {what}") from error
    kept: list[str] = []
    lines: list[int] = []
    comments: list[str] = []
    for number, line in enumerate(text.split("\n"), start=1):
        stripped = line.strip()
        if stripped.startswith("#"):
            comments.append(stripped[1:].strip())
        elif stripped:
            kept.append(stripped)
            lines.append(number)
    if not kept:
        raise DataError(f"{path}: empty, it should hold the {what}: fetch the file again")
    return kept, lines, comments


def _shorten(text: str) -> str:
    return repr(text if len(text) <= 60 else text[:57] + "...")


def _not_a_number(path: Path, rows: list[list[str]], lines: list[int], what: str) -> DataError:
    for number, row in zip(lines, rows, strict=True):
        for column, token in enumerate(row, start=1):
            try:
                float(token)
            except ValueError:
                return DataError(
                    f"{path}:{number}: column {column} of the {what} is {_shorten(token)}, not a number: "
                    "repair or remove the row"
                )
    return DataError(f"{path}: holds something that is not a number")


def integer_stamps(table: Table, *, what: str, increasing: bool = True) -> Stamps:
    """Stamps (N,) in ns from a first column of integers, exact.

    Raises:
        ClockError: not integers (seconds, perhaps), a step below a microsecond (another unit), repeated or
            out of order.
    """
    try:
        stamps_ns = np.array([int(text) for text in table.first], dtype=np.int64)
    except (ValueError, OverflowError):
        row = next(i for i, text in enumerate(table.first) if not _is_integer(text))
        raise ClockError(
            f"{table.where(row)}: the stamp of the {what} is {table.first[row]}, but integer nanoseconds belong "
            "here (these look like seconds): multiply by 1e9 without losing digits"
        ) from None
    check_stamps(table, stamps_ns, what=what, increasing=increasing)
    return stamps_ns


def _is_integer(text: str) -> bool:
    try:
        return abs(int(text)) < 2**63
    except ValueError:
        return False


def decimal_stamps(table: Table, *, what: str) -> Stamps:
    """Stamps (N,) in ns from a first column of seconds, keeping all digits that are written.

    Raises:
        ClockError: not seconds (nanoseconds, perhaps), repeated or out of order.
    """
    stamps_ns = np.array([seconds_to_ns(text) for text in table.first], dtype=np.int64)
    check_stamps(table, stamps_ns, what=what)
    return stamps_ns


def seconds_to_ns(text: str) -> int:
    """Nanoseconds of a decimal number of seconds, rounded half to even at the last one.

    Raises:
        ClockError: beyond what 64 bits of nanoseconds hold (292 years).
    """
    try:
        stamp_ns = int((Decimal(text.strip()) * NANOSECONDS).to_integral_value())
    except (InvalidOperation, OverflowError, ValueError):
        raise ClockError(f"{text!r} is not a time in seconds") from None
    if abs(stamp_ns) >= 2**63:
        raise ClockError(f"{text!r} is not a time in seconds: it looks like nanoseconds")
    return stamp_ns


def check_stamps(table: Table, stamps_ns: Stamps, *, what: str, increasing: bool = True) -> None:
    """Refuse stamps out of order or in another unit, with file and line.

    Raises:
        ClockError: see there.
    """
    if len(stamps_ns) < 2:
        return
    steps = np.diff(stamps_ns)
    if increasing and steps.min() <= 0:
        row = int(np.argmax(steps <= 0)) + 1
        how = "repeats the one before" if steps[row - 1] == 0 else "is earlier than the one before"
        raise ClockError(
            f"{table.where(row)}: the stamp {int(stamps_ns[row])} ns of the {what} {how} "
            f"({int(stamps_ns[row - 1])} ns): remove or sort the row"
        )
    typical = float(np.median(np.abs(steps)))
    if 0 < typical < SHORTEST_STEP_NS:
        raise ClockError(
            f"{table.where(0)}: the {what} are {typical:g} ns apart, but stamps must be nanoseconds "
            "(these look like seconds or milliseconds): convert them"
        )
