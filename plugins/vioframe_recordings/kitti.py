"""KITTI odometry with its inertial samples, which the benchmark itself does not offer.

Sequences and poses are those of the benchmark (Geiger et al., CVPR 2012); the inertial samples are the ``.mat`` files
``imu_data_interp`` that hold ten samples per image interval, interpolated from the unsynchronised OXTS of the raw
drives.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from vioframe.checks import Mask, Stamps
from vioframe.data import agreement, screening
from vioframe.data.recording import Finding
from vioframe.data.selection import FrameSelection, as_names, choose_frames
from vioframe.errors import ConfigError, DataError
from vioframe.geometry import se3
from vioframe.trajectory_io import read_times, read_trajectory
from vioframe.types import Camera, ImuBlock, ImuNoise, Trajectory
from vioframe_recordings.folders import FolderDataset, find_images
from vioframe_recordings.kitti_calibration import (
    NOMINAL_RATE_HZ,
    DriveDate,
    odometry_drive,
    projection_matrix,
    read_key_numbers,
    read_mat,
    rectified_camera,
    sample_rate_hz,
)
from vioframe_recordings.kitti_inventory import Inventory
from vioframe_recordings.kitti_level import check_level, check_vehicle_up, level_by_vehicle, level_world
from vioframe_recordings.stored import StoredRecording, check_first_images

SAMPLES_PER_FRAME = 10


class KittiDataset(FolderDataset):
    """Odometry sequences; the options are those of ``conf/dataset/kitti.yaml``, with their meaning.

    The world has its origin where the vehicle is at frame 0, x along its heading there, and z up as the
    accelerometer says (see :func:`level_world`), or the vehicle itself where there is none.

    Raises:
        ConfigError: an option outside its range.
        DataError: sequences that were asked for are not there, all of which it names.
    """

    def __init__(
        self,
        *,
        root: str,
        sequence: str | int | Sequence[str | int] | None = None,
        images: bool = True,
        cameras: int = 1,
        color: bool = False,
        imu: Literal["required", "none"] = "required",
        stretch: Sequence[float] = (0.0, 1.0),
        every: int = 1,
        start_s: float = 0.0,
        duration_s: float | None = None,
        camera_delay_s: float = 0.065,
        gravity: float = 9.81,
        gyro_noise: float = 5e-4,
        gyro_walk: float = 1e-5,
        accel_noise: float = 2e-2,
        accel_walk: float = 1e-3,
    ) -> None:
        if imu not in ("required", "none"):
            raise ConfigError(f"dataset.imu must be required or none, got {imu!r}")
        super().__init__(
            key="kitti",
            root=root,
            images=images,
            cameras=cameras,
            selection=FrameSelection(every=every, start_s=start_s, duration_s=duration_s, stretch=stretch),
            # Where there are no samples, the camera's clock is the only one.
            camera_delay_s=camera_delay_s if imu == "required" else 0.0,
            gravity=gravity,
        )
        self.color = color
        self.has_imu = imu == "required"
        self.noise = ImuNoise(
            gyro_noise=gyro_noise,
            gyro_walk=gyro_walk,
            accel_noise=accel_noise,
            accel_walk=accel_walk,
            rate_hz=NOMINAL_RATE_HZ,
        )
        # YAML reads 04 as the number 4.
        asked = [name.zfill(2) for name in as_names(sequence)]
        for name in asked:
            _known_drive(name)
        self._files = Inventory(root=self.root, images=images, cameras=self.camera_count, color=color, imu=self.has_imu)
        self._files.check(asked)
        self._names = asked or self._files.find()

    @property
    def sequences(self) -> Sequence[str]:
        """Names of the sequences, two digits each, with the stretch where there is one, such as ``06.90-100``."""
        part = self.selection.part
        return [f"{name}.{part}" for name in self._names] if part else self._names

    def open(self, sequence: str) -> StoredRecording:
        """Open and check one sequence.

        Raises:
            DataError: what is wrong, in which file and line, and what to do.
        """
        number = sequence.partition(".")[0]
        drive = _known_drive(number)
        folder = self.root / "sequences" / number
        findings: list[Finding] = []
        times_file = folder / "times.txt"
        times_ns = read_times(times_file)
        if len(times_ns) < 5:
            raise DataError(f"{times_file}: {len(times_ns)} frames are too few for a recording: fetch the file again")
        imu, noise = self._samples(number, times_ns, findings)
        truth = self._truth(number, drive, imu, times_ns, findings)
        if truth is not None and imu is not None:
            # Levelled by this accelerometer, the vertical of the truth says nothing about it.
            findings += agreement.check_with_truth(imu, truth, str(self._files.imu_file(number)), vertical=False)
            findings.append(check_level(imu, truth))
        usable, paths, missing = self._available(folder, len(times_ns), findings)
        cameras = self._cameras(folder, drive, paths, findings)
        kept, found = choose_frames(
            times_ns,
            imu,
            self.selection,
            delay_ns=self.camera_delay_ns,
            where=str(times_file),
            truth=truth,
            usable=usable,
        )
        findings += found
        paths = [[files[i] for i in kept] for files in paths]
        rig = replace(self._rig(cameras, noise), has_imu=self.has_imu)
        if self.images:
            check_first_images(paths, rig.cameras, f"recording day {drive.date}", color=self.color)
        return StoredRecording(
            name=sequence,
            rig=rig,
            imu=ImuBlock.none() if imu is None else imu,
            frame_stamps_ns=times_ns[kept],
            image_paths=paths,
            truth=truth,
            findings=findings,
            color=self.color,
            missing_images=missing,
        )

    def _samples(self, sequence: str, times_ns: Stamps, findings: list[Finding]) -> tuple[ImuBlock | None, ImuNoise]:
        """Inertial samples, checked, or None where none are wanted, and their noise."""
        if not self.has_imu:
            findings.append(Finding(level="note", subject="inertial samples", text="not read (dataset.imu=none)"))
            return None, self.noise
        path = self._files.imu_file(sequence)
        imu = read_imu_mat(path, times_ns)
        noise = replace(self.noise, rate_hz=sample_rate_hz(imu))
        findings += screening.check_samples(imu, str(path), noise.rate_hz)
        findings.append(check_vehicle_up(imu, str(path)))
        return imu, noise

    def _image_folders(self, folder: Path) -> list[Path]:
        first = 2 if self.color else 0
        return [folder / f"image_{first + index}" for index in range(self.camera_count)]

    def _available(self, folder: Path, count: int, findings: list[Finding]) -> tuple[Mask, list[list[Path]], int]:
        """Which frames have all their images, the files by camera, and how many are missing in between."""
        if not self.images:
            return np.ones(count, dtype=bool), [], 0
        names = [f"{index:06d}.png" for index in range(count)]
        paths = [[image_folder / name for name in names] for image_folder in self._files.image_folders(folder.name)]
        usable = find_images(paths)
        if usable.sum() < 2:
            # The camera that lacks most is the one to name.
            emptiest = min(paths, key=lambda files: int(find_images([files]).sum()))
            advice = "use one camera (rig=mono), or set" if len(paths) > 1 else "or set"
            raise DataError(
                f"{emptiest[0].parent}: has images of {int(find_images([emptiest]).sum())} of {count} frames: fetch "
                f"them, {advice} dataset.images=false to run on the stamps alone"
            )
        there = np.flatnonzero(usable)
        missing = int(there[-1] - there[0] + 1 - len(there))
        level_text = f"{len(there)} of {count} frames have images"
        complete = len(there) == count
        findings.append(Finding(level="good" if complete else "note", subject="images", text=level_text))
        return usable, paths, missing

    def _cameras(
        self, folder: Path, drive: DriveDate, paths: list[list[Path]], findings: list[Finding]
    ) -> tuple[Camera, ...]:
        path = folder / "calib.txt"
        keys = ("P2", "P3") if self.color else ("P0", "P1")
        values = read_key_numbers(path, required=keys)
        cameras = tuple(
            rectified_camera(projection_matrix(path, values, key), drive.T_body_cam0, drive.size_px) for key in keys
        )
        text = f"{path} ({', '.join(keys)}) and the extrinsics of {drive.date}"
        findings.append(Finding(level="good", subject="camera calibration", text=text))
        return cameras

    def _truth(
        self, sequence: str, drive: DriveDate, imu: ImuBlock | None, times_ns: Stamps, findings: list[Finding]
    ) -> Trajectory | None:
        path = self.root / "poses" / f"{sequence}.txt"
        if not path.exists():
            text = f"no {path}; the world cannot be levelled, and errors cannot be told"
            findings.append(Finding(level="note", subject="ground truth", text=text))
            return None
        poses = read_trajectory(path, "kitti", stamps=times_ns + self.camera_delay_ns)
        if len(poses) != len(times_ns):
            raise DataError(
                f"{path}: {len(poses)} poses for {len(times_ns)} frames in times.txt: the files are not of one sequence"
            )
        T_ref_body = poses.T_world_body @ se3.inverse(drive.T_body_cam0)
        if imu is None:
            truth, how = level_by_vehicle(poses.stamps_ns, T_ref_body), "the vehicle's mean upright axis"
        else:
            truth, up_size = level_world(poses.stamps_ns, T_ref_body, imu)
            how = f"the mean specific force (|g| {up_size:.3f} m/s²)"
        text = f"{path}, levelled by {how}; velocity from a spline"
        findings.append(Finding(level="good", subject="ground truth file", text=text))
        return truth


def _known_drive(sequence: str) -> DriveDate:
    drive = odometry_drive(sequence)
    if drive is None:
        raise DataError(
            f"dataset.sequence={sequence}: the camera-to-vehicle calibration of this sequence is not known "
            "(00 to 10 are): take one of those"
        )
    return drive


def read_imu_mat(path: Path, times_ns: Stamps) -> ImuBlock:
    """Samples of ``imu_data_interp`` (10·(frames − 1) + 1, 6): ax ay az gx gy gz, m/s² and rad/s, vehicle.

    The k-th interval of images holds ten samples evenly spaced from its first stamp on: the step is
    ``diff(times) / 10``, about 10.38 ms, not 10 ms.

    Raises:
        DataError: missing or damaged file, another number of samples, NaN.
    """
    if not path.is_file():
        raise DataError(
            f"{path}: no such file; it should hold the inertial samples of this sequence, ten an image interval: fetch "
            "it, or take another sequence"
        )
    content = read_mat(path)
    names = [name for name in content if not name.startswith("__")]
    if "imu_data_interp" not in names:
        raise DataError(f"{path}: the variable 'imu_data_interp' is missing; the file has {', '.join(names) or 'none'}")
    samples = np.asarray(content["imu_data_interp"], dtype=float)
    wanted = SAMPLES_PER_FRAME * (len(times_ns) - 1) + 1
    if samples.shape != (wanted, 6):
        raise DataError(
            f"{path}: imu_data_interp has shape {samples.shape}, but {len(times_ns)} frames need ({wanted}, 6): "
            "the file is not of this sequence, or is truncated"
        )
    if not np.isfinite(samples).all():
        row, column = (int(i) for i in np.argwhere(~np.isfinite(samples))[0])
        raise DataError(f"{path}: row {row + 1}, column {column + 1} of imu_data_interp is {samples[row, column]}")
    steps = np.diff(times_ns)[:, None]
    inner = times_ns[:-1, None] + steps * np.arange(SAMPLES_PER_FRAME) // SAMPLES_PER_FRAME
    stamps_ns = np.concatenate([inner.ravel(), times_ns[-1:]])
    return ImuBlock(stamps_ns=stamps_ns, gyro=samples[:, 3:].copy(), accel=samples[:, :3].copy())
