"""Files of the ASL layout: inertial samples, lists of images, and where the ground truth is."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from vioframe.checks import Stamps
from vioframe.errors import ClockError, DataError
from vioframe.tables import integer_stamps, read_table
from vioframe.types import ImuBlock


def sequences_under(root: Path) -> list[str]:
    """Names of the folders with ``mav0/imu0``."""
    return sorted(path.name for path in root.iterdir() if (path / "mav0" / "imu0").is_dir())


def read_imu(folder: Path) -> tuple[ImuBlock, Path]:
    """Samples of ``imu0/data.csv``: stamp ns, gyro x y z rad/s, accelerometer x y z m/s².

    Raises:
        DataError: with file and line.
    """
    path = folder / "imu0" / "data.csv"
    table = read_table(path, what="IMU samples", columns=(7,), delimiter=",")
    stamps_ns = integer_stamps(table, what="IMU samples")
    if len(stamps_ns) < 10:
        raise DataError(f"{path}: {len(stamps_ns)} IMU samples are too few for a recording: fetch the file again")
    values = table.values
    return ImuBlock(stamps_ns=stamps_ns, gyro=values[:, 1:4].copy(), accel=values[:, 4:7].copy()), path


def read_frame_list(folder: Path, *, images: bool) -> tuple[Stamps, list[Path], Path]:
    """Stamps, image files, and the file that lists them: ``data.csv``, or ``timestamps.txt`` with stamps alone.

    Raises:
        DataError: with file and line.
    """
    listing, bare = folder / "data.csv", folder / "timestamps.txt"
    if not folder.is_dir():
        advice = "complete the recording" + (", or use one camera (rig=mono)" if folder.name != "cam0" else "")
        raise DataError(f"{folder}: no such folder; it should hold the images of this camera: {advice}")
    if not listing.exists() and not bare.exists():
        raise DataError(f"{listing}: no such file, and no {bare.name} beside it; it should list the images")
    source = listing if listing.exists() else bare
    data = folder / "data"
    if images and source == bare and not data.is_dir():
        raise DataError(
            f"{bare}: this recording has stamps but no images in {data}: fetch them, or set dataset.images=false"
        )
    rows = _listing_rows(source)
    table = read_table(source, what="frame stamps") if source == bare else None
    if table is not None and table.values.shape[1] != 1:
        raise DataError(f"{table.where(0)}: one stamp in ns a line is expected, got {table.values.shape[1]} columns")
    stamps_ns = _row_stamps(source, rows)
    return stamps_ns, [data / (row[1] or f"{row[0]}.png") for row in rows], source


def _listing_rows(path: Path) -> list[tuple[str, str, int]]:
    """Stamp, file name (or nothing) and line of each row."""
    rows: list[tuple[str, str, int]] = []
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: cannot be read as text ({error})") from error
    for number, line in enumerate(text.split("\n"), start=1):
        stripped = line.strip()
        if not stripped or stripped.startswith("#"):
            continue
        columns = [column.strip() for column in stripped.split(",")]
        if path.suffix == ".csv" and (len(columns) != 2 or not columns[1]):
            raise DataError(
                f"{path}:{number}: a row should be stamp,file name but is {stripped[:60]!r}: the file is damaged or "
                "truncated, fetch it again or remove the row"
            )
        rows.append((columns[0], columns[1] if len(columns) > 1 else "", number))
    if not rows:
        raise DataError(f"{path}: empty, it should list the frames: fetch the file again")
    return rows


def _row_stamps(path: Path, rows: list[tuple[str, str, int]]) -> Stamps:
    stamps = []
    for text, _, number in rows:
        try:
            stamps.append(int(text))
        except ValueError:
            raise ClockError(
                f"{path}:{number}: the frame stamp is {text[:40]!r}, but integer nanoseconds belong here (seconds have "
                "a point): convert it without losing digits"
            ) from None
    stamps_ns = np.array(stamps, dtype=np.int64)
    steps = np.diff(stamps_ns)
    if len(steps) and steps.min() <= 0:
        row = int(np.argmax(steps <= 0)) + 1
        how = "repeats the one before" if steps[row - 1] == 0 else "is earlier than the one before"
        raise ClockError(
            f"{path}:{rows[row][2]}: the frame stamp {rows[row][0]} ns {how} ({rows[row - 1][0]} ns): remove or sort it"
        )
    return stamps_ns


def has_truth(folder: Path, name: str, known: Mapping[str, tuple[str, ...]]) -> bool:
    """Whether a named ground truth is there."""
    return any(True for pattern in known[name] for _ in folder.glob(pattern))


def find_truth(folder: Path, choice: str, known: Mapping[str, tuple[str, ...]]) -> Path | None:
    """File of the ground truth: by name (``default``, ``corrected``), ``none``, or a path under ``mav0``.

    Raises:
        DataError: a choice other than ``default`` that is not there.
    """
    if choice == "none":
        return None
    for pattern in known.get(choice, (choice,)):
        found = sorted(folder.glob(pattern))
        if found:
            return found[0]
    if choice == "default":
        return None
    names = sorted(name for name in known if has_truth(folder, name, known))
    raise DataError(
        f"{folder}: dataset.ground_truth={choice} is not in this recording; it has {', '.join(names) or 'none'}: "
        "take one of them, a file under mav0, or none"
    )
