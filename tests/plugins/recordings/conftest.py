"""Tiny recordings on disk, with exact inertial samples of a known motion."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from vioframe.checks import Array, Stamps
from vioframe.geometry import quaternion, so3

START_NS = 1_403_715_273_262_142_976
STEP_NS = 5_000_000
GRAVITY = 9.81
SIZE_PX = (64, 48)

IDENTITY = "[1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]"


def motion(seconds: Array) -> tuple[Array, Array, Array, Array, Array]:
    """Rotation, position, velocity, rate and specific force of a body that swings and turns."""
    t = seconds[:, None]

    def attitude(times: Array) -> Array:
        angles = np.concatenate([0.3 * np.sin(2.0 * times), 0.25 * np.cos(1.7 * times), 0.8 * np.sin(times)], axis=1)
        return so3.exp(angles)

    half_step = 1e-5
    rate = so3.log(np.swapaxes(attitude(t - half_step), -1, -2) @ attitude(t + half_step)) / (2 * half_step)
    waves = np.array([1.0, 1.5, 2.0])
    position = 0.5 * np.sin(waves * t)
    velocity = 0.5 * waves * np.cos(waves * t)
    acceleration = -waves * waves * position
    R = attitude(t)
    force = (np.swapaxes(R, -1, -2) @ (acceleration + np.array([0.0, 0.0, GRAVITY]))[..., None])[..., 0]
    return R, position, velocity, rate, force


def csv(stamps_ns: Stamps, values: Array, header: str) -> str:
    rows = [f"{stamp}," + ",".join(repr(float(v)) for v in row) for stamp, row in zip(stamps_ns, values, strict=True)]
    return "\n".join([f"#{header}", *rows]) + "\n"


def camera_yaml(T_BS: str = IDENTITY) -> str:
    return (
        "%YAML:1.0\nsensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n"
        f"  data: {T_BS}\nrate_hz: 10\nresolution: [{SIZE_PX[0]}, {SIZE_PX[1]}]\ncamera_model: pinhole\n"
        "intrinsics: [60.0, 61.0, 31.5, 23.5]\ndistortion_model: radial-tangential\n"
        "distortion_coefficients: [-0.28, 0.07, 0.0002, 1.7e-05]\n"
    )


def imu_yaml(T_BS: str = IDENTITY) -> str:
    return (
        f"T_BS:\n  data: {T_BS}\nrate_hz: 200\ngyroscope_noise_density: 1.7e-04\ngyroscope_random_walk: 1.9e-05\n"
        "accelerometer_noise_density: 2.0e-3\naccelerometer_random_walk: 3.0e-3\n"
    )


def write_png(path: Path, image: np.ndarray) -> None:
    import cv2

    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


@pytest.fixture
def make_asl(tmp_path: Path) -> Callable[..., Path]:
    """Write ``<root>/<name>/mav0`` with 20 stereo frames at 10 Hz in 3 s of 200 Hz samples; returns mav0."""

    def make(name: str = "swing", count: int = 20) -> Path:
        folder = tmp_path / name / "mav0"
        stamps_ns = START_NS + STEP_NS * np.arange(600, dtype=np.int64)
        R, position, velocity, rate, force = motion((stamps_ns - START_NS) / 1e9)
        (folder / "imu0").mkdir(parents=True)
        (folder / "imu0" / "data.csv").write_text(csv(stamps_ns, np.hstack([rate, force]), "timestamp [ns],w,a"))
        (folder / "imu0" / "sensor.yaml").write_text(imu_yaml())
        truth = folder / "state_groundtruth_estimate0"
        truth.mkdir()
        (truth / "data.csv").write_text(
            csv(stamps_ns, np.hstack([position, quaternion.from_matrix(R), velocity]), "timestamp,p,q,v")
        )
        frames_ns = START_NS + 502_000_000 + 100_000_000 * np.arange(count, dtype=np.int64)
        rng = np.random.default_rng(5)
        for index in range(2):
            camera = folder / f"cam{index}"
            camera.mkdir()
            (camera / "sensor.yaml").write_text(camera_yaml())
            rows = [f"{stamp},{stamp}.png" for stamp in frames_ns]
            (camera / "data.csv").write_text("\n".join(["#timestamp [ns],filename", *rows]) + "\n")
            for number, stamp in enumerate(frames_ns):
                image = rng.integers(0, 256, (SIZE_PX[1], SIZE_PX[0]), dtype=np.uint8)
                image[0, 0] = number
                image[0, 1] = index
                write_png(camera / "data" / f"{stamp}.png", image)
        return folder

    return make


@pytest.fixture
def make_kitti(tmp_path: Path) -> Callable[..., Path]:
    """Write sequence 06 of a KITTI folder: 60 frames, a car that swerves on a plane; returns the root."""

    def make(frames: int = 60) -> Path:
        from scipy.io import savemat

        from vioframe.geometry import se3
        from vioframe_recordings.kitti_calibration import odometry_drive

        drive = odometry_drive("06")
        assert drive is not None
        times = 0.1038 * np.arange(frames)
        # Without a delay, so that the samples belong to the times of the file.
        fine = np.interp(np.arange(10 * (frames - 1) + 1) / 10.0, np.arange(frames), times)

        def drive_along(t: Array) -> tuple[Array, Array, Array, Array]:
            yaw = 0.5 * np.sin(0.6 * t)
            yaw_rate = 0.3 * np.cos(0.6 * t)
            speed = 8.0
            velocity = speed * np.stack([np.cos(yaw), np.sin(yaw), 0 * t], axis=1)
            force = np.stack([0 * t, speed * yaw_rate, GRAVITY + 0 * t], axis=1)
            return so3.rotation_z(yaw), velocity, np.stack([0 * t, 0 * t, yaw_rate], axis=1), force

        dense = np.linspace(0.0, times[-1], 20001)
        steps = np.diff(dense)[:, None]
        velocity = drive_along(dense)[1]
        path = np.concatenate([np.zeros((1, 3)), np.cumsum(0.5 * (velocity[1:] + velocity[:-1]) * steps, axis=0)])
        position = np.stack([np.interp(times, dense, path[:, axis]) for axis in range(3)], axis=1)
        T_world_body = se3.from_parts(drive_along(times)[0], position)
        T_world_cam = T_world_body @ drive.T_body_cam0
        T_ref_cam = se3.inverse(T_world_cam[0]) @ T_world_cam
        _, _, rate, force = drive_along(fine)
        folder = tmp_path / "kitti" / "sequences" / "06"
        folder.mkdir(parents=True)
        root = tmp_path / "kitti"
        (folder / "times.txt").write_text("".join(f"{t:.6e}\n" for t in times))
        P0 = "7.07e+02 0 6.0e+02 0 0 7.07e+02 1.8e+02 0 0 0 1 0"
        P1 = "7.07e+02 0 6.0e+02 -3.79e+02 0 7.07e+02 1.8e+02 0 0 0 1 0"
        (folder / "calib.txt").write_text(f"P0: {P0}\nP1: {P1}\nP2: {P0}\nP3: {P1}\n")
        (root / "poses").mkdir()
        rows = [" ".join(f"{v:.9e}" for v in T[:3].ravel()) for T in T_ref_cam]
        (root / "poses" / "06.txt").write_text("\n".join(rows) + "\n")
        (root / "imus_100hz_mat").mkdir()
        savemat(root / "imus_100hz_mat" / "06.mat", {"imu_data_interp": np.hstack([force, rate])})
        return root

    return make


@pytest.fixture
def make_raw_drive(tmp_path: Path) -> Callable[..., Path]:
    """Write an unsynchronised KITTI raw drive of 3 s that goes north at 5 m/s, with five frames; returns the root."""

    def make() -> Path:
        root = tmp_path / "raw"
        day = root / "2011_09_26"
        oxts = day / "2011_09_26_drive_0042_extract" / "oxts"
        (oxts / "data").mkdir(parents=True)
        count, speed = 300, 5.0
        lines = []
        for index in range(count):
            seconds = 0.01 * index
            lines.append(f"2011-09-26 13:02:{25 + seconds:012.9f}")
            row = np.zeros(30)
            row[0] = 49.0 + np.degrees(speed * seconds / 6_378_137.0)
            row[1], row[2] = 8.4, 115.0
            row[5] = np.pi / 2
            row[6] = speed
            row[8] = speed
            row[13] = GRAVITY
            (oxts / "data" / f"{index:010d}.txt").write_text(" ".join(repr(float(v)) for v in row) + "\n")
        (oxts / "timestamps.txt").write_text("\n".join(lines) + "\n")
        images = day / "2011_09_26_drive_0042_sync" / "image_00"
        stamps = [f"2011-09-26 13:02:{25.5 + 0.4 * index:012.9f}" for index in range(5)]
        images.mkdir(parents=True)
        (images / "timestamps.txt").write_text("\n".join(stamps) + "\n")
        for index in range(5):
            write_png(images / "data" / f"{index:010d}.png", np.full((48, 64), 40 * index, dtype=np.uint8))
        eye = "1 0 0 0 1 0 0 0 1"
        (day / "calib_imu_to_velo.txt").write_text(f"calib_time: today\nR: {eye}\nT: -0.8 0.3 -0.8\n")
        (day / "calib_velo_to_cam.txt").write_text("calib_time: today\nR: 0 -1 0 0 0 -1 1 0 0\nT: 0 -0.07 -0.27\n")
        cameras = []
        for index, baseline in ((0, 0.0), (1, -30.0)):
            cameras += [
                f"S_{index:02d}: 66 50", f"K_{index:02d}: 70 0 33 0 70 25 0 0 1", f"D_{index:02d}: -0.3 0.2 0 0 0",
                f"R_{index:02d}: {eye}", f"T_{index:02d}: {baseline / 60.0} 0 0", f"S_rect_{index:02d}: 64 48",
                f"R_rect_{index:02d}: {eye}", f"P_rect_{index:02d}: 60 0 32 {baseline} 0 60 24 0 0 0 1 0",
            ]  # fmt: skip
        (day / "calib_cam_to_cam.txt").write_text("\n".join(["calib_time: today", *cameras]) + "\n")
        return root

    return make
