"""The ASL folder layout: ``mav0/{cam0,cam1,imu0}`` with ``data.csv`` and ``sensor.yaml``, and a truth beside them.

Layout: Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR 2016, section 5.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal, get_args

import numpy as np

from vioframe.checks import Array, Stamps
from vioframe.conventions import NANOSECONDS
from vioframe.data.recording import Dataset, Finding
from vioframe.errors import ClockError, ConfigError, DataError, ShapeError
from vioframe.geometry import se3
from vioframe.tables import integer_stamps, read_table
from vioframe.trajectory_io import read_trajectory
from vioframe.types import Camera, CameraModel, ImuBlock, ImuNoise, SensorRig, Trajectory
from vioframe_recordings import gaps, screening
from vioframe_recordings.stored import StoredRecording, check_first_images

Calibration = Literal["auto", "files", "published"]

_MODELS: dict[str, CameraModel] = {
    "radial-tangential": "radtan",
    "radtan": "radtan",
    "equidistant": "equidistant",
    "none": "pinhole",
}

STEREO_TOLERANCE_NS = 1_000_000
"""Two images belong together if their stamps are closer; cameras triggered in hardware agree exactly."""

PART_MARK = ".part"
"""Between the name of a sequence and the number of its part, with ``gap_policy: split``."""


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


class AslDataset(Dataset):
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
        gap_policy: gaps.GapPolicy = "keep",
        max_gap_s: float = 0.05,
        max_fill_s: float = 0.5,
    ) -> None:
        key = self.profile.key
        if cameras not in (1, 2):
            raise ConfigError(f"dataset.cameras must be 1 or 2, got {cameras}")
        if calibration not in get_args(Calibration):
            raise ConfigError(
                f"dataset.calibration must be one of {', '.join(get_args(Calibration))}, got {calibration!r}"
            )
        check_span(every, start_s, duration_s)
        self.root = find_root(root, key)
        self.images = images
        self.camera_count = cameras
        self.every = every
        self.start_s = start_s
        self.duration_s = duration_s
        self.calibration = calibration
        self.truth_choice = ground_truth
        self.camera_delay_ns = round(camera_delay_s * NANOSECONDS)
        self.gravity = gravity
        self.gap_policy = gaps.check_policy(gap_policy)
        self.max_gap_ns = round(max_gap_s * NANOSECONDS)
        self.max_fill_ns = round(max_fill_s * NANOSECONDS)
        self._chosen = as_list(sequence) or self._all_sequences()
        self._names: list[str] | None = None

    @property
    def sequences(self) -> Sequence[str]:
        """Names of the sequences; with ``gap_policy: split`` the parts of each."""
        if self._names is None:
            if self.gap_policy == "split":
                self._names = [part for name in self._chosen for part in self._parts(name)]
            else:
                self._names = list(self._chosen)
        return self._names

    def open(self, sequence: str) -> StoredRecording:
        """Open and check one sequence.

        Raises:
            DataError: what is wrong, in which file and line, and what to do.
        """
        name, part = split_part(sequence) if self.gap_policy == "split" else (sequence, None)
        folder = self._folder(name)
        findings: list[Finding] = []
        streamed = self.camera_count if self.images else 1
        stamps_ns, paths, stamps_file, missing = self._frames(folder, streamed, findings)
        imu, imu_file = read_imu(folder)
        noise, cameras, T_body_imu = self._calibration(folder, findings)
        findings += screening.check_samples(imu, str(imu_file), noise.rate_hz)
        if part is None:
            imu, found = gaps.apply_policy(imu, self.gap_policy, self.max_gap_ns, self.max_fill_ns, str(imu_file))
        else:
            imu, found = take_part(imu, part, self.max_gap_ns, sequence, str(imu_file))
        findings += found
        truth = self._truth(folder, T_body_imu, findings)
        if truth is not None:
            findings += screening.check_with_truth(imu, truth, str(imu_file))
        covered, finding = screening.check_frame_clock(stamps_ns, imu, self.camera_delay_ns, str(stamps_file))
        findings.append(finding)
        kept = select_frames(stamps_ns, covered, self.every, self.start_s, self.duration_s, str(stamps_file))
        stamps_ns, paths = stamps_ns[kept], [[files[i] for i in kept] for files in paths]
        findings.append(screening.check_frame_steps(stamps_ns))
        if truth is not None:
            findings.append(screening.check_truth_of_frames(stamps_ns + self.camera_delay_ns, truth))
        rig_cameras = cameras[: self.camera_count]
        if self.images:
            self._check_images(folder, paths, rig_cameras, findings)
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
            image_paths=paths if self.images else (),
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
        if not found:
            raise DataError(
                f"{self.root}: no sequence here (folders with mav0/imu0 are expected): set dataset.root to the folder "
                f"that holds the sequences of {self.profile.title}"
            )
        return found

    def _parts(self, name: str) -> list[str]:
        try:
            imu, _ = read_imu(self._folder(name))
        except DataError:
            # Opening it will say what is wrong; the other sequences can still run.
            return [name]
        return part_names(name, imu.stamps_ns, self.max_gap_ns)

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
            noise, T_body_imu = read_imu_sensor(imu_file)
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
                cameras.append(read_camera_sensor(path, T_body_imu, key=self.profile.key))
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
            T_sensor_imu = se3.inverse(read_extrinsics(beside)) @ T_body_imu
        findings.append(_good("ground truth file", str(path)))
        others = [name for name in self.profile.truth_files if name != "default"]
        better = next((name for name in others if has_truth(folder, name, self.profile.truth_files)), None)
        if self.truth_choice == "default" and better is not None:
            text = f"{better} ground truth lies beside it: dataset.ground_truth={better} takes that"
            findings.append(_note("ground truth choice", text))
        return replace(truth, T_world_body=truth.T_world_body @ T_sensor_imu)

    def _frames(
        self, folder: Path, count: int, findings: list[Finding]
    ) -> tuple[Stamps, list[list[Path]], Path, int]:
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
        present = np.ones(len(stamps_ns), dtype=bool)
        for one_camera in paths:
            folder_names = {p: names_in(p) for p in {path.parent for path in one_camera}}
            present &= np.array([path.name in folder_names[path.parent] for path in one_camera], dtype=bool)
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


def as_list(sequence: str | int | Sequence[str | int] | None) -> list[str]:
    """``dataset.sequence`` as names; YAML makes numbers of names that look like them."""
    if sequence is None:
        return []
    if isinstance(sequence, str | int):
        return [str(sequence)]
    return [str(name) for name in sequence]


def find_root(root: str | None, key: str) -> Path:
    """The folder of ``dataset.root``.

    Raises:
        ConfigError: not set.
        DataError: not there.
    """
    # An option left at ??? arrives as that text.
    if not root or root == "???":
        raise ConfigError(f"dataset.root is not set: dataset={key} needs the folder that holds the sequences")
    path = Path(root).expanduser()
    if not path.is_dir():
        raise DataError(f"{path}: no such folder (dataset.root): check the path, or fetch the data set")
    return path


def sequences_under(root: Path) -> list[str]:
    """Names of the folders with ``mav0/imu0``."""
    return sorted(path.name for path in root.iterdir() if (path / "mav0" / "imu0").is_dir())


def names_in(folder: Path) -> set[str]:
    """Names of the files in a folder; empty where there is none."""
    return {entry.name for entry in folder.iterdir()} if folder.is_dir() else set()


def check_span(every: int, start_s: float, duration_s: float | None) -> None:
    """Refuse options that select no frames.

    Raises:
        ConfigError: names the key.
    """
    if every < 1:
        raise ConfigError(f"dataset.every must be 1 or more, got {every}")
    if start_s < 0.0:
        raise ConfigError(f"dataset.start_s must not be negative, got {start_s}")
    if duration_s is not None and duration_s <= 0.0:
        raise ConfigError(f"dataset.duration_s must be positive or null, got {duration_s}")


def select_frames(
    stamps_ns: Stamps, usable: np.ndarray, every: int, start_s: float, duration_s: float | None, where: str
) -> np.ndarray:
    """Indices of the frames to stream: usable ones in the wanted span, each ``every``-th.

    Raises:
        DataError: fewer than two are left.
    """
    begin = int(stamps_ns[usable][0]) + round(start_s * NANOSECONDS)
    end = begin + round(duration_s * NANOSECONDS) if duration_s is not None else int(stamps_ns[-1])
    kept = np.flatnonzero(usable & (stamps_ns >= begin) & (stamps_ns <= end))[::every]
    if len(kept) < 2:
        raise DataError(
            f"{where}: {len(kept)} of {len(stamps_ns)} frames are left by dataset.start_s={start_s:g}, "
            f"duration_s={duration_s} and every={every}, but two are needed: change them"
        )
    return kept


def trim(imu: ImuBlock, arrivals_ns: Stamps, lead_ns: int = 2 * NANOSECONDS) -> ImuBlock:
    """Samples from ``lead_ns`` before the first frame to just after the last."""
    start = int(np.searchsorted(imu.stamps_ns, arrivals_ns[0] - lead_ns))
    end = int(np.searchsorted(imu.stamps_ns, arrivals_ns[-1], side="left")) + 1
    return gaps.cut(imu, start, min(end, len(imu)))


def split_part(sequence: str) -> tuple[str, int | None]:
    """Name and number of a part, or the name and None."""
    name, mark, number = sequence.rpartition(PART_MARK)
    return (name, int(number)) if mark and number.isdigit() else (sequence, None)


def part_names(name: str, stamps_ns: Stamps, max_gap_ns: int) -> list[str]:
    """Names of the stretches without a hole; the name itself where there is only one."""
    count = len(gaps.stretches(stamps_ns, max_gap_ns))
    return [name] if count < 2 else [f"{name}{PART_MARK}{index}" for index in range(count)]


def take_part(
    imu: ImuBlock, part: int, max_gap_ns: int, sequence: str, where: str
) -> tuple[ImuBlock, list[Finding]]:
    """Samples of one stretch without a hole.

    Raises:
        DataError: there is no such part.
    """
    ranges = gaps.stretches(imu.stamps_ns, max_gap_ns)
    if part >= len(ranges):
        raise DataError(f"{where}: has {len(ranges)} stretches without a hole, so there is no {sequence}")
    start, end = ranges[part]
    text = f"stretch {part + 1} of {len(ranges)} without a hole"
    return gaps.cut(imu, start, end), [_note("imu gaps", text)]


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
        raise DataError(f"{folder}: no such folder; it should hold the images of this camera: check the recording")
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


def match_stamps(left_ns: Stamps, right_ns: Stamps) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the pairs closer than :data:`STEREO_TOLERANCE_NS`, both increasing."""
    after = np.clip(np.searchsorted(right_ns, left_ns), 1, max(len(right_ns) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(right_ns) - 1)
    nearest = np.where(np.abs(right_ns[after] - left_ns) < np.abs(left_ns - right_ns[before]), after, before)
    close = np.abs(right_ns[nearest] - left_ns) <= STEREO_TOLERANCE_NS
    return np.flatnonzero(close), nearest[close]


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


def read_sensor_yaml(path: Path) -> dict[str, Any]:
    """A ``sensor.yaml``; its OpenCV header ``%YAML:1.0`` is not YAML and is passed over.

    Raises:
        DataError: missing or not YAML.
    """
    import yaml

    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise DataError(
            f"{path}: no such file; it should hold the calibration: fetch it, or set dataset.calibration=published if "
            "the sensors are those of the data set"
        ) from None
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: cannot be read as text ({error})") from error
    lines = text.split("\n")
    if lines and lines[0].startswith("%YAML:"):
        lines[0] = ""
    try:
        content = yaml.safe_load("\n".join(lines))
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f":{mark.line + 1}" if mark is not None else ""
        raise DataError(f"{path}{line}: not valid YAML ({getattr(error, 'problem', 'damaged')}): repair it") from None
    if not isinstance(content, dict):
        raise DataError(f"{path}: empty or not a list of keys: fetch the calibration again")
    return content


def _key(content: dict[str, Any], path: Path, key: str) -> Any:
    if key not in content:
        raise DataError(f"{path}: the key {key!r} is missing; the file has {', '.join(map(str, content))}: add it")
    return content[key]


def _numbers(content: dict[str, Any], path: Path, key: str, count: int) -> Array:
    value = _key(content, path, key)
    try:
        numbers = np.array(value, dtype=float).ravel()
    except (TypeError, ValueError):
        raise DataError(f"{path}: the key {key!r} must be {count} numbers, got {value!r}") from None
    if numbers.size != count or not np.isfinite(numbers).all():
        raise DataError(f"{path}: the key {key!r} must be {count} finite numbers, got {value!r}")
    return numbers


def read_extrinsics(path: Path) -> Array:
    """``T_BS`` (4, 4): body from sensor.

    Raises:
        DataError: missing, or not a rigid motion.
    """
    content = read_sensor_yaml(path)
    block = _key(content, path, "T_BS")
    data = block.get("data") if isinstance(block, dict) else block
    T_body_sensor = _numbers({"T_BS": data}, path, "T_BS", 16).reshape(4, 4)
    R = T_body_sensor[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-4 or np.linalg.det(R) < 0:
        raise DataError(f"{path}: T_BS is not a rigid motion (R Rᵀ is not the identity): repair the calibration")
    return T_body_sensor


def read_imu_sensor(path: Path) -> tuple[ImuNoise, Array]:
    """Noise densities, and T_body_imu (4, 4).

    Raises:
        DataError: with the file and the key.
    """
    content = read_sensor_yaml(path)
    names = {
        "gyro_noise": "gyroscope_noise_density",
        "gyro_walk": "gyroscope_random_walk",
        "accel_noise": "accelerometer_noise_density",
        "accel_walk": "accelerometer_random_walk",
        "rate_hz": "rate_hz",
    }
    values = {ours: float(_numbers(content, path, theirs, 1)[0]) for ours, theirs in names.items()}
    try:
        noise = ImuNoise(**values)
    except ShapeError as error:
        raise DataError(f"{path}: {error}") from None
    return noise, read_extrinsics(path) if "T_BS" in content else np.eye(4)


def read_camera_sensor(path: Path, T_body_imu: Array, *, key: str = "euroc") -> Camera:
    """One camera, with its pose in the IMU frame.

    Raises:
        DataError: with the file and the key.
    """
    content = read_sensor_yaml(path)
    model = str(_key(content, path, "distortion_model"))
    if str(_key(content, path, "camera_model")) != "pinhole" or model not in _MODELS:
        raise DataError(
            f"{path}: camera_model={content['camera_model']} with distortion_model={model} is not supported "
            f"(pinhole with {', '.join(_MODELS)}): convert the calibration"
        )
    kind = _MODELS[model]
    distortion: Array = np.zeros(0)
    if kind != "pinhole":
        given = _key(content, path, "distortion_coefficients")
        distortion = _numbers(content, path, "distortion_coefficients", len(given) if isinstance(given, list) else 4)
    size = _numbers(content, path, "resolution", 2)
    try:
        return Camera(
            model=kind,
            intrinsics_px=_numbers(content, path, "intrinsics", 4),
            distortion=distortion,
            size_px=(int(size[0]), int(size[1])),
            T_body_cam=se3.inverse(T_body_imu) @ read_extrinsics(path),
        )
    except ShapeError as error:
        raise DataError(f"{path}: {error}") from None
