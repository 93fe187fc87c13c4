"""``dataset=bag``: bags under a folder, each a sequence."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from vioframe.checks import Array, Stamps, check_pose
from vioframe.conventions import GRAVITY, NANOSECONDS
from vioframe.data import agreement, screening
from vioframe.data.recording import Dataset, Finding
from vioframe.data.selection import (
    STEREO_TOLERANCE_NS,
    FrameSelection,
    as_names,
    check_camera_count,
    check_given,
    check_gravity,
    choose_frames,
    match_stamps,
    sample_span,
)
from vioframe.errors import ClockError, ConfigError, DataError, ShapeError
from vioframe.geometry import se3
from vioframe.types import ImuBlock, SensorRig, Trajectory
from vioframe_bags.bag import IMAGE, IMU, POSE, Bag
from vioframe_bags.calibration import CalibratedCamera, CalibratedImu, read_cameras, read_imu
from vioframe_bags.contents import Contents, collect
from vioframe_bags.messages import image_of, poses_to_matrices
from vioframe_bags.recording import BagRecording, check_size

_TRUTH_ADVICE = "check the calibration, dataset.T_body_truth and dataset.ground_truth_delay_s"


class BagDataset(Dataset):
    """Bags of ROS 1 and ROS 2; the options are those of ``conf/dataset/bag.yaml``, with their meaning."""

    def __init__(
        self,
        *,
        root: str,
        imu_calibration: str,
        sequence: str | Sequence[str] | None = None,
        imu_topic: str | None = None,
        camera_topics: str | Sequence[str] | None = None,
        ground_truth_topic: str | None = None,
        camera_calibration: str | Sequence[str] | None = None,
        T_body_truth: Sequence[Sequence[float]] | None = None,
        ground_truth_delay_s: float = 0.0,
        images: bool = True,
        cameras: int = 1,
        color: bool = False,
        mono16_bits: int = 16,
        every: int = 1,
        start_s: float = 0.0,
        duration_s: float | None = None,
        camera_delay_s: float | None = None,
        gravity: float = GRAVITY,
    ) -> None:
        if not 8 <= mono16_bits <= 16:
            raise ConfigError(f"dataset.mono16_bits must be from 8 to 16, got {mono16_bits}")
        self._camera_count = check_camera_count(cameras)
        self._selection = FrameSelection(every=every, start_s=start_s, duration_s=duration_s)
        advice = "dataset=bag needs a .bag, .mcap or .db3 file, a folder with metadata.yaml, or a folder of such"
        self._root = Path(check_given("root", root, advice)).expanduser()
        self._bags = find_bags(self._root)
        self._names = self._choose(as_names(sequence))
        advice = "set it to Kalibr's imu.yaml or EuRoC's imu0/sensor.yaml"
        self._imu_calibration = self._locate(check_given("imu_calibration", imu_calibration, advice))
        self._camera_calibration = [self._locate(path) for path in as_names(camera_calibration)]
        self._imu_topic = imu_topic
        self._camera_topics = as_names(camera_topics)
        self._truth_topic = ground_truth_topic
        self._T_truth_body = _invert(T_body_truth)
        self._truth_delay_ns = round(ground_truth_delay_s * NANOSECONDS)
        self._images = images
        self._color = color
        self._mono16_bits = mono16_bits
        self._camera_delay_s = camera_delay_s
        self._gravity = check_gravity(gravity)

    @property
    def sequences(self) -> Sequence[str]:
        """Names of the bags."""
        return list(self._names)

    def open(self, sequence: str) -> BagRecording:
        """Read one bag through, and check it.

        Raises:
            DataError: what is wrong, in which topic at which stamp, and what to do.
        """
        calibrated_imu = read_imu(self._imu_calibration)
        calibrated = read_cameras(self._camera_calibration, calibrated_imu.T_body_imu)
        findings = [_good("calibration", f"noise from {self._imu_calibration.name}; cameras: {len(calibrated)}")]
        bag = Bag(self._bags[sequence])
        imu_topic, topics = self._topics(bag, calibrated_imu, calibrated, findings)
        contents = collect(bag, imu_topic, topics, self._truth_topic)
        where = f"{bag.path}: {imu_topic}"
        imu = contents.imu_block(where)
        noise = calibrated_imu.noise
        findings += screening.check_samples(imu, where, noise.rate_hz)
        findings.append(screening.check_gaps(imu.stamps_ns, _longest_step_ns(imu)))
        truth = self._truth(bag, contents, imu, findings)
        if truth is not None:
            findings += agreement.check_with_truth(imu, truth, where, advice=_TRUTH_ADVICE)
        delay_ns = self._delay(calibrated, findings)
        all_stamps_ns = contents.image_stamps(topics, str(bag.path))
        pairs = _pair(bag, topics, all_stamps_ns, findings)
        kept, found = choose_frames(
            all_stamps_ns[0][pairs[0]],
            imu,
            self._selection,
            delay_ns=delay_ns,
            where=f"{bag.path}: {topics[0]}",
            truth=truth,
        )
        findings += found
        rows = [one[kept] for one in pairs]
        stamps_ns = [stamps[chosen] for stamps, chosen in zip(all_stamps_ns, rows, strict=True)]
        before = [np.array(counts)[chosen] for counts, chosen in zip(contents.imu_before, rows, strict=True)]
        start, end = sample_span(imu, stamps_ns[0] + delay_ns)
        rig = SensorRig(
            cameras=tuple(one.camera for one in calibrated[: len(topics)]),
            imu=noise,
            gravity=self._gravity,
            camera_delay_ns=delay_ns,
            has_images=self._images,
        )
        if self._images:
            self._check_first_images(bag, topics, rig, findings)
        return BagRecording(
            name=sequence,
            bag=bag,
            rig=rig,
            imu=imu.cut(start, end),
            topics=topics,
            stamps_ns=stamps_ns,
            arrived=np.clip(np.max(before, axis=0) - start, 0, end - start),
            truth=truth,
            findings=findings,
            color=self._color,
            mono16_bits=self._mono16_bits,
        )

    def _choose(self, wanted: list[str]) -> list[str]:
        # The name of a file is as good as that of its sequence.
        names = {path.name: name for name, path in self._bags.items()} | {name: name for name in self._bags}
        missing = [name for name in wanted if name not in names]
        if missing:
            raise DataError(
                f"{self._root}: there is no bag {missing[0]} here (dataset.sequence); there are {', '.join(self._bags)}"
            )
        return [names[name] for name in wanted] or list(self._bags)

    def _locate(self, path: str) -> Path:
        """A calibration file, relative to the folder of the bags unless it is absolute or found from here."""
        given = Path(path).expanduser()
        folder = self._root if self._root.is_dir() else self._root.parent
        return given if given.is_absolute() or given.exists() else folder / given

    def _topics(
        self, bag: Bag, imu: CalibratedImu, cameras: list[CalibratedCamera], findings: list[Finding]
    ) -> tuple[str, list[str]]:
        """Topics of the IMU and of the cameras to stream, checked against the bag."""
        imu_topic = self._imu_topic or imu.topic or _only(bag, IMU, "dataset.imu_topic")
        bag.require(imu_topic, IMU, "dataset.imu_topic")
        # Without images only the stamps of camera 0 are needed.
        count = self._camera_count if self._images else 1
        named = [camera.topic for camera in cameras if camera.topic]
        topics = (self._camera_topics or named or [_only(bag, IMAGE, "dataset.camera_topics")])[:count]
        if len(topics) < count:
            raise ConfigError(
                f"dataset.camera_topics={topics[0]} names 1 camera, but rig=stereo needs 2: name both topics, or set "
                "rig=mono"
            )
        if len(set(topics)) < len(topics):
            raise ConfigError(f"dataset.camera_topics names {topics[0]} twice: name two topics")
        for topic in topics:
            bag.require(topic, IMAGE, "dataset.camera_topics")
        if self._truth_topic is not None:
            bag.require(self._truth_topic, POSE, "dataset.ground_truth_topic")
        if self._images and len(cameras) < count:
            raise ConfigError(
                f"dataset.camera_calibration holds {len(cameras)} of the {count} cameras that are used: set it to "
                "Kalibr's camchain-imucam file, or to one sensor.yaml a camera"
            )
        for topic, camera in zip(topics, cameras, strict=False):
            if camera.topic and camera.topic != topic:
                text = f"{topic} is taken as the camera that the calibration calls {camera.topic}"
                findings.append(Finding(level="note", subject="camera calibration", text=text))
        return imu_topic, topics

    def _delay(self, cameras: list[CalibratedCamera], findings: list[Finding]) -> int:
        if self._camera_delay_s is not None:
            return round(self._camera_delay_s * NANOSECONDS)
        delay_ns = cameras[0].delay_ns if cameras else None
        if delay_ns:
            findings.append(_good("camera delay", f"{delay_ns / 1e6:.3f} ms, from the calibration"))
        return delay_ns or 0

    def _check_first_images(self, bag: Bag, topics: list[str], rig: SensorRig, findings: list[Finding]) -> None:
        """Decode images of each camera until one is right; refuse an encoding or a size that will never be."""
        for topic, camera in zip(topics, rig.cameras, strict=True):
            problem = None
            for attempt, message in enumerate(bag.read([topic])):
                try:
                    image = image_of(message.decode(), message.kind, color=self._color, mono16_bits=self._mono16_bits)
                    check_size(image, camera)
                except DataError as error:
                    problem = error
                    if attempt < 4:
                        continue
                else:
                    problem = None
                break
            if problem is not None:
                raise DataError(f"{bag.path}: {topic}: {problem}: use another topic or calibration") from problem
            size = camera.size_px
            findings.append(_good("images", f"{topic}: {size[0]}×{size[1]} px, as calibrated"))

    def _truth(self, bag: Bag, contents: Contents, imu: ImuBlock, findings: list[Finding]) -> Trajectory | None:
        if self._truth_topic is None:
            text = "dataset.ground_truth_topic is not set: errors cannot be told"
            findings.append(Finding(level="note", subject="ground truth", text=text))
            return None
        rows: Array = np.array(contents.truth_rows).reshape(-1, 7)
        received: Stamps = np.array(contents.truth_stamps_ns, dtype=np.int64)
        bad = ~np.isfinite(rows).all(axis=1) | (np.linalg.norm(rows[:, 3:], axis=1) < 0.5)
        if bad.any():
            raise DataError(
                f"{bag.path}: {self._truth_topic}: the pose at stamp {int(received[np.argmax(bad)])} is not finite or "
                "has no unit quaternion: filter the topic, or set dataset.ground_truth_topic=null"
            )
        # Motion capture repeats poses while it sees nothing new; a stamp is taken once.
        stamps_ns, first = np.unique(received, return_index=True)
        if len(stamps_ns) < len(received):
            text = f"{len(received) - len(stamps_ns)} of {len(received)} poses repeat a stamp and are left out"
            findings.append(Finding(level="note", subject="ground truth stamps", text=text))
        stamps_ns = stamps_ns + self._truth_delay_ns
        poses = poses_to_matrices(rows[first, :3], rows[first, 3:]) @ self._T_truth_body
        inside = (stamps_ns >= imu.stamps_ns[0]) & (stamps_ns <= imu.stamps_ns[-1])
        if inside.sum() < 2:
            raise ClockError(
                f"{bag.path}: {self._truth_topic} runs from {int(stamps_ns[0])} to {int(stamps_ns[-1])} ns, outside of "
                f"the IMU ({int(imu.stamps_ns[0])} to {int(imu.stamps_ns[-1])} ns): set dataset.ground_truth_delay_s, "
                "or dataset.ground_truth_topic=null"
            )
        findings.append(_good("ground truth topic", self._truth_topic))
        return Trajectory(stamps_ns=stamps_ns, T_world_body=poses)


def _good(subject: str, text: str) -> Finding:
    return Finding(level="good", subject=subject, text=text)


def _longest_step_ns(imu: ImuBlock) -> int:
    """A longer step is a hole: drivers jitter, by up to a period where the computer is busy."""
    return round(3.0 * float(np.median(np.diff(imu.stamps_ns))))


def _pair(bag: Bag, topics: list[str], stamps_ns: list[Stamps], findings: list[Finding]) -> list[Stamps]:
    """By camera the images (F,) that belong together.

    Raises:
        ClockError: none do.
    """
    if len(topics) == 1:
        return [np.arange(len(stamps_ns[0]))]
    left, right = match_stamps(*stamps_ns)
    unmatched = len(stamps_ns[0]) - len(left)
    if not len(left):
        raise ClockError(
            f"{bag.path}: no image of {topics[1]} is within {STEREO_TOLERANCE_NS / 1e6:g} ms of one of {topics[0]}: "
            "the two cameras do not form pairs; set rig=mono"
        )
    if unmatched:
        text = f"{unmatched} of {len(stamps_ns[0])} images of {topics[0]} have no partner and are left out"
        findings.append(Finding(level="note", subject="stereo pairs", text=text))
    return [left, right]


def _invert(T_body_truth: Sequence[Sequence[float]] | None) -> Array:
    if T_body_truth is None:
        return np.eye(4)
    try:
        T = np.array(T_body_truth, dtype=float)
        check_pose("dataset.T_body_truth", T, tolerance=1e-4)
    except (TypeError, ValueError, ShapeError) as error:
        raise ConfigError(f"dataset.T_body_truth must be four rows of four that form a rigid motion: {error}") from None
    return se3.inverse(T)


def _only(bag: Bag, kinds: Sequence[str], option: str) -> str:
    """The one topic of such messages.

    Raises:
        ConfigError: there is none, or several.
    """
    fitting = sorted(name for name, topic in bag.topics.items() if topic.kind in kinds)
    if len(fitting) != 1:
        there = ", ".join(fitting or sorted(bag.topics))
        raise ConfigError(f"{bag.path}: {option} is not set, and the bag does not settle it: its topics are {there}")
    return fitting[0]


def find_bags(root: Path) -> dict[str, Path]:
    """Bags by the name of their sequence: ``root`` itself, or all in it.

    Raises:
        DataError: there is none.
    """
    if not root.exists():
        raise DataError(f"{root}: no such file or folder (dataset.root): correct the path")
    candidates = [root] if _is_bag(root) else sorted(path for path in root.iterdir() if _is_bag(path))
    if not candidates:
        raise DataError(
            f"{root}: no bag here (dataset.root): a .bag, .mcap or .db3 file or a folder with metadata.yaml is expected"
        )
    stems = [path.stem if path.is_file() else path.name for path in candidates]
    return {stem if stems.count(stem) == 1 else path.name: path for stem, path in zip(stems, candidates, strict=True)}


def _is_bag(path: Path) -> bool:
    if path.is_dir():
        return (path / "metadata.yaml").exists()
    return path.suffix in (".bag", ".mcap", ".db3")
