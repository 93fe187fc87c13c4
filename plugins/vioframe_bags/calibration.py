"""Calibration beside a bag, which itself has none: Kalibr's files, or EuRoC's ``sensor.yaml``.

Kalibr: https://github.com/ethz-asl/kalibr/wiki/yaml-formats.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vioframe.checks import Array, check_pose
from vioframe.conventions import NANOSECONDS
from vioframe.errors import DataError, ShapeError
from vioframe.geometry import se3
from vioframe.types import Camera, CameraModel, ImuNoise

_MODELS: dict[str, CameraModel] = {
    "radtan": "radtan",
    "radial-tangential": "radtan",
    "plumb_bob": "radtan",
    "equidistant": "equidistant",
    "equi": "equidistant",
    "none": "pinhole",
}

Content = Mapping[str, Any]


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
    names = {
        "gyro_noise": "gyroscope_noise_density",
        "gyro_walk": "gyroscope_random_walk",
        "accel_noise": "accelerometer_noise_density",
        "accel_walk": "accelerometer_random_walk",
        "rate_hz": "rate_hz" if "rate_hz" in content else "update_rate",
    }
    values = {ours: float(numbers(content, path, theirs, 1)[0]) for ours, theirs in names.items()}
    try:
        noise = ImuNoise(**values)
    except ShapeError as error:
        raise DataError(f"{path}: {error}") from None
    T_body_imu = motion(content, path, "T_BS") if "T_BS" in content else np.eye(4)
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
            T_body_cam = se3.inverse(T_body_imu) @ motion(content, path, "T_BS")
            cameras.append(_camera(content, path, "", T_body_cam, "distortion_coefficients"))
    return cameras


def _read_chain(content: Content, path: Path) -> list[CalibratedCamera]:
    cameras = []
    T_cam_imu: Array | None = None
    for name in sorted(key for key in content if str(key).startswith("cam")):
        entry = content[name]
        if not isinstance(entry, dict):
            raise DataError(f"{path}: {name} must hold the calibration of a camera, got {entry!r}")
        if "T_cam_imu" in entry:
            T_cam_imu = motion(entry, path, "T_cam_imu", name)
        elif T_cam_imu is not None and "T_cn_cnm1" in entry:
            T_cam_imu = motion(entry, path, "T_cn_cnm1", name) @ T_cam_imu
        else:
            raise DataError(
                f"{path}: the key '{name}.T_cam_imu' is missing, so it is unknown where the camera sits on the IMU: "
                "take the camchain-imucam file that kalibr_calibrate_imu_camera writes"
            )
        cameras.append(_camera(entry, path, name, se3.inverse(T_cam_imu), "distortion_coeffs"))
    return cameras


def _camera(content: Content, path: Path, name: str, T_body_cam: Array, coefficients: str) -> CalibratedCamera:
    projection = str(value_of(content, path, "camera_model", name))
    model = str(value_of(content, path, "distortion_model", name))
    if projection != "pinhole" or model not in _MODELS:
        raise DataError(
            f"{path}: camera_model={projection} with distortion_model={model} is not supported (pinhole with "
            f"{', '.join(_MODELS)}): calibrate with one of them"
        )
    distortion: Array = np.zeros(0)
    if _MODELS[model] != "pinhole":
        given = value_of(content, path, coefficients, name)
        distortion = numbers(content, path, coefficients, len(given) if isinstance(given, list) else 4, name)
    size = numbers(content, path, "resolution", 2, name)
    delay_ns = None
    if "timeshift_cam_imu" in content:
        # Kalibr's shift is what to add to the camera's stamps: t_imu = t_cam + shift.
        delay_ns = round(float(numbers(content, path, "timeshift_cam_imu", 1, name)[0]) * NANOSECONDS)
    try:
        camera = Camera(
            model=_MODELS[model],
            intrinsics_px=numbers(content, path, "intrinsics", 4, name),
            distortion=distortion,
            size_px=(int(size[0]), int(size[1])),
            T_body_cam=T_body_cam,
        )
    except ShapeError as error:
        raise DataError(f"{path}: {error}") from None
    return CalibratedCamera(camera=camera, topic=str(content.get("rostopic", "")), delay_ns=delay_ns)


def read_yaml(path: Path) -> dict[str, Any]:
    """Keys of a YAML file; OpenCV's header ``%YAML:1.0`` is not YAML and is passed over.

    Raises:
        DataError: missing, not YAML, or without keys.
    """
    import yaml

    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise DataError(f"{path}: no such file; it should hold the calibration: correct the path") from None
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: cannot be read as text ({error})") from error
    lines = text.split("\n")
    if lines[0].startswith("%YAML:"):
        lines[0] = ""
    try:
        content = yaml.safe_load("\n".join(lines))
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f":{mark.line + 1}" if mark is not None else ""
        raise DataError(f"{path}{line}: not valid YAML ({getattr(error, 'problem', 'damaged')}): repair it") from None
    if not isinstance(content, dict):
        raise DataError(f"{path}: empty or without keys, it should hold the calibration: fetch it again")
    return content


def value_of(content: Content, path: Path, key: str, name: str = "") -> Any:
    """Value of a key; ``name`` is what it lies below, for the message.

    Raises:
        DataError: it is missing.
    """
    if key not in content:
        where = f"{name}.{key}" if name else key
        raise DataError(f"{path}: the key '{where}' is missing; there are {', '.join(map(str, content))}: add it")
    return content[key]


def numbers(content: Content, path: Path, key: str, count: int, name: str = "") -> Array:
    """Finite numbers (count,) of a key.

    Raises:
        DataError: missing, or something else.
    """
    value = value_of(content, path, key, name)
    where = f"{name}.{key}" if name else key
    try:
        array: Array = np.array(value, dtype=float).ravel()
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.size != count or not np.isfinite(array).all():
        raise DataError(f"{path}: the key '{where}' must be {count} finite number{'s' * (count > 1)}, got {value!r}")
    return array


def motion(content: Content, path: Path, key: str, name: str = "") -> Array:
    """Rigid motion (4, 4) of a key: rows, or OpenCV's matrix with ``data``.

    Raises:
        DataError: missing, or not rigid.
    """
    value = value_of(content, path, key, name)
    data = value.get("data") if isinstance(value, dict) else value
    T = numbers({key: data}, path, key, 16).reshape(4, 4)
    try:
        check_pose(key, T, tolerance=1e-4)
    except ShapeError as error:
        raise DataError(f"{path}: {error}: repair the calibration") from None
    return T
