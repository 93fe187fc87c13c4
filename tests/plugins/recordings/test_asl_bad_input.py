"""Whatever is wrong with a recording is told when it is opened: one sentence with the file, and the line."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from vioframe.errors import ClockError, ConfigError, DataError, VioframeError
from vioframe_recordings import EurocDataset

Change = Callable[[Path], None]


def edit_row(file: str, row: int, change: Callable[[str], str | None]) -> Change:
    """Change one data row (0 is the first); None removes it."""

    def apply(mav0: Path) -> None:
        path = mav0 / file
        lines = path.read_text().split("\n")
        index = row + 1
        changed = change(lines[index])
        lines[index : index + 1] = [] if changed is None else [changed]
        path.write_text("\n".join(lines))

    return apply


def edit_columns(file: str, change: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Change all numbers behind the stamp."""

    def apply(mav0: Path) -> None:
        path = mav0 / file
        lines = []
        for line in path.read_text().split("\n"):
            if line and not line.startswith("#"):
                stamp, *rest = line.split(",")
                values = change(np.array([float(v) for v in rest]))
                line = ",".join([stamp, *(repr(float(v)) for v in values)])
            lines.append(line)
        path.write_text("\n".join(lines))

    return apply


def edit_stamps(file: str, change: Callable[[int], str]) -> Change:
    def apply(mav0: Path) -> None:
        path = mav0 / file
        lines = []
        for line in path.read_text().split("\n"):
            if line and not line.startswith("#"):
                stamp, comma, rest = line.partition(",")
                line = change(int(stamp)) + comma + rest
            lines.append(line)
        path.write_text("\n".join(lines))

    return apply


def replace(file: str, old: str, new: str) -> Change:
    def apply(mav0: Path) -> None:
        path = mav0 / file
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new))

    return apply


def write(file: str, text: str) -> Change:
    return lambda mav0: (mav0 / file).write_text(text) and None


def remove(file: str) -> Change:
    return lambda mav0: (mav0 / file).unlink()


def without_truth(change: Change) -> Change:
    def apply(mav0: Path) -> None:
        remove("state_groundtruth_estimate0/data.csv")(mav0)
        change(mav0)

    return apply


def spoil_images(mav0: Path) -> None:
    for path in (mav0 / "cam0" / "data").iterdir():
        path.write_bytes(path.read_bytes()[:60])


def remove_images(mav0: Path) -> None:
    for path in (mav0 / "cam0" / "data").iterdir():
        path.unlink()
    (mav0 / "cam0" / "data").rmdir()


def to_degrees(values: np.ndarray) -> np.ndarray:
    return np.concatenate([np.degrees(values[:3]), values[3:]])


def first_stamp(line: str) -> str:
    return line.partition(",")[0]


IMU = "imu0/data.csv"
CAM = "cam0/data.csv"
TRUTH = "state_groundtruth_estimate0/data.csv"

