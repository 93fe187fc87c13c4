"""Trajectory files: TUM, EuRoC and KITTI. The only place where the order of a quaternion changes.

========  =======================================================  ================================
format    a row                                                     separated by
========  =======================================================  ================================
``tum``   stamp (decimal seconds), x y z (m), qx qy qz qw           white space
``euroc`` stamp (integer ns), x y z (m), qw qx qy qz,               commas
          then vx vy vz (m/s) where known, then what is ignored
``kitti`` the upper 3×4 of a pose, row by row; a 13th column in     white space
          front is the index of the frame
========  =======================================================  ================================

Poses are taken as they are written: the poses of KITTI's odometry benchmark are those of *camera 0* in its
first frame (z forward), and nothing here turns them into poses of a body in a world with z up.
"""

import logging
from dataclasses import replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from vioframe.checks import Array, Stamps, check_increasing
from vioframe.conventions import NANOSECONDS
from vioframe.errors import ClockError, DataError, ShapeError
from vioframe.geometry import quaternion, se3
from vioframe.tables import Table, decimal_stamps, integer_stamps, read_table
from vioframe.types import Trajectory

log = logging.getLogger(__name__)

TrajectoryFormat = Literal["tum", "euroc", "kitti"]

KITTI_STEP_NS = 100_000_000
"""Nominal image interval of KITTI (10 Hz): the stamp of frame k is k of these where no stamps are given."""

# Files are written with few digits (four in some TUM files), so quaternions are off unit length by that much.
_QUATERNION_TOLERANCE = 1e-2

_SMOOTHED = "not causal (smoothed or loop-closed)"


def read_trajectory(
    path: Path | str,
    format: TrajectoryFormat | None = None,
    stamps: Path | str | Stamps | None = None,
    *,
    repeated: Literal["first", "refuse"] = "first",
) -> Trajectory:
    """Read a trajectory, with stamps exact to the last written digit.

    Args:
        path: text file.
        format: see the table above; None tells it from the first row.
        stamps: for ``kitti`` only: stamps of all frames of the sequence, as an int64 array (ns) or as a file
            with one time in seconds a line (``times.txt``). Row k (or the row with frame index k) gets the
            k-th of them. Without it frame k is stamped ``k * KITTI_STEP_NS``, so that two files of one
            sequence still match frame by frame.
        repeated: what to do with a row that repeats the stamp before it, as estimates written by other
            programs sometimes do: keep the ``first`` of them and say so in the log, or ``refuse``.

    Returns:
        The poses as written; velocity where an EuRoC file has it; ``causal`` is False only where the file
        says so in a comment, as :func:`write_tum` and :func:`write_euroc` do.

    Raises:
        DataError: missing, empty or damaged file, or something that is not a rotation; with file and line.
        ClockError: stamps repeated, out of order, or in the wrong unit.
    """
    path = Path(path)
    if format is not None and format not in get_args(TrajectoryFormat):
        raise DataError(f"{path}: format must be one of {', '.join(get_args(TrajectoryFormat))}, got {format!r}")
    table = read_table(path, what="poses")
    kind = format or detect_format(table)
    if repeated == "first" and kind != "kitti":
        table = _without_repeats(table)
    if stamps is not None and kind != "kitti":
        raise DataError(f"{path}: a {kind} file has stamps of its own; give none")
    if kind == "kitti":
        return _from_kitti(table, stamps)
    return _from_tum(table) if kind == "tum" else _from_euroc(table)


def _without_repeats(table: Table) -> Table:
    """The table without rows whose stamp is written exactly as in the row before."""
    kept = [row for row, text in enumerate(table.first) if row == 0 or text != table.first[row - 1]]
    dropped = len(table) - len(kept)
    if not dropped:
        return table
    first = next(row for row in range(1, len(table)) if table.first[row] == table.first[row - 1])
    log.warning(
        "%s: %d of %d rows repeat the stamp before them and are left out, the first at line %d",
        table.path, dropped, len(table), table.lines[first],
    )  # fmt: skip
    return replace(table, first=[table.first[row] for row in kept], values=table.values[kept], lines=table.lines[kept])


