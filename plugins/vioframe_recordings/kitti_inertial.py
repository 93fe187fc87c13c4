"""Inertial samples and poses of KITTI raw drives: OXTS packets, or a KLT file."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from vioframe.checks import Array, Stamps
from vioframe.conventions import NANOSECONDS
from vioframe.data.recording import Finding
from vioframe.errors import ClockError, DataError
from vioframe.geometry import se3, so3
from vioframe.types import ImuBlock, Trajectory
from vioframe_recordings.kitti_calibration import read_mat, spline_velocities

Disorder = Literal["refuse", "drop"]
MissingAccel = Literal["refuse", "derive"]

OXTS_COLUMNS = 30
EARTH_RADIUS = 6_378_137.0
"""Metres: the sphere on which KITTI's devkit projects latitude and longitude (Mercator)."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Packets:
    """Inertial samples of a drive with the poses that the same file gives.

    Attributes:
        imu: all samples, vehicle frame.
        truth: poses of the vehicle.
        where: file or folder, for messages.
        findings: what there is to tell of them.
    """

    imu: ImuBlock
    truth: Trajectory
    where: str
    findings: tuple[Finding, ...]


def read_date_stamps(path: Path, *, what: str) -> Stamps:
    """Stamps (N,) in ns of lines such as ``2011-09-26 13:02:25.967790592``, taken as UTC; order is not checked.

    Raises:
        DataError: missing or empty file, or a line that is no date; with file and line.
    """
    from datetime import UTC, datetime

    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        raise DataError(f"{path}: cannot be read; it should hold the {what}: check the recording") from None
    stamps = []
    for number, line in enumerate(text.split("\n"), start=1):
        if not line.strip():
            continue
        whole, _, fraction = line.strip().partition(".")
        try:
            moment = datetime.strptime(whole, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
            stamps.append(int(moment.timestamp()) * NANOSECONDS + int(fraction[:9].ljust(9, "0")))
        except ValueError:
            raise ClockError(
                f"{path}:{number}: {line.strip()[:40]!r} is not a date such as 2011-09-26 13:02:25.967790592: repair "
                "or remove the line"
            ) from None
    if not stamps:
        raise DataError(f"{path}: empty, it should hold the {what}: fetch the file again")
    return np.array(stamps, dtype=np.int64)


def read_oxts(folder: Path, disorder: Disorder) -> Packets:
    """Packets of ``oxts``: ``timestamps.txt`` and one file of 30 numbers each under ``data``.

    Acceleration is raw specific force (columns 12 to 14) and rate (18 to 20), both in the vehicle.

    Args:
        folder: ``oxts``.
        disorder: what to do with a packet whose stamp is not later than all before it, which the unsynchronised
            drives have.

    Raises:
        DataError: with the file.
    """
    stamps_file = folder / "timestamps.txt"
    stamps_ns = read_date_stamps(stamps_file, what="stamps of the OXTS packets")
    files = sorted((folder / "data").glob("*.txt")) if (folder / "data").is_dir() else []
    if len(files) != len(stamps_ns):
        raise DataError(
            f"{folder}: {len(files)} packets in data for {len(stamps_ns)} stamps in timestamps.txt: the drive is "
            "incomplete, fetch it again"
        )
    values = np.array([_read_packet(path) for path in files])
    findings: list[Finding] = []
    in_order = stamps_ns > np.concatenate([[np.iinfo(np.int64).min], np.maximum.accumulate(stamps_ns)[:-1]])
    out = int((~in_order).sum())
    if out and disorder == "refuse":
        row = int(np.argmin(in_order))
        raise ClockError(
            f"{stamps_file}:{row + 1}: the stamp {int(stamps_ns[row])} ns repeats or goes back behind "
            f"{int(stamps_ns[row - 1])} ns, as {out} of {len(stamps_ns)} do: set dataset.disorder=drop to leave such "
            "packets out"
        )
    if out:
        text = f"{out} of {len(stamps_ns)} packets were out of order and are left out"
        findings.append(Finding(level="note", subject="imu order", text=text))
    stamps_ns, values = stamps_ns[in_order], values[in_order]
    if len(stamps_ns) < 10:
        raise DataError(f"{folder}: {len(stamps_ns)} packets in order are too few for a recording: fetch it again")
    text = f"{folder} (the OXTS' own position and attitude)"
    findings.append(Finding(level="good", subject="ground truth file", text=text))
    truth = Trajectory(
        stamps_ns=stamps_ns,
        T_world_body=poses_of_oxts(values),
        # Columns 7, 8 and 11 are the velocities to the north, to the east and upwards.
        v_world_body=np.stack([values[:, 7], values[:, 6], values[:, 10]], axis=1),
    )
    imu = ImuBlock(stamps_ns=stamps_ns, gyro=values[:, 17:20].copy(), accel=values[:, 11:14].copy())
    return Packets(imu=imu, truth=truth, where=str(folder), findings=tuple(findings))


def _read_packet(path: Path) -> Array:
    tokens = path.read_text(encoding="utf-8", errors="replace").split()
    try:
        values = np.array([float(token) for token in tokens])
    except ValueError:
        raise DataError(f"{path}:1: something in this OXTS packet is not a number: fetch the drive again") from None
    if values.size != OXTS_COLUMNS:
        raise DataError(f"{path}:1: an OXTS packet has {OXTS_COLUMNS} numbers, this one {values.size}: fetch it again")
    if not np.isfinite(values).all():
        raise DataError(f"{path}:1: number {int(np.argmin(np.isfinite(values))) + 1} is not finite: repair the packet")
    return values


def poses_of_oxts(values: Array) -> Array:
    """T_world_body (N, 4, 4), east north up, of OXTS packets (N, 30): Mercator as in KITTI's devkit.

    ``x = s r lon``, ``y = s r log tan(π/4 + lat/2)`` with ``s = cos(lat_0)``; attitude ``Rz(yaw) Ry(pitch) Rx(roll)``,
    yaw from east.
    """
    latitude, longitude = np.radians(values[:, 0]), np.radians(values[:, 1])
    scale = np.cos(latitude[0]) * EARTH_RADIUS
    position = np.stack([scale * longitude, scale * np.log(np.tan(np.pi / 4 + latitude / 2)), values[:, 2]], axis=1)
    axes = np.eye(3)
    roll, pitch, yaw = (so3.exp(values[:, 3 + axis, None] * axes[axis]) for axis in range(3))
    return se3.from_parts(yaw @ pitch @ roll, position - position[0])


def read_klt(path: Path, missing_accel: MissingAccel, gravity: float, exact_ns: Stamps | None = None) -> Packets:
    """A ``_KLT.mat`` file: pose, gyro and velocity of the vehicle at frame rate, without an accelerometer.

    ``theta_vk_i`` is the rotation vector of R_world_body, ``r_i_vk_i`` the position, ``w_vk_vk_i`` and
    ``v_vk_vk_i`` rate and velocity in the vehicle, ``t`` seconds. The world is the vehicle's first frame.

    Args:
        path: the file.
        missing_accel: derive the specific force, or refuse the file.
        gravity: magnitude, for the derived specific force, m/s².
        exact_ns: stamps of the images, of which the file has copies that are rounded to 0.1 ms.

    Raises:
        DataError: missing or damaged file, or no accelerometer while it is not to be derived.
    """
    content = read_mat(path)
    arrays = {}
    for key in ("t", "theta_vk_i", "r_i_vk_i", "w_vk_vk_i", "v_vk_vk_i"):
        if key not in content:
            raise DataError(f"{path}: the variable {key!r} is missing: fetch the file again")
        arrays[key] = np.atleast_2d(np.asarray(content[key], dtype=float)).T
        if not np.isfinite(arrays[key]).all() or len(arrays[key]) != len(arrays["t"]):
            raise DataError(f"{path}: {key} must be finite with {len(arrays['t'])} columns: fetch the file again")
    stamps_ns = np.round(arrays["t"][:, 0] * NANOSECONDS).astype(np.int64)
    if len(stamps_ns) < 10 or np.diff(stamps_ns).min() <= 0:
        raise ClockError(f"{path}: t must be ten or more increasing times in seconds: fetch the file again")
    if exact_ns is not None and len(exact_ns) == len(stamps_ns) and np.abs(exact_ns - stamps_ns).max() < 1_000_000:
        stamps_ns = exact_ns
    if missing_accel == "refuse":
        raise DataError(
            f"{path}: has no accelerometer (gyro, velocity and poses at frame rate only): fetch the oxts folder of "
            "the drive, or set dataset.missing_accel=derive to compute one from velocity and attitude, which leaks the "
            "truth"
        )
    R_world_body = so3.exp(arrays["theta_vk_i"])
    velocity = (R_world_body @ arrays["v_vk_vk_i"][..., None])[..., 0]
    acceleration = spline_velocities(stamps_ns, velocity)
    upward = acceleration + np.array([0.0, 0.0, gravity])
    accel = (np.swapaxes(R_world_body, -1, -2) @ upward[..., None])[..., 0]
    findings = (
        Finding(
            level="bad",
            subject="accelerometer",
            text="none was recorded: it is derived from velocity and true attitude, so no result that uses it is a "
            "measurement; fetch the oxts folder of the drive",
        ),
        Finding(
            level="note",
            subject="imu rate",
            text="gyro at frame rate only: rotation within an image interval is lost",
        ),
        Finding(
            level="note",
            subject="vertical",
            text="the world is the first vehicle frame, as level as the road there (1° to 3°)",
        ),
    )
    truth = Trajectory(
        stamps_ns=stamps_ns,
        T_world_body=se3.from_parts(R_world_body, arrays["r_i_vk_i"]),
        v_world_body=velocity,
    )
    imu = ImuBlock(stamps_ns=stamps_ns, gyro=arrays["w_vk_vk_i"].copy(), accel=accel)
    return Packets(imu=imu, truth=truth, where=str(path), findings=findings)