CASES: dict[str, tuple[Change, type[VioframeError], str]] = {
    "missing imu file": (remove(IMU), DataError, r"imu0/data.csv: no such file"),
    "empty imu file": (write(IMU, ""), DataError, r"imu0/data.csv: empty"),
    "imu header only": (write(IMU, "#timestamp\n"), DataError, r"imu0/data.csv: empty"),
    "truncated row": (edit_row(IMU, 598, lambda r: r[:40]), DataError, r"imu0/data.csv:600: .*columns"),
    "wrong columns": (write(IMU, "1,2,3\n"), DataError, r"imu0/data.csv:1: .*7 columns, got 3"),
    "nan row": (edit_row(IMU, 9, lambda r: f"{first_stamp(r)},nan,0,0,0,0,9.8"), DataError, r"data.csv:11: .*nan"),
    "not a number": (edit_row(IMU, 9, lambda r: f"{first_stamp(r)},a,0,0,0,0,9.8"), DataError, r":11: .*'a'"),
    "repeated stamp": (edit_row(IMU, 5, lambda r: f"{r}\n{r}"), ClockError, r"data.csv:8: .*repeats"),
    "stamp goes back": (
        edit_row(IMU, 5, lambda r: f"{int(first_stamp(r)) - 10_000_000}{r[19:]}"),
        ClockError,
        r"data.csv:7: .*earlier",
    ),
    "imu in seconds": (edit_stamps(IMU, lambda s: f"{s / 1e9:.6f}"), ClockError, r"data.csv:2: .*nanoseconds"),
    "imu in microseconds": (edit_stamps(IMU, lambda s: str(s // 1000)), ClockError, r"do not overlap"),
    "camera in seconds": (edit_stamps(CAM, lambda s: f"{s / 1e9:.6f}"), ClockError, r"cam0/data.csv:2: .*nanoseconds"),
    "camera stamp repeated": (edit_row(CAM, 3, lambda r: f"{r}\n{r}"), ClockError, r"cam0/data.csv:6: .*repeats"),
    "camera row truncated": (edit_row(CAM, 4, lambda r: r[:19]), DataError, r"cam0/data.csv:6: .*truncated"),
    "camera list empty": (write(CAM, "#timestamp\n"), DataError, r"cam0/data.csv: empty"),
    "clocks apart": (
        edit_stamps(CAM, lambda s: str(s + 10**12)),
        ClockError,
        r"cam0/data.csv: .*do not overlap",
    ),
    "gyro in degrees": (edit_columns(IMU, to_degrees), DataError, r"imu0/data.csv: .*rad/s"),
    "gyro in degrees, no truth": (
        without_truth(edit_columns(IMU, to_degrees)),
        DataError,
        r"imu0/data.csv: .*degrees per second",
    ),
    "accelerometer in g": (
        edit_columns(IMU, lambda v: np.concatenate([v[:3], v[3:] / 9.81])),
        DataError,
        r"multiples of g",
    ),
    "gravity taken out": (
        edit_columns(IMU, lambda v: np.concatenate([v[:3], v[3:] - [0, 0, 9.81]])),
        DataError,
        r"gravity seems to be taken out",
    ),
    "accelerometer axes swapped": (
        edit_columns(IMU, lambda v: v[[0, 1, 2, 5, 3, 4]]),
        DataError,
        r"imu0/data.csv: .*axes are swapped",
    ),
    "accelerometer upside down": (
        edit_columns(IMU, lambda v: np.concatenate([v[:3], -v[3:]])),
        DataError,
        r"sign is turned over",
    ),
    "missing calibration": (remove("cam0/sensor.yaml"), DataError, r"cam0/sensor.yaml: no such file"),
    "missing key": (replace("cam0/sensor.yaml", "intrinsics:", "other:"), DataError, r"cam0/sensor.yaml: .*intrinsics"),
    "missing noise key": (
        replace("imu0/sensor.yaml", "gyroscope_noise_density", "x"),
        DataError,
        r"imu0/sensor.yaml: .*gyroscope_noise_density",
    ),
    "calibration no rotation": (
        replace("cam0/sensor.yaml", "data: [1.0,", "data: [1.1,"),
        DataError,
        r"cam0/sensor.yaml: T_BS must be a rigid motion",
    ),
    "calibration too short": (
        replace("cam0/sensor.yaml", "[60.0, 61.0, 31.5, 23.5]", "[60.0, 61.0]"),
        DataError,
        r"cam0/sensor.yaml: .*4 finite numbers",
    ),
    "calibration not yaml": (write("cam0/sensor.yaml", "a: [1, 2\nb: }"), DataError, r"sensor.yaml:2: not valid YAML"),
    "unknown camera model": (
        replace("cam0/sensor.yaml", "radial-tangential", "magic"),
        DataError,
        r"magic is not supported",
    ),
    "wrong image size": (
        replace("cam0/sensor.yaml", "resolution: [64, 48]", "resolution: [752, 480]"),
        DataError,
        r"png: the image is 64×48 px but the calibration says 752×480 .*sensor.yaml",
    ),
    "all images corrupt": (spoil_images, DataError, r"png: neither this image .* can be decoded"),
    "no images": (remove_images, DataError, r"dataset.images=false"),
    "truth with nan": (
        edit_row(TRUTH, 9, lambda r: ",".join([first_stamp(r), *["nan"] * 10])),
        DataError,
        r"state_groundtruth_estimate0/data.csv:11: .*nan",
    ),
    "truth with zero quaternion": (
        edit_row(TRUTH, 9, lambda r: ",".join([first_stamp(r), *["0"] * 10])),
        DataError,
        r"data.csv:11: .*unit length",
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_it_is_refused_in_one_sentence(make_asl: Callable[..., Path], name: str) -> None:
    change, error, words = CASES[name]
    mav0 = make_asl()
    change(mav0)
    with pytest.raises(error, match=words) as caught:
        EurocDataset(root=str(mav0.parents[1]), sequence="swing").open("swing")
    message = str(caught.value)
    assert "\n" not in message and str(mav0) in message
    assert len(message) < 500


def test_missing_folders(make_asl: Callable[..., Path], tmp_path: Path) -> None:
    make_asl()
    with pytest.raises(DataError, match=r"nowhere: no such folder \(dataset.root\)"):
        EurocDataset(root=str(tmp_path / "nowhere"))
    for root in ("", "???"):
        with pytest.raises(ConfigError, match=r"dataset.root is not set"):
            EurocDataset(root=root)
    with pytest.raises(DataError, match=r"sequences under .*: swing"):
        EurocDataset(root=str(tmp_path), sequence="swung").open("swung")
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match="no sequence here"):
        EurocDataset(root=str(tmp_path / "empty"))


@pytest.mark.parametrize(
    ("option", "key"),
    [
        ({"cameras": 3}, "dataset.cameras"),
        ({"every": 0}, "dataset.every"),
        ({"start_s": -1.0}, "dataset.start_s"),
        ({"duration_s": 0.0}, "dataset.duration_s"),
        ({"calibration": "guess"}, "dataset.calibration"),
        ({"gap_policy": "ignore"}, "dataset.gap_policy"),
    ],
)
def test_wrong_options_name_their_key(tmp_path: Path, option: dict[str, object], key: str) -> None:
    with pytest.raises(ConfigError, match=key):
        EurocDataset(root=str(tmp_path), **option)  # type: ignore[arg-type]


def test_a_selection_without_frames_is_refused(make_asl: Callable[..., Path]) -> None:
    root = str(make_asl().parents[1])
    with pytest.raises(DataError, match=r"dataset.start_s=60"):
        EurocDataset(root=root, start_s=60.0).open("swing")


def test_unknown_ground_truth_lists_what_there_is(make_asl: Callable[..., Path]) -> None:
    root = str(make_asl().parents[1])
    with pytest.raises(DataError, match=r"ground_truth=corrected .*it has default"):
        EurocDataset(root=root, ground_truth="corrected").open("swing")
