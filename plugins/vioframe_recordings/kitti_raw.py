"""KITTI raw drives: images with OXTS packets, synchronised at 10 Hz (``_sync``) or as they came (``_extract``, 100 Hz).

Geiger et al., "Vision meets robotics: the KITTI dataset", IJRR 2013, and the data set's own ``dataformat.txt``.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from vioframe.checks import Stamps
from vioframe.data import agreement, screening
from vioframe.data.recording import Finding
from vioframe.data.selection import FrameSelection, as_names, choose_frames
from vioframe.errors import ConfigError, DataError
from vioframe.types import Camera, ImuBlock, ImuNoise
from vioframe_recordings.folders import find_images
from vioframe_recordings.gaps import GapPolicy, GapTreatment, PartedDataset
from vioframe_recordings.kitti_calibration import NOMINAL_RATE_HZ, raw_cameras, rectified_cameras, sample_rate_hz
from vioframe_recordings.kitti_inertial import Disorder, MissingAccel, Packets, read_date_stamps, read_klt, read_oxts
from vioframe_recordings.stored import StoredRecording, check_first_images

InertialSource = Literal["auto", "extract", "sync", "klt"]


class KittiRawDataset(PartedDataset):
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
        gap_policy: GapPolicy = "keep",
        max_gap_s: float = 0.05,
        max_fill_s: float = 0.5,
        camera_delay_s: float = 0.0,
        gravity: float = 9.81,
        gyro_noise: float = 5e-4,
        gyro_walk: float = 1e-5,
        accel_noise: float = 2e-2,
        accel_walk: float = 1e-3,
    ) -> None:
        _check_choice("imu", imu, get_args(InertialSource))
        _check_choice("missing_accel", missing_accel, get_args(MissingAccel))
        _check_choice("disorder", disorder, get_args(Disorder))
        super().__init__(
            key="kitti_raw",
            root=root,
            images=images,
            cameras=cameras,
            selection=FrameSelection(every=every, start_s=start_s, duration_s=duration_s),
            camera_delay_s=camera_delay_s,
            gravity=gravity,
        )
        self.color = color
        self.imu_source = imu
        self.missing_accel = missing_accel
        self.disorder = disorder
        self.noise = ImuNoise(
            gyro_noise=gyro_noise,
            gyro_walk=gyro_walk,
            accel_noise=accel_noise,
            accel_walk=accel_walk,
            rate_hz=NOMINAL_RATE_HZ,
        )
        self.gap_treatment = GapTreatment(policy=gap_policy, max_gap_s=max_gap_s, max_fill_s=max_fill_s)
        self._chosen = as_names(sequence) or self._all_sequences()

    def open(self, sequence: str) -> StoredRecording:
        """Open and check one drive.

        Raises:
            DataError: what is wrong, in which file and line, and what to do.
        """
        name, _ = self.gap_treatment.split_name(sequence)
        folder = self.root / name[:10] / name
        source = self._source(name, folder)
        packets = self._packets(name, folder, source)
        imu, truth, where = packets.imu, packets.truth, packets.where
        noise = replace(self.noise, rate_hz=sample_rate_hz(imu))
        findings = [*packets.findings, *screening.check_samples(imu, where, noise.rate_hz)]
        imu, found = self.gap_treatment.treat(imu, sequence, where)
        findings += found
        # An accelerometer derived from the truth agrees with it by construction.
        findings += agreement.check_with_truth(imu, truth, where, vertical=source != "klt")
        stamps_ns, paths, missing, stamps_file = self._frames(name, folder, imu)
        kept, found = choose_frames(
            stamps_ns, imu, self.selection, delay_ns=self.camera_delay_ns, where=stamps_file, truth=truth
        )
        findings += found
        paths = [[files[i] for i in kept] for files in paths]
        cameras = self._cameras(name, findings)
        rig = self._rig(cameras, noise)
        if self.images:
            calibration = str(self.root / name[:10] / "calib_cam_to_cam.txt")
            check_first_images(paths, rig.cameras, calibration, color=self.color)
            findings.append(_finding("good", "images", f"{len(kept)} × {len(paths)}, as calibrated"))
        return StoredRecording(
            name=sequence,
            rig=rig,
            imu=imu,
            frame_stamps_ns=stamps_ns[kept],
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

    def _imu_stamps(self, name: str) -> Stamps:
        folder = self.root / name[:10] / name
        return self._packets(name, folder, self._source(name, folder)).imu.stamps_ns

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
        names = [f"{index:010d}.png" for index in range(len(stamps_ns))]
        paths = [[image_folder / "data" / name for name in names] for image_folder in folders]
        present = find_images(paths)
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
