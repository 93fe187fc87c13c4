"""KITTI raw drives: images with OXTS packets, synchronised at 10 Hz (``_sync``) or as they came (``_extract``, 100 Hz).

Geiger et al., "Vision meets robotics: the KITTI dataset", IJRR 2013, and the data set's own ``dataformat.txt``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from vioframe.checks import Array, Stamps
from vioframe.conventions import NANOSECONDS
from vioframe.data.recording import Dataset, Finding
from vioframe.errors import ClockError, ConfigError, DataError
from vioframe.geometry import se3, so3
from vioframe.types import Camera, ImuBlock, ImuNoise, SensorRig, Trajectory
from vioframe_recordings import gaps, screening
from vioframe_recordings.asl import (
    as_list,
    check_span,
    find_root,
    names_in,
    part_names,
    select_frames,
    split_part,
    take_part,
    trim,
)
from vioframe_recordings.kitti_calibration import (
    projection_matrix,
    read_key_numbers,
    rectified_camera,
    spline_velocities,
)
from vioframe_recordings.stored import StoredRecording, check_first_images

InertialSource = Literal["auto", "extract", "sync", "klt"]
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


class KittiRawDataset(Dataset):
    """Raw drives; the options are those of ``conf/dataset/kitti_raw.yaml``, with their meaning.

    With OXTS packets the world is east, north, up with its origin where the vehicle starts. With a KLT file it is
    the first vehicle frame, level only as far as the road was.
    """

    def __init__(
        self,
        *,
        root: str,
        sequence: str | Sequence[str] | None = None,
        images: bool = True,
        cameras: int = 1,
        color: bool = False,
        every: int = 1,
        start_s: float = 0.0,
        duration_s: float | None = None,
        imu: InertialSource = "auto",
        missing_accel: MissingAccel = "refuse",
        disorder: Disorder = "refuse",
        gap_policy: gaps.GapPolicy = "keep",
        max_gap_s: float = 0.05,
        max_fill_s: float = 0.5,
        camera_delay_s: float = 0.0,
        gravity: float = 9.81,
        gyro_noise: float = 5e-4,
        gyro_walk: float = 1e-5,
        accel_noise: float = 2e-2,
        accel_walk: float = 1e-3,
    ) -> None:
        if cameras not in (1, 2):
            raise ConfigError(f"dataset.cameras must be 1 or 2, got {cameras}")
        check_span(every, start_s, duration_s)
        _check_choice("imu", imu, get_args(InertialSource))
        _check_choice("missing_accel", missing_accel, get_args(MissingAccel))
        _check_choice("disorder", disorder, get_args(Disorder))
        self.root = find_root(root, "kitti_raw")
        self.images = images
        self.camera_count = cameras
        self.color = color
        self.every = every
        self.start_s = start_s
        self.duration_s = duration_s
        self.imu_source = imu
        self.missing_accel = missing_accel
        self.disorder = disorder
        self.gap_policy = gaps.check_policy(gap_policy)
        self.max_gap_ns = round(max_gap_s * NANOSECONDS)
        self.max_fill_ns = round(max_fill_s * NANOSECONDS)
        self.camera_delay_ns = round(camera_delay_s * NANOSECONDS)
        self.gravity = gravity
        self.densities = (gyro_noise, gyro_walk, accel_noise, accel_walk)
        self._chosen = as_list(sequence) or self._all_sequences()
        self._names: list[str] | None = None

    @property
    def sequences(self) -> Sequence[str]:
        """Names of the drives; with ``gap_policy: split`` the parts of each."""
        if self._names is None:
            if self.gap_policy == "split":
                self._names = [part for name in self._chosen for part in self._parts(name)]
            else:
                self._names = list(self._chosen)
        return self._names

    def open(self, sequence: str) -> StoredRecording:
        """Open and check one drive.

        Raises:
            DataError: what is wrong, in which file and line, and what to do.
        """
        name, part = split_part(sequence) if self.gap_policy == "split" else (sequence, None)
        folder = self.root / name[:10] / name
        source = self._source(name, folder)
        packets = self._packets(name, folder, source)
        imu, truth, where = packets.imu, packets.truth, packets.where
        findings = list(packets.findings)
        findings += screening.check_samples(imu, where, 1e9 / float(np.median(np.diff(imu.stamps_ns))))
        if part is None:
            imu, found = gaps.apply_policy(imu, self.gap_policy, self.max_gap_ns, self.max_fill_ns, where)
        else:
            imu, found = take_part(imu, part, self.max_gap_ns, sequence, where)
        findings += found
        # An accelerometer derived from the truth agrees with it by construction.
        findings += screening.check_with_truth(imu, truth, where, vertical=source != "klt")
        stamps_ns, paths, missing, stamps_file = self._frames(name, folder, imu)
        covered, finding = screening.check_frame_clock(stamps_ns, imu, self.camera_delay_ns, stamps_file)
        findings.append(finding)
        kept = select_frames(stamps_ns, covered, self.every, self.start_s, self.duration_s, stamps_file)
        stamps_ns, paths = stamps_ns[kept], [[files[i] for i in kept] for files in paths]
        findings.append(screening.check_frame_steps(stamps_ns))
        findings.append(screening.check_truth_of_frames(stamps_ns + self.camera_delay_ns, truth))
        cameras = self._cameras(name, findings)
        rig_cameras = cameras[: self.camera_count]
        if self.images:
            calibration = str(self.root / name[:10] / "calib_cam_to_cam.txt")
            check_first_images(paths, rig_cameras, calibration, color=self.color)
            findings.append(_finding("good", "images", f"{len(stamps_ns)} × {len(paths)}, as calibrated"))
        gyro_noise, gyro_walk, accel_noise, accel_walk = self.densities
        noise = ImuNoise(
            gyro_noise=gyro_noise,
            gyro_walk=gyro_walk,
            accel_noise=accel_noise,
            accel_walk=accel_walk,
            rate_hz=1e9 / float(np.median(np.diff(imu.stamps_ns))),
        )
        return StoredRecording(
            name=sequence,
            rig=SensorRig(
                cameras=rig_cameras,
                imu=noise,
                gravity=self.gravity,
                camera_delay_ns=self.camera_delay_ns,
                has_images=self.images,
            ),
            imu=trim(imu, stamps_ns + self.camera_delay_ns),
            frame_stamps_ns=stamps_ns,
            image_paths=paths,
            truth=truth,
            findings=findings,
            color=self.color,
            missing_images=missing,
        )

    def _all_sequences(self) -> list[str]:
        drives = {path.name for path in self.root.glob("*/*_drive_*_sync") if path.is_dir()}
        if not self.images:
            drives |= {path.name.removesuffix("_KLT.mat") for path in self.root.glob("*_KLT.mat")}
        if not drives:
            raise DataError(
                f"{self.root}: no drive here (2011_09_26/2011_09_26_drive_0001_sync, say, is expected): set "
                "dataset.root to the folder that holds the days"
            )
        return sorted(drives)

    def _parts(self, name: str) -> list[str]:
        try:
            folder = self.root / name[:10] / name
            stamps_ns = self._packets(name, folder, self._source(name, folder)).imu.stamps_ns
        except DataError:
            # Opening it will say what is wrong; the other drives can still run.
            return [name]
        return part_names(name, stamps_ns, self.max_gap_ns)

    def _source(self, name: str, folder: Path) -> Literal["extract", "sync", "klt"]:
        extract = folder.with_name(name.replace("_sync", "_extract")) / "oxts"
        klt = self.root / f"{name}_KLT.mat"
        there: dict[Literal["extract", "sync", "klt"], bool] = {
            "extract": extract.is_dir(),
            "sync": (folder / "oxts").is_dir() and not name.endswith("_extract"),
            "klt": klt.exists(),
        }
        for source, present in there.items():
            if present and self.imu_source in ("auto", source):
                return source
        raise DataError(
            f"{folder}: no inertial samples for dataset.imu={self.imu_source} (looked for {extract}, {folder / 'oxts'} "
            f"and {klt}): fetch them, or check dataset.root and dataset.sequence"
        )

    def _packets(self, name: str, folder: Path, source: Literal["extract", "sync", "klt"]) -> Packets:
        if source == "klt":
            listing = folder / "image_00" / "timestamps.txt"
            stamps_ns = read_date_stamps(listing, what="frame stamps") if listing.exists() else None
            return read_klt(self.root / f"{name}_KLT.mat", self.missing_accel, self.gravity, stamps_ns)
        drive = folder.with_name(name.replace("_sync", "_extract")) if source == "extract" else folder
        return read_oxts(drive / "oxts", self.disorder)

    def _frames(self, name: str, folder: Path, imu: ImuBlock) -> tuple[Stamps, list[list[Path]], int, str]:
        """Stamps (F,), files by camera, how many frames lack a file, and the file of the stamps."""
        first = 2 if self.color else 0
        folders = [folder / f"image_{first + index:02d}" for index in range(self.camera_count)]
        listing = folders[0] / "timestamps.txt"
        if not self.images and not listing.exists():
            return imu.stamps_ns, [], 0, str(self.root / f"{name}_KLT.mat")
        stamps_ns = read_date_stamps(listing, what="frame stamps")
        if not self.images:
            return stamps_ns, [], 0, str(listing)
        present = np.ones(len(stamps_ns), dtype=bool)
        paths = []
        for image_folder in folders:
            names = names_in(image_folder / "data")
            files = [image_folder / "data" / f"{index:010d}.png" for index in range(len(stamps_ns))]
            present &= np.array([path.name in names for path in files])
            paths.append(files)
        kept = np.flatnonzero(present)
        if len(kept) < 2:
            raise DataError(
                f"{paths[-1][0].parent}: has images of {len(kept)} of {len(stamps_ns)} frames: fetch them, or set "
                "dataset.images=false"
            )
        missing = len(stamps_ns) - len(kept)
        return stamps_ns[kept], [[files[i] for i in kept] for files in paths], missing, str(listing)

    def _cameras(self, name: str, findings: list[Finding]) -> tuple[Camera, ...]:
        day = self.root / name[:10]
        if not day.is_dir() and not self.images:
            findings.append(_finding("note", "camera calibration", f"no {day}; none is kept for replay"))
            return ()
        indices = (2, 3) if self.color else (0, 1)
        build = raw_cameras if name.endswith("_extract") else rectified_cameras
        cameras = build(day, indices)
        findings.append(_finding("good", "camera calibration", f"{day}/calib_*.txt"))
        return cameras


def _finding(level: Literal["good", "note", "bad"], subject: str, text: str) -> Finding:
    return Finding(level=level, subject=subject, text=text)


def _check_choice(key: str, value: str, allowed: tuple[str, ...]) -> None:
    if value not in allowed:
        raise ConfigError(f"dataset.{key} must be one of {', '.join(allowed)}, got {value!r}")


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
        findings.append(_finding("note", "imu order", text))
    stamps_ns, values = stamps_ns[in_order], values[in_order]
    if len(stamps_ns) < 10:
        raise DataError(f"{folder}: {len(stamps_ns)} packets in order are too few for a recording: fetch it again")
    findings.append(_finding("good", "ground truth file", f"{folder} (the OXTS' own position and attitude)"))
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
    position = np.stack(
        [scale * longitude, scale * np.log(np.tan(np.pi / 4 + latitude / 2)), values[:, 2]], axis=1
    )
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
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    try:
        content: Mapping[str, Array] = loadmat(path)
    except (MatReadError, ValueError, NotImplementedError, OSError, TypeError, EOFError) as error:
        raise DataError(f"{path}: cannot be read as a MATLAB 5 file ({error}): fetch it again") from None
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
        _finding(
            "bad",
            "accelerometer",
            "none was recorded: it is derived from velocity and true attitude, so no result that uses it is a "
            "measurement; fetch the oxts folder of the drive",
        ),
        _finding("note", "imu rate", "gyro at frame rate only: rotation within an image interval is lost"),
        _finding("note", "vertical", "the world is the first vehicle frame, as level as the road there (1° to 3°)"),
    )
    truth = Trajectory(
        stamps_ns=stamps_ns,
        T_world_body=se3.from_parts(R_world_body, arrays["r_i_vk_i"]),
        v_world_body=velocity,
    )
    imu = ImuBlock(stamps_ns=stamps_ns, gyro=arrays["w_vk_vk_i"].copy(), accel=accel)
    return Packets(imu=imu, truth=truth, where=str(path), findings=findings)


def _body_to_cam0(day: Path) -> Array:
    """T_cam0_body (4, 4), of the unrectified camera 0, through the laser scanner."""
    chain = np.eye(4)
    for name in ("calib_imu_to_velo.txt", "calib_velo_to_cam.txt"):
        values = read_key_numbers(day / name, required=("R", "T"))
        chain = se3.from_parts(_matrix(day / name, values, "R"), _sized(day / name, values, "T", 3)) @ chain
    return chain


def _sized(path: Path, values: Mapping[str, Array], key: str, size: int) -> Array:
    if values[key].size != size:
        raise DataError(f"{path}: the key {key!r} should have {size} numbers, got {values[key].size}: repair it")
    return values[key]


def _matrix(path: Path, values: Mapping[str, Array], key: str) -> Array:
    return _sized(path, values, key, 9).reshape(3, 3)


def _size_px(path: Path, values: Mapping[str, Array], key: str) -> tuple[int, int]:
    width, height = _sized(path, values, key, 2)
    return int(width), int(height)


def rectified_cameras(day: Path, indices: tuple[int, int]) -> tuple[Camera, ...]:
    """Rectified cameras of a day, as in ``_sync`` drives: ``p_rect = R_rect_00 T_velo_cam T_imu_velo p_body``.

    Raises:
        DataError: with the file and the key.
    """
    path = day / "calib_cam_to_cam.txt"
    keys = tuple(f"{name}_{index:02d}" for index in indices for name in ("P_rect", "S_rect"))
    values = read_key_numbers(path, required=("R_rect_00", *keys))
    R_rect = _matrix(path, values, "R_rect_00")
    T_rect_body = se3.from_parts(R_rect, np.zeros(3)) @ _body_to_cam0(day)
    return tuple(
        rectified_camera(
            projection_matrix(path, values, f"P_rect_{index:02d}"),
            se3.inverse(T_rect_body),
            _size_px(path, values, f"S_rect_{index:02d}"),
        )
        for index in indices
    )


def raw_cameras(day: Path, indices: tuple[int, int]) -> tuple[Camera, ...]:
    """Unrectified cameras of a day, as in ``_extract`` drives: ``p_i = R_i p_0 + T_i``.

    Raises:
        DataError: with the file and the key.
    """
    path = day / "calib_cam_to_cam.txt"
    keys = tuple(f"{name}_{index:02d}" for index in indices for name in ("K", "D", "S", "R", "T"))
    values = read_key_numbers(path, required=keys)
    T_cam0_body = _body_to_cam0(day)
    cameras = []
    for index in indices:
        K = _matrix(path, values, f"K_{index:02d}")
        T_cam_cam0 = se3.from_parts(_matrix(path, values, f"R_{index:02d}"), _sized(path, values, f"T_{index:02d}", 3))
        cameras.append(
            Camera(
                model="radtan",
                intrinsics_px=np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]),
                distortion=_sized(path, values, f"D_{index:02d}", 5),
                size_px=_size_px(path, values, f"S_{index:02d}"),
                T_body_cam=se3.inverse(T_cam_cam0 @ T_cam0_body),
            )
        )
    return tuple(cameras)