def detect_format(table: Table) -> TrajectoryFormat:
    """Tell the format from the number of columns and from the look of the first one.

    Raises:
        DataError: none fits.
    """
    width = table.values.shape[1]
    whole = table.first[0].lstrip("+-").isdigit()
    # Stamps in ns of any real clock have more than 14 digits; a KITTI frame index has at most six.
    if width >= 8 and whole and (abs(table.values[0, 0]) > 1e13 or width not in (8, 12, 13)):
        return "euroc"
    if width == 8:
        return "euroc" if "ns" in " ".join(table.comments) else "tum"
    if width in (12, 13):
        return "kitti"
    raise DataError(
        f"{table.where(0)}: {width} columns fit none of the formats tum (8), euroc (8 or more, stamps in ns) "
        "and kitti (12 or 13): give the format, or convert the file"
    )


def write_tum(path: Path | str, trajectory: Trajectory) -> None:
    """Write ``stamp_s x y z qx qy qz qw``: stamps exact, the rest to 12 decimals."""
    lines = [f"# {_kind(trajectory)}", "# stamp_s x y z qx qy qz qw"]
    _write(path, lines + tum_lines(trajectory.stamps_ns, trajectory.T_world_body))


def tum_lines(stamps_ns: Stamps, T_world_body: Array) -> list[str]:
    """One line a pose, (N,) stamps and (N, 4, 4) poses, for a file that grows while a run lasts."""
    quat_wxyz = quaternion.from_matrix(T_world_body[:, :3, :3])
    values = np.hstack([T_world_body[:, :3, 3], quat_wxyz[:, 1:], quat_wxyz[:, :1]])
    return [f"{format_seconds(int(stamp))} {_numbers(row, ' ')}" for stamp, row in zip(stamps_ns, values, strict=True)]


def write_euroc(path: Path | str, trajectory: Trajectory) -> None:
    """Write ``stamp_ns,x,y,z,qw,qx,qy,qz`` and ``vx,vy,vz`` where the velocity is known."""
    columns = [trajectory.T_world_body[:, :3, 3], quaternion.from_matrix(trajectory.T_world_body[:, :3, :3])]
    header = "# timestamp [ns], x [m], y [m], z [m], qw, qx, qy, qz"
    if trajectory.v_world_body is not None:
        columns.append(trajectory.v_world_body)
        header += ", vx [m s^-1], vy [m s^-1], vz [m s^-1]"
    lines = [f"# {_kind(trajectory)}", header]
    lines += [
        f"{int(stamp)},{_numbers(row, ',')}"
        for stamp, row in zip(trajectory.stamps_ns, np.hstack(columns), strict=True)
    ]
    _write(path, lines)


def write_kitti(path: Path | str, trajectory: Trajectory, times_path: Path | str | None = None) -> None:
    """Write the upper 3×4 of each pose, 12 numbers a row, and optionally the times in seconds beside it.

    The format has no stamps and no comments: the times go into a file of their own, and ``causal`` is lost.
    """
    rows = trajectory.T_world_body[:, :3, :].reshape(-1, 12)
    _write(path, [" ".join(f"{value:.12e}" for value in row) for row in rows])
    if times_path is not None:
        _write(times_path, [format_seconds(int(stamp)) for stamp in trajectory.stamps_ns])


def format_seconds(stamp_ns: int) -> str:
    """Decimal seconds of a stamp with all nine digits, such as ``1403715274.302142976``."""
    sign = "-" if stamp_ns < 0 else ""
    whole, rest = divmod(abs(stamp_ns), NANOSECONDS)
    return f"{sign}{whole}.{rest:09d}"


def _kind(trajectory: Trajectory) -> str:
    return "vioframe trajectory, " + ("causal" if trajectory.causal else _SMOOTHED)


def _numbers(row: Array, separator: str) -> str:
    return separator.join(f"{value:.12f}" for value in row)


def _write(path: Path | str, lines: list[str]) -> None:
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _from_tum(table: Table) -> Trajectory:
    if table.values.shape[1] != 8:
        raise DataError(
            f"{table.where(0)}: a tum row is stamp x y z qx qy qz qw (8 columns), got {table.values.shape[1]}: "
            "check the format"
        )
    quat_wxyz = table.values[:, [7, 4, 5, 6]]
    return Trajectory(
        stamps_ns=_tum_stamps(table),
        T_world_body=_poses(table, table.values[:, 1:4], quat_wxyz),
        causal=_SMOOTHED not in " ".join(table.comments),
    )


