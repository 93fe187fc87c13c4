"""Calibration beside a bag, which itself has none: Kalibr's files, or EuRoC's ``sensor.yaml``.

Kalibr: https://github.com/ethz-asl/kalibr/wiki/yaml-formats.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from vioframe.checks import Array
from vioframe.conventions import NANOSECONDS
from vioframe.data.calibration import (
    Content,
    camera_of,
    camera_of_sensor,
    imu_of_sensor,
    motion_of,
    numbers_of,
    read_yaml,
)
from vioframe.errors import DataError
from vioframe.geometry import se3
from vioframe.types import Camera, ImuNoise


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CalibratedImu:
    """Noise of the IMU, where it sits on the body of its file, and the topic that the file names (or nothing)."""

    noise: ImuNoise
    T_body_imu: Array
    topic: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CalibratedCamera:
    """One camera, with what its file says beyond the geometry.

    Attributes:
        camera: with its pose in the IMU frame.
        topic: that the file names, or nothing.
        delay_ns: ``t_imu = t_cam + delay``, or None where the file does not tell.
    """

    camera: Camera
    topic: str
    delay_ns: int | None


def read_imu(path: Path) -> CalibratedImu:
    """Kalibr's ``imu.yaml`` (as given to it, or as it writes it), or EuRoC's ``imu0/sensor.yaml``.

    Raises:
        DataError: with the file and the key.
    """
    content = read_yaml(path)
    if isinstance(content.get("imu0"), dict):
        content = content["imu0"]
    noise, T_body_imu = imu_of_sensor(content, path, "rate_hz" if "rate_hz" in content else "update_rate")
    return CalibratedImu(noise=noise, T_body_imu=T_body_imu, topic=str(content.get("rostopic", "")))


def read_cameras(paths: Sequence[Path], T_body_imu: Array) -> list[CalibratedCamera]:
    """All cameras of a Kalibr chain (one file), or one of each ``sensor.yaml``, in order.

    Raises:
        DataError: with the file and the key.
    """
    cameras: list[CalibratedCamera] = []
    for path in paths:
        content = read_yaml(path)
        if "cam0" in content:
            cameras += _read_chain(content, path)
        else:
            cameras.append(_with_topic(content, path, camera_of_sensor(content, path, T_body_imu)))
    return cameras


def _read_chain(content: Content, path: Path) -> list[CalibratedCamera]:
    cameras = []
    T_cam_imu: Array | None = None
    for name in sorted(key for key in content if str(key).startswith("cam")):
        entry = content[name]
        if not isinstance(entry, dict):
            raise DataError(f"{path}: {name} must hold the calibration of a camera, got {entry!r}")
        if "T_cam_imu" in entry:
            T_cam_imu = motion_of(entry, path, "T_cam_imu", name)
        elif T_cam_imu is not None and "T_cn_cnm1" in entry:
            T_cam_imu = motion_of(entry, path, "T_cn_cnm1", name) @ T_cam_imu
        else:
            raise DataError(
                f"{path}: the key '{name}.T_cam_imu' is missing, so it is unknown where the camera sits on the IMU: "
                "take the camchain-imucam file that kalibr_calibrate_imu_camera writes"
            )
        camera = camera_of(entry, path, se3.inverse(T_cam_imu), coefficients="distortion_coeffs", below=name)
        cameras.append(_with_topic(entry, path, camera, name))
    return cameras


def _with_topic(content: Content, path: Path, camera: Camera, below: str = "") -> CalibratedCamera:
    delay_ns = None
    if "timeshift_cam_imu" in content:
        # Kalibr's shift is what to add to the camera's stamps: t_imu = t_cam + shift.
        delay_ns = round(float(numbers_of(content, path, "timeshift_cam_imu", 1, below)[0]) * NANOSECONDS)
    return CalibratedCamera(camera=camera, topic=str(content.get("rostopic", "")), delay_ns=delay_ns)
