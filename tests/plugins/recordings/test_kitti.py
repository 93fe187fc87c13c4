"""KITTI odometry and KITTI raw on made-up drives with known motion."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from vioframe.errors import ClockError, ConfigError, DataError
from vioframe.geometry import so3
from vioframe.types import Frame
from vioframe_recordings import KittiDataset, KittiRawDataset
from vioframe_recordings.kitti import read_imu_mat
from vioframe_recordings.kitti_calibration import DRIVE_DATES, spline_velocities
from vioframe_recordings.kitti_inertial import read_date_stamps
from vioframe_recordings.kitti_level import level_world

Maker = Callable[..., Path]


def test_odometry_is_levelled_and_keeps_its_motion(make_kitti: Maker) -> None:
    recording = KittiDataset(root=str(make_kitti()), images=False, camera_delay_s=0.0).open("06")
    truth = recording.ground_truth()
    assert truth is not None and truth.v_world_body is not None
    R = truth.T_world_body[:, :3, :3]
    # The made-up car stays level on a plane and goes at 8 m/s along its own x.
    tilt = np.degrees(np.arccos(np.clip(R[:, 2, 2], -1.0, 1.0)))
    assert tilt.max() < 0.1
    assert np.abs(truth.T_world_body[:, 2, 3]).max() < 0.1
    np.testing.assert_allclose(truth.T_world_body[0, :3, 3], 0.0, atol=1e-12)
    assert abs(np.arctan2(R[0, 1, 0], R[0, 0, 0])) < 1e-9
    forward = (np.swapaxes(R, -1, -2) @ truth.v_world_body[..., None])[..., 0]
    np.testing.assert_allclose(forward[3:-3], np.broadcast_to([8.0, 0.0, 0.0], forward[3:-3].shape), atol=0.05)
    assert recording.frame_count == 60
    assert not [f for f in recording.findings() if f.level == "bad"]


def test_samples_are_a_tenth_of_the_image_interval_apart(tmp_path: Path) -> None:
    from scipy.io import savemat

    times_ns = np.array([0, 103_750_000, 207_600_000, 311_000_007, 420_000_000], dtype=np.int64)
    savemat(tmp_path / "a.mat", {"imu_data_interp": np.arange(41 * 6, dtype=float).reshape(41, 6)})
    imu = read_imu_mat(tmp_path / "a.mat", times_ns)
    np.testing.assert_array_equal(imu.stamps_ns[::10], times_ns)
    np.testing.assert_allclose(np.diff(imu.stamps_ns)[:10], 10_375_000, atol=1)
    np.testing.assert_array_equal(imu.accel[0], [0.0, 1.0, 2.0])
    np.testing.assert_array_equal(imu.gyro[0], [3.0, 4.0, 5.0])


def test_the_delay_moves_truth_and_frames_together(make_kitti: Maker) -> None:
    root = str(make_kitti())
    recording = KittiDataset(root=root, images=False, camera_delay_s=0.02).open("06")
    truth = recording.ground_truth()
    assert truth is not None and recording.rig.camera_delay_ns == 20_000_000
    frames = [p.stamp_ns for p in recording.packets() if isinstance(p, Frame)]
    # The last frame is 20 ms behind the last sample.
    assert len(frames) == 59
    assert set(np.array(frames) + 20_000_000) <= set(truth.stamps_ns.tolist())


def write_frames(root: Path, folder: str, indices: range, size: tuple[int, int] = (1226, 370)) -> None:
    import cv2

    target = root / "sequences" / "06" / folder
    target.mkdir()
    for index in indices:
        cv2.imwrite(str(target / f"{index:06d}.png"), np.full((size[1], size[0]), index, dtype=np.uint8))


def test_frames_are_those_with_images(make_kitti: Maker) -> None:
    root = make_kitti()
    write_frames(root, "image_0", range(5, 20))
    write_frames(root, "image_1", range(8, 30))
    recording = KittiDataset(root=str(root), cameras=2).open("06")
    frames = [p for p in recording.packets() if isinstance(p, Frame)]
    assert [int(f.images[1][0, 0]) for f in frames] == list(range(8, 20))
    left, right = recording.rig.cameras
    baseline = (np.linalg.inv(left.T_body_cam) @ right.T_body_cam)[:3, 3]
    np.testing.assert_allclose(baseline, [3.79e2 / 7.07e2, 0.0, 0.0], atol=1e-9)
    # Cameras look ahead: their z is the vehicle's x, their x its right.
    assert left.T_body_cam[0, 2] > 0.99 and left.T_body_cam[1, 0] < -0.99
    imu = recording.imu
    assert imu.stamps_ns[-1] - frames[-1].stamp_ns < 100_000_000


def spoil_mat(change: Callable[[np.ndarray], np.ndarray], name: str = "imu_data_interp") -> Callable[[Path], None]:
    def apply(root: Path) -> None:
        from scipy.io import loadmat, savemat

        path = root / "imus_100hz_mat" / "06.mat"
        savemat(path, {name: change(loadmat(path)["imu_data_interp"])})

    return apply


def with_nan(samples: np.ndarray) -> np.ndarray:
    samples[17, 4] = np.nan
    return samples


def edit(name: str, old: str, new: str) -> Callable[[Path], None]:
    def apply(root: Path) -> None:
        path = root / name
        assert old in path.read_text()
        path.write_text(path.read_text().replace(old, new, 1))

    return apply


KITTI_CASES: dict[str, tuple[Callable[[Path], None], type[DataError], str]] = {
    "too few samples": (spoil_mat(lambda s: s[:-5]), DataError, r"06.mat: .*\(586, 6\).*need \(591, 6\)"),
    "other variable": (spoil_mat(lambda s: s, "imu"), DataError, r"06.mat: .*'imu_data_interp' is missing.*imu"),
    "nan": (spoil_mat(with_nan), DataError, r"06.mat: row 18, column 5"),
    "columns swapped": (spoil_mat(lambda s: s[:, [2, 0, 1, 3, 4, 5]]), DataError, r"06.mat: .*a car stays upright"),
    "gyro before accelerometer": (spoil_mat(lambda s: s[:, [3, 4, 5, 0, 1, 2]]), DataError, r"06.mat"),
    "gyro in degrees": (
        spoil_mat(lambda s: np.hstack([s[:, :3], np.degrees(s[:, 3:])])),
        DataError,
        r"06.mat: .*degrees",
    ),
    "not a mat": (
        lambda root: (root / "imus_100hz_mat" / "06.mat").write_text("hello") and None,
        DataError,
        r"06.mat: cannot be read",
    ),
    "no mat": (
        lambda root: (root / "imus_100hz_mat" / "06.mat").unlink(),
        DataError,
        r"lacks imus_100hz_mat/06.mat, .*imu=none",
    ),
    "calibration key": (edit("sequences/06/calib.txt", "P0:", "Q0:"), DataError, r"calib.txt: the key 'P0' is missing"),
    "calibration number": (edit("sequences/06/calib.txt", "7.07e+02", "seven"), DataError, r"calib.txt:1: .*'P0'"),
    "times repeated": (edit("sequences/06/times.txt", "1.038000e-01", "0.0"), ClockError, r"times.txt:2: .*repeats"),
    "poses of another": (
        lambda root: (root / "poses" / "06.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 6) and None,
        DataError,
        r"06.txt: 6 poses for 60 frames",
    ),
}


@pytest.mark.parametrize("name", KITTI_CASES)
def test_odometry_refuses_in_one_sentence(make_kitti: Maker, name: str) -> None:
    change, error, words = KITTI_CASES[name]
    root = make_kitti()
    change(root)
    with pytest.raises(error, match=words) as caught:
        KittiDataset(root=str(root), sequence="06", images=False).open("06")
    assert "\n" not in str(caught.value)


def test_odometry_choices(make_kitti: Maker) -> None:
    root = make_kitti()
    # YAML reads 06 as a number.
    assert list(KittiDataset(root=str(root), sequence=6, images=False).sequences) == ["06"]
    with pytest.raises(DataError, match=r"dataset.sequence=11"):
        KittiDataset(root=str(root), sequence="11").open("11")
    # All that is missing, before anything is read, and what could be run instead.
    with pytest.raises(DataError, match=r"lacks sequences/05, sequences/07, .*fetch them, .*: dataset.sequence=\[6\]"):
        KittiDataset(root=str(root), sequence=["05", 6, 7], images=False, cameras=2)
    with pytest.raises(DataError, match=r"lacks sequences/06/image_0, .*fetch it.*images=false dataset.sequence=\[6\]"):
        KittiDataset(root=str(root), sequence="06")
    (root / "sequences" / "06" / "image_0").mkdir()
    with pytest.raises(DataError, match=r"color=false dataset.sequence=\[6\]"):
        KittiDataset(root=str(root), sequence="06", color=True)
    with pytest.raises(DataError, match=r"image_0: has images of 0 of 60 frames"):
        KittiDataset(root=str(root), sequence="06").open("06")
    (root / "sequences" / "06" / "image_0").rmdir()
    write_frames(root, "image_0", range(5), (1241, 376))
    with pytest.raises(DataError, match=r"000000.png: the image is 1241×376 px but the calibration says 1226×370"):
        KittiDataset(root=str(root), sequence="06").open("06")


def test_stretches_share_no_image_and_lose_none(make_kitti: Maker) -> None:
    root = make_kitti()
    write_frames(root, "image_0", range(3, 50))
    seen = []
    for stretch in ([0.0, 0.7], [0.7, 0.85], [0.85, 1.0]):
        dataset = KittiDataset(root=str(root), sequence=6, stretch=stretch)
        (name,) = dataset.sequences
        assert name == f"06.{100 * stretch[0]:g}-{100 * stretch[1]:g}"
        recording = dataset.open(name)
        assert recording.name == name
        frames = [p for p in recording.packets() if isinstance(p, Frame)]
        seen.append([int(frame.images[0][0, 0]) for frame in frames])
    assert [value for part in seen for value in part] == list(range(3, 50))
    assert [len(part) for part in seen] == [33, 7, 7]
    assert list(KittiDataset(root=str(root), sequence=6).sequences) == ["06"]
    for stretch in ([0.9], [0.5, 0.5], [-0.1, 1.0], ["a", "b"]):
        with pytest.raises(ConfigError, match=r"dataset\.stretch must be two shares"):
            KittiDataset(root=str(root), stretch=stretch)


def test_vision_alone_needs_no_inertial_file(make_kitti: Maker) -> None:
    root = make_kitti()
    with_samples = KittiDataset(root=str(root), images=False, camera_delay_s=0.0).open("06").ground_truth()
    (root / "imus_100hz_mat" / "06.mat").unlink()
    with pytest.raises(DataError, match=r"dataset.imu=none"):
        KittiDataset(root=str(root), images=False)
    dataset = KittiDataset(root=str(root), images=False, imu="none")
    assert list(dataset.sequences) == ["06"]
    recording = dataset.open("06")
    packets = list(recording.packets())
    assert len(packets) == 60 and all(isinstance(packet, Frame) for packet in packets)
    assert not recording.rig.has_imu and recording.rig.camera_delay_ns == 0
    truth = recording.ground_truth()
    assert truth is not None and with_samples is not None
    # The made-up car drives on a plane, so its own upright axis is that of gravity.
    np.testing.assert_allclose(truth.T_world_body, with_samples.T_world_body, atol=0.1)
    assert not [f for f in recording.findings() if f.level == "bad"]
    with pytest.raises(ConfigError, match=r"dataset\.imu must be required or none"):
        KittiDataset(root=str(root), imu="some")  # type: ignore[arg-type]


def test_levelling_undoes_any_tilt(make_kitti: Maker) -> None:
    """The same drive, given in frames tilted at random, comes out the same."""
    recording = KittiDataset(root=str(make_kitti()), images=False, camera_delay_s=0.0).open("06")
    truth = recording.ground_truth()
    assert truth is not None
    rng = np.random.default_rng(2)
    for _ in range(3):
        tilted = truth.T_world_body.copy()
        R, shift = so3.exp(rng.normal(size=3)), rng.normal(size=3) * 100
        tilted[:, :3, :3] = R @ tilted[:, :3, :3]
        tilted[:, :3, 3] = tilted[:, :3, 3] @ R.T + shift
        again, size = level_world(truth.stamps_ns, tilted, recording.imu)
        np.testing.assert_allclose(again.T_world_body, truth.T_world_body, atol=1e-6)
        assert size == pytest.approx(9.81, abs=0.02)


def test_spline_velocity_beats_differences() -> None:
    rng = np.random.default_rng(7)
    seconds = 0.1 * np.arange(300)
    true = np.stack([10 + np.sin(0.5 * seconds), np.cos(0.5 * seconds), 0 * seconds], axis=1)
    position = np.stack([10 * seconds - 2 * np.cos(0.5 * seconds), 2 * np.sin(0.5 * seconds), 0 * seconds], axis=1)
    noisy = position + 0.02 * rng.normal(size=position.shape)
    stamps_ns = np.round(seconds * 1e9).astype(np.int64)
    smooth = spline_velocities(stamps_ns, noisy)
    plain = np.gradient(noisy, seconds, axis=0)
    assert np.abs(spline_velocities(stamps_ns, position) - true)[5:-5].max() < 0.01
    assert (smooth - true).std() < 0.6 * (plain - true).std()


def test_spline_velocity_holds_at_the_ends_of_a_curve() -> None:
    rng = np.random.default_rng(3)
    seconds = 0.1 * np.arange(60)
    # 10 m/s in a curve of 23 m radius, as at the start of sequence 01.
    angle = 10.0 / 23.0 * seconds
    position = 23.0 * np.stack([np.sin(angle), 1.0 - np.cos(angle), 0.0 * angle], axis=1)
    true = 10.0 * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    stamps_ns = np.round(seconds * 1e9).astype(np.int64)
    assert np.abs(spline_velocities(stamps_ns, position) - true).max() < 0.06
    noisy = position + 0.005 * rng.normal(size=position.shape)
    assert np.abs(spline_velocities(stamps_ns, noisy) - true).max() < 0.2


def test_extrinsics_are_rotations_looking_ahead() -> None:
    for drive in DRIVE_DATES:
        R = drive.T_body_cam0[:3, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
        assert R[0, 2] > 0.999 and R[1, 0] < -0.999 and R[2, 1] < -0.999
        # The camera is about a metre ahead of and above the unit.
        assert 1.0 < drive.T_body_cam0[0, 3] < 1.2 and 0.7 < drive.T_body_cam0[2, 3] < 0.8


def raw(root: Path, **options: object) -> KittiRawDataset:
    return KittiRawDataset(root=str(root), sequence="2011_09_26_drive_0042_sync", **options)  # type: ignore[arg-type]


def test_raw_drive_goes_north(make_raw_drive: Maker) -> None:
    recording = raw(make_raw_drive(), cameras=1).open("2011_09_26_drive_0042_sync")
    truth = recording.ground_truth()
    assert truth is not None and truth.v_world_body is not None
    # 5 m/s to the north for 2.99 s; y is north, and the vehicle's x points there.
    np.testing.assert_allclose(truth.T_world_body[-1, :3, 3], [0.0, 14.95, 0.0], atol=1e-3)
    np.testing.assert_allclose(truth.v_world_body[0], [0.0, 5.0, 0.0])
    np.testing.assert_allclose(truth.T_world_body[0, :3, 0], [0.0, 1.0, 0.0], atol=1e-12)
    frames = [p for p in recording.packets() if isinstance(p, Frame)]
    assert [int(f.images[0][0, 0]) for f in frames] == [0, 40, 80, 120, 160]
    assert recording.rig.imu.rate_hz == pytest.approx(100.0)
    # 2011-09-26 13:02:25.5 UTC
    assert frames[0].stamp_ns == 1_317_042_145_500_000_000


def test_raw_calibration_chains(make_raw_drive: Maker) -> None:
    rectified = raw(make_raw_drive(), images=False, cameras=2).open("2011_09_26_drive_0042_sync").rig.cameras
    np.testing.assert_allclose(rectified[0].intrinsics_px, [60, 60, 32, 24])
    # imu → velo → cam: p_cam = R (p_imu + (-0.8, 0.3, -0.8)) + (0, -0.07, -0.27), R = rows (0,-1,0), (0,0,-1), (1,0,0)
    np.testing.assert_allclose(rectified[0].T_body_cam[:3, 3], [1.07, -0.3, 0.73], atol=1e-12)
    np.testing.assert_allclose(rectified[0].T_body_cam[:3, 2], [1.0, 0.0, 0.0], atol=1e-12)
    # The right camera is half a metre to the vehicle's right (−y).
    np.testing.assert_allclose(rectified[1].T_body_cam[:3, 3], [1.07, -0.8, 0.73], atol=1e-12)


def test_raw_unrectified_cameras(make_raw_drive: Maker) -> None:
    from vioframe_recordings.kitti_raw import raw_cameras

    cameras = raw_cameras(make_raw_drive() / "2011_09_26", (0, 1))
    assert cameras[0].model == "radtan" and cameras[0].size_px == (66, 50) and len(cameras[0].distortion) == 5
    np.testing.assert_allclose(cameras[1].T_body_cam[:3, 3] - cameras[0].T_body_cam[:3, 3], [0.0, -0.5, 0.0], atol=1e-9)


def drop_packets(root: Path, start: int, count: int) -> Path:
    oxts = root / "2011_09_26" / "2011_09_26_drive_0042_extract" / "oxts"
    lines = (oxts / "timestamps.txt").read_text().split("\n")
    del lines[start : start + count]
    (oxts / "timestamps.txt").write_text("\n".join(lines))
    for index in range(start, start + count):
        (oxts / "data" / f"{index:010d}.txt").unlink()
    return oxts


def test_raw_gaps_follow_the_policy(make_raw_drive: Maker) -> None:
    root = make_raw_drive()
    drop_packets(root, 100, 30)
    name = "2011_09_26_drive_0042_sync"
    note = {f.subject: f.text for f in raw(root).open(name).findings() if f.level == "note"}
    assert "1 hole, the longest 0.310 s" in note["imu gaps"]
    with pytest.raises(ClockError, match="gap_policy=refuse"):
        raw(root, gap_policy="refuse").open(name)
    filled = raw(root, gap_policy="fill").open(name)
    assert np.diff(filled.imu.stamps_ns).max() <= 10_000_001
    split = raw(root, gap_policy="split")
    assert list(split.sequences) == [f"{name}.part0", f"{name}.part1"]
    # Frames at 0.5, 0.9 | 1.3, 1.7, 2.1 s; the hole is from 0.99 to 1.3 s.
    assert [split.open(part).frame_count for part in split.sequences] == [2, 3]


def test_raw_disorder_follows_the_policy(make_raw_drive: Maker) -> None:
    root = make_raw_drive()
    stamps = root / "2011_09_26" / "2011_09_26_drive_0042_extract" / "oxts" / "timestamps.txt"
    lines = stamps.read_text().split("\n")
    lines[50] = lines[48]
    lines[90] = lines[80]
    stamps.write_text("\n".join(lines))
    name = "2011_09_26_drive_0042_sync"
    with pytest.raises(ClockError, match=r"oxts/timestamps.txt:51: .*as 2 of 300 do: set dataset.disorder=drop"):
        raw(root).open(name)
    recording = raw(root, disorder="drop").open(name)
    assert "2 of 300" in next(f.text for f in recording.findings() if f.subject == "imu order")


def test_raw_refuses_in_one_sentence(make_raw_drive: Maker) -> None:
    root = make_raw_drive()
    name = "2011_09_26_drive_0042_sync"
    oxts = root / "2011_09_26" / "2011_09_26_drive_0042_extract" / "oxts"
    packet = oxts / "data" / f"{7:010d}.txt"
    sound = packet.read_text()
    for text, words in (
        ("1 2 3\n", r"0000000007.txt:1: .*30 numbers, this one 3"),
        (sound.replace("9.81", "nan"), r"0000000007.txt:1: number 14 is not finite"),
        (sound.replace("9.81", "x"), r"0000000007.txt:1: .*not a number"),
    ):
        packet.write_text(text)
        with pytest.raises(DataError, match=words):
            raw(root).open(name)
    packet.unlink()
    with pytest.raises(DataError, match=r"oxts: 299 packets in data for 300 stamps"):
        raw(root).open(name)
    packet.write_text(sound)
    with pytest.raises(DataError, match=r"no inertial samples for dataset.imu=sync"):
        raw(root, imu="sync").open(name)
    with pytest.raises(ConfigError, match=r"dataset.disorder"):
        raw(root, disorder="sort")
    calibration = root / "2011_09_26" / "calib_imu_to_velo.txt"
    calibration.write_text("calib_time: today\nR: 1 0 0 0 1 0 0 0 1\n")
    with pytest.raises(DataError, match=r"calib_imu_to_velo.txt: the key 'T' is missing"):
        raw(root).open(name)


def test_dates_keep_nanoseconds(tmp_path: Path) -> None:
    path = tmp_path / "timestamps.txt"
    path.write_text("2011-09-26 13:02:25.967790592\n2011-09-26 13:02:26\n")
    assert read_date_stamps(path, what="stamps").tolist() == [1317042145967790592, 1317042146000000000]
    path.write_text("2011-09-26 13:02:25.967790592\nyesterday\n")
    with pytest.raises(ClockError, match=r"timestamps.txt:2: 'yesterday'"):
        read_date_stamps(path, what="stamps")