def _tum_stamps(table: Table) -> Stamps:
    # 1e11 s is the year 5138: a larger number is in another unit.
    if abs(table.values[0, 0]) > 1e11:
        raise ClockError(
            f"{table.where(0)}: the stamp is {table.first[0]}, but a tum file has seconds "
            "(these look like nanoseconds): divide by 1e9 without losing digits"
        )
    return decimal_stamps(table, what="poses")


def _from_euroc(table: Table) -> Trajectory:
    width = table.values.shape[1]
    if width < 8:
        raise DataError(
            f"{table.where(0)}: a euroc row is stamp,x,y,z,qw,qx,qy,qz[,vx,vy,vz,...] (8 or more columns), "
            f"got {width}: check the format"
        )
    return Trajectory(
        stamps_ns=integer_stamps(table, what="poses"),
        T_world_body=_poses(table, table.values[:, 1:4], table.values[:, 4:8]),
        v_world_body=table.values[:, 8:11].copy() if width >= 11 else None,
        causal=_SMOOTHED not in " ".join(table.comments),
    )


def _from_kitti(table: Table, stamps: Path | str | Stamps | None) -> Trajectory:
    width = table.values.shape[1]
    if width not in (12, 13):
        raise DataError(
            f"{table.where(0)}: a kitti row is the 3×4 of a pose (12 columns), or the same after a frame index "
            f"(13), got {width}: check the format"
        )
    indices = _frame_indices(table) if width == 13 else np.arange(len(table), dtype=np.int64)
    T = np.zeros((len(table), 4, 4))
    T[:, :3, :] = table.values[:, -12:].reshape(-1, 3, 4)
    T[:, 3, 3] = 1.0
    rotation = T[:, :3, :3]
    deviation = np.abs(rotation @ np.swapaxes(rotation, -1, -2) - np.eye(3)).max(axis=(1, 2))
    _refuse_first(table, (deviation > 1e-4) | (np.linalg.det(rotation) < 0), "the 3×3 part is not a rotation")
    return Trajectory(stamps_ns=_kitti_stamps(table, indices, stamps), T_world_body=T)


def _frame_indices(table: Table) -> Stamps:
    indices = table.values[:, 0]
    _refuse_first(table, (indices != np.round(indices)) | (indices < 0), "the first column is not a frame index")
    whole = indices.astype(np.int64)
    steps = np.diff(whole, prepend=-1)
    _refuse_first(table, steps <= 0, "the frame index does not increase")
    return whole


def _kitti_stamps(table: Table, indices: Stamps, stamps: Path | str | Stamps | None) -> Stamps:
    if stamps is None:
        return indices * KITTI_STEP_NS
    if isinstance(stamps, np.ndarray):
        known, source = stamps, "the given stamps"
        if known.ndim != 1 or known.dtype.kind != "i":
            raise ShapeError(f"stamps must be an (N,) int64 array of ns, got {known.shape} {known.dtype}")
        check_increasing("stamps", known)
    else:
        known, source = read_times(stamps), str(stamps)
    if indices[-1] >= len(known):
        raise DataError(
            f"{table.where(len(table) - 1)}: frame {int(indices[-1])} has no stamp, {source} has {len(known)}: "
            "are they of the same sequence?"
        )
    picked: Stamps = known[indices].astype(np.int64)
    return picked


def read_times(path: Path | str) -> Stamps:
    """Stamps (N,) in ns of a file with one time in seconds a line, as KITTI's ``times.txt``."""
    table = read_table(Path(path), what="times", columns=(1,))
    return decimal_stamps(table, what="times")


def _poses(table: Table, positions: Array, quat_wxyz: Array) -> Array:
    """T (N, 4, 4); quaternions must be of unit length up to the digits that files have."""
    norms = np.linalg.norm(quat_wxyz, axis=1)
    _refuse_first(table, np.abs(norms - 1.0) > _QUATERNION_TOLERANCE, "the quaternion is not of unit length", norms)
    return se3.from_parts(quaternion.to_matrix(quat_wxyz), positions)


def _refuse_first(table: Table, wrong: np.ndarray, what: str, values: Array | None = None) -> None:
    if wrong.any():
        row = int(np.argmax(wrong))
        value = f" ({values[row]:.4g})" if values is not None else ""
        raise DataError(
            f"{table.where(row)}: {what}{value}: check the format and the order of the columns, or remove the row"
        )
