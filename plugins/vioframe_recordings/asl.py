"""The ASL folder layout: ``mav0/{cam0,cam1,imu0}`` with ``data.csv`` and ``sensor.yaml``, and a truth beside them.

Layout: Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR 2016, section 5.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, Literal, get_args

import numpy as np

from vioframe.checks import Array, Stamps
from vioframe.data import agreement, screening
from vioframe.data.calibration import camera_of_sensor, imu_of_sensor, motion_of, read_yaml
from vioframe.data.recording import Finding
from vioframe.data.selection import (
    STEREO_TOLERANCE_NS,
    FrameSelection,
    as_names,
    choose_frames,
    match_stamps,
)
from vioframe.errors import ClockError, ConfigError, DataError
from vioframe.geometry import se3
from vioframe.trajectory_io import read_trajectory
from vioframe.types import Camera, ImuNoise, Trajectory
from vioframe_recordings.asl_files import find_truth, has_truth, read_frame_list, read_imu, sequences_under
from vioframe_recordings.folders import find_images
from vioframe_recordings.gaps import GapPolicy, GapTreatment, PartedDataset
from vioframe_recordings.stored import StoredRecording, check_first_images

Calibration = Literal["auto", "files", "published"]

_NO_CALIBRATION = "fetch it, or set dataset.calibration=published if the sensors are those of the data set"


@dataclass(frozen=True, slots=True, kw_only=True)
class Profile:
    """What is particular to one data set in this layout.

    Attributes:
        key: name in the configuration, for messages.
        title: name of the data set, for messages.
        truth_files: where the ground truth is, under ``mav0``, by the value of ``dataset.ground_truth``; the
            first pattern that exists is taken.
        imu: published noise densities.
        cameras: published calibration.
        source: where the published calibration comes from.
    """

    key: str
    title: str
    truth_files: Mapping[str, tuple[str, ...]]
    imu: ImuNoise
    cameras: tuple[Camera, ...]
    source: str


class AslDataset(PartedDataset):
    """Sequences in ASL folders; the options are those of ``conf/dataset/euroc.yaml``, with their meaning."""

    profile: ClassVar[Profile]

    def __init__(
        self,
        *,
        root: str,
        sequence: str | int | Sequence[str | int] | None = None,
        images: bool = True,
        cameras: int = 1,
        every: int = 1,
        start_s: float = 0.0,
        duration_s: float | None = None,
        calibration: Calibration = "auto",
        ground_truth: str = "default",
        camera_delay_s: float = 0.0,
        gravity: float = 9.81,
        gap_policy: GapPolicy = "keep",
        max_gap_s: float = 0.05,
        max_fill_s: float = 0.5,
    ) -> None:
        if calibration not in get_args(Calibration):
            raise ConfigError(
                f"dataset.calibration must be one of {', '.join(get_args(Calibration))}, got {calibration!r}"
            )
        super().__init__(
            key=self.profile.key,
            root=root,
            images=images,
            cameras=cameras,
            selection=FrameSelection(every=every, start_s=start_s, duration_s=duration_s),
            camera_delay_s=camera_delay_s,
            gravity=gravity,
        )
        self.calibration = calibration
        self.truth_choice = ground_truth
        self.gap_treatment = GapTreatment(policy=gap_policy, max_gap_s=max_gap_s, max_fill_s=max_fill_s)
        self._chosen = as_names(sequence) or self._all_sequences()

    def open(self, sequence: str) -> StoredRecording:
        """Open and check one sequence.

        Raises:
            DataError: what is wrong, in which file and line, and what to do.
        """
        name, _ = self.gap_treatment.split_name(sequence)
        folder = self._folder(name)
        findings: list[Finding] = []
        streamed = self.camera_count if self.images else 1
        stamps_ns, paths, stamps_file, missing = self._frames(folder, streamed, findings)
        imu, imu_file = read_imu(folder)
        noise, cameras, T_body_imu = self._calibration(folder, findings)
        findings += screening.check_samples(imu, str(imu_file), noise.rate_hz)
        imu, found = self.gap_treatment.treat(imu, sequence, str(imu_file))
        findings += found
        truth = self._truth(folder, T_body_imu, findings)
        if truth is not None:
            findings += agreement.check_with_truth(imu, truth, str(imu_file))
        kept, found = choose_frames(
            stamps_ns, imu, self.selection, delay_ns=self.camera_delay_ns, where=str(stamps_file), truth=truth
        )
        findings += found
        paths = [[files[i] for i in kept] for files in paths]
        rig = self._rig(cameras, noise)
        if self.images:
            self._check_images(folder, paths, rig.cameras, findings)
        return StoredRecording(
            name=sequence,
            rig=rig,
            imu=imu,
            frame_stamps_ns=stamps_ns[kept],
            image_paths=paths,
            truth=truth,
            findings=findings,
            missing_images=missing,
        )

    def _folder(self, name: str) -> Path:
        """``mav0`` of a sequence."""
        candidates = [self.root / name / "mav0", self.root / name]
        if self.root.name == name or (self.root.name == "mav0" and self.root.parent.name == name):
            candidates += [self.root / "mav0", self.root]
        for candidate in candidates:
            if (candidate / "imu0").is_dir():
                return candidate
        there = ", ".join(sequences_under(self.root)) or "none"
        raise DataError(
            f"{self.root / name}: no sequence here (a folder with mav0/imu0 is expected); dataset.sequence={name}, "
            f"sequences under {self.root}: {there}"
        )

    def _all_sequences(self) -> list[str]:
        if (self.root / "mav0" / "imu0").is_dir():
            return [self.root.name]
        if (self.root / "imu0").is_dir():
            return [self.root.parent.name if self.root.name == "mav0" else self.root.name]
        found = sequences_under(self.root)
        for folder in (self.root, self.root / "mav0"):
            if not found and (folder / "cam0").is_dir():
                raise DataError(f"{folder / 'imu0'}: no such folder: without inertial samples there is nothing to run")
        if not found:
            raise DataError(
                f"{self.root}: no sequence here (folders with mav0/imu0 are expected): set dataset.root to the folder "
                f"that holds the sequences of {self.profile.title}"
            )
        return found

    def _imu_stamps(self, name: str) -> Stamps:
        return read_imu(self._folder(name))[0].stamps_ns

    def _calibration(self, folder: Path, findings: list[Finding]) -> tuple[ImuNoise, tuple[Camera, ...], Array]:
        """Noise, all cameras, and T_body_imu of the files (our body is the IMU, theirs need not be)."""
        published = self.profile
        if self.calibration == "published":
            findings.append(_note("calibration", f"published constants of {published.title} ({published.source})"))
            return published.imu, published.cameras, np.eye(4)
        imu_file = folder / "imu0" / "sensor.yaml"
        lenient = self.calibration == "auto"
        T_body_imu: Array
        if lenient and not imu_file.exists():
            noise, T_body_imu = published.imu, np.eye(4)
            findings.append(
                _note("imu noise", f"{imu_file} is missing; published values of {published.title} are used")
            )
        else:
            noise, T_body_imu = imu_of_sensor(read_yaml(imu_file, advice=_NO_CALIBRATION), imu_file)
            findings.append(_good("imu noise", f"from {imu_file}"))
        camera_files = [folder / f"cam{index}" / "sensor.yaml" for index in range(2)]
        needed = self.camera_count if self.images else 0
        present = [path for path in camera_files if path.exists()]
        if lenient and not present and not needed:
            text = f"no sensor.yaml; published values of {published.title} are kept for replay"
            findings.append(_note("camera calibration", text))
            return noise, published.cameras, T_body_imu
        cameras = []
        for index, path in enumerate(camera_files):
            if path.exists() or index < needed:
                cameras.append(camera_of_sensor(read_yaml(path, advice=_NO_CALIBRATION), path, T_body_imu))
                findings.append(_good("camera calibration", f"cam{index} from {path}"))
        return noise, tuple(cameras), T_body_imu

    def _truth(self, folder: Path, T_body_imu: Array, findings: list[Finding]) -> Trajectory | None:
        path = find_truth(folder, self.truth_choice, self.profile.truth_files)
        if path is None:
            text = "not asked for" if self.truth_choice == "none" else "none in this recording: errors cannot be told"
            findings.append(_note("ground truth", text))
            return None
        truth = read_trajectory(path, repeated="refuse")
        beside = path.parent / "sensor.yaml"
        T_sensor_imu = T_body_imu
        if beside.exists():
            T_sensor_imu = se3.inverse(motion_of(read_yaml(beside), beside, "T_BS")) @ T_body_imu
        findings.append(_good("ground truth file", str(path)))
        others = [name for name in self.profile.truth_files if name != "default"]
        better = next((name for name in others if has_truth(folder, name, self.profile.truth_files)), None)
        if self.truth_choice == "default" and better is not None:
            text = f"{better} ground truth lies beside it: dataset.ground_truth={better} takes that"
            findings.append(_note("ground truth choice", text))
        return replace(truth, T_world_body=truth.T_world_body @ T_sensor_imu)

    def _frames(self, folder: Path, count: int, findings: list[Finding]) -> tuple[Stamps, list[list[Path]], Path, int]:
        """Stamps (F,), files by camera, the file of the stamps, and how many frames lack a file."""
        stamps_ns, files, source = read_frame_list(folder / "cam0", images=self.images)
        if not self.images:
            return stamps_ns, [], source, 0
        paths = [files]
        if count == 2:
            other_stamps, other_files, other_source = read_frame_list(folder / "cam1", images=True)
            left, right = match_stamps(stamps_ns, other_stamps)
            unmatched = len(stamps_ns) - len(left)
            if not len(left):
                raise ClockError(
                    f"{other_source}: no stamp is within {STEREO_TOLERANCE_NS / 1e6:g} ms of one in {source}: the two "
                    "cameras do not form pairs; set dataset.cameras=1"
                )
            if unmatched:
                text = f"{unmatched} of {len(stamps_ns)} images of cam0 have no partner and are left out"
                findings.append(_note("stereo pairs", text))
            else:
                findings.append(_good("stereo pairs", f"{len(left)} pairs"))
            stamps_ns = stamps_ns[left]
            paths = [[files[i] for i in left], [other_files[i] for i in right]]
        present = find_images(paths)
        missing = int((~present).sum())
        if not present.any():
            raise DataError(
                f"{paths[0][0]}: no such file, nor any other image that {source} lists: fetch the images, or set "
                "dataset.images=false to run on the stamps alone"
            )
        if missing:
            first = int(np.argmin(present))
            text = f"{missing} of {len(present)} images are not there, the first {paths[0][first].name}"
            findings.append(_note("images", text))
        kept = np.flatnonzero(present)
        return stamps_ns[kept], [[files[i] for i in kept] for files in paths], source, missing

    def _check_images(
        self, folder: Path, paths: list[list[Path]], cameras: tuple[Camera, ...], findings: list[Finding]
    ) -> None:
        where = "published calibration" if self.calibration == "published" else f"{folder / 'cam0' / 'sensor.yaml'}"
        check_first_images(paths, cameras, where)
        size = cameras[0].size_px
        findings.append(_good("images", f"{len(paths[0])} × {len(paths)} of {size[0]}×{size[1]} px, as calibrated"))


def _good(subject: str, text: str) -> Finding:
    return Finding(level="good", subject=subject, text=text)


def _note(subject: str, text: str) -> Finding:
    return Finding(level="note", subject=subject, text=text)
