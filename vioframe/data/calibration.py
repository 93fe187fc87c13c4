"""Calibration files in YAML: EuRoC's ``sensor.yaml``, and the keys that other formats share with it.

Layout: Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR 2016, section 5.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vioframe.checks import Array, check_pose
from vioframe.errors import DataError, ShapeError
from vioframe.geometry import se3
from vioframe.types import Camera, CameraModel, ImuNoise

Content = Mapping[str, Any]

_MODELS: dict[str, CameraModel] = {
    "radtan": "radtan",
    "radial-tangential": "radtan",
    "plumb_bob": "radtan",
    "equidistant": "equidistant",
    "equi": "equidistant",
    "none": "pinhole",
}
"""Names of the distortion in EuRoC, TUM-VI, Kalibr and ROS."""


def read_yaml(path: Path, *, advice: str = "correct the path") -> dict[str, Any]:
    """Keys of a YAML file; OpenCV's header ``%YAML:1.0`` is not YAML and is passed over.

    Args:
        path: the file.
        advice: what to do where it is missing.

    Raises:
        DataError: missing, not YAML, or without keys.
    """
    import yaml

    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise DataError(f"{path}: no such file; it should hold the calibration: {advice}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: cannot be read as text ({error}): {advice}") from error
    header, newline, rest = text.partition("\n")
    try:
        content = yaml.safe_load(newline + rest if header.startswith("%YAML:") else text)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f":{mark.line + 1}" if mark is not None else ""
        raise DataError(f"{path}{line}: not valid YAML ({getattr(error, 'problem', 'damaged')}): repair it") from None
    if not isinstance(content, dict):
        raise DataError(f"{path}: empty or without keys, it should hold the calibration: fetch it again")
    return content


def value_of(content: Content, path: Path, key: str, below: str = "") -> Any:
    """Value of a key; ``below`` is the key that holds ``content``, for messages.

    Raises:
        DataError: it is missing.
    """
    if key not in content:
        raise DataError(
            f"{path}: the key '{_full(key, below)}' is missing; there are {', '.join(map(str, content))}: add it"
        )
    return content[key]


def numbers_of(content: Content, path: Path, key: str, count: int, below: str = "") -> Array:
    """Finite numbers (count,) of a key.

    Raises:
        DataError: missing, or something else.
    """
    value = value_of(content, path, key, below)
    try:
        numbers: Array = np.array(value, dtype=float).ravel()
    except (TypeError, ValueError):
        numbers = np.zeros(0)
    if numbers.size != count or not np.isfinite(numbers).all():
        raise DataError(
            f"{path}: the key '{_full(key, below)}' must be {count} finite number{'s' * (count > 1)}, got {value!r}: "
            "repair it"
        )
    return numbers


def motion_of(content: Content, path: Path, key: str, below: str = "") -> Array:
    """Rigid motion (4, 4) of a key: rows, or OpenCV's matrix with ``data``.

    Raises:
        DataError: missing, or not rigid.
    """
    value = value_of(content, path, key, below)
    data = value.get("data") if isinstance(value, dict) else value
    T = numbers_of({key: data}, path, key, 16, below).reshape(4, 4)
    try:
        check_pose(_full(key, below), T, tolerance=1e-4)
    except ShapeError as error:
        raise DataError(f"{path}: {error}: repair the calibration") from None
    return T


def noise_of(content: Content, path: Path, rate_key: str = "rate_hz") -> ImuNoise:
    """Noise densities, which EuRoC and Kalibr call the same.

    Raises:
        DataError: a key is missing, or its value is impossible.
    """
    names = {
        "gyro_noise": "gyroscope_noise_density",
        "gyro_walk": "gyroscope_random_walk",
        "accel_noise": "accelerometer_noise_density",
        "accel_walk": "accelerometer_random_walk",
        "rate_hz": rate_key,
    }
    values = {ours: float(numbers_of(content, path, theirs, 1)[0]) for ours, theirs in names.items()}
    try:
        return ImuNoise(**values)
    except ShapeError as error:
        raise DataError(f"{path}: {error}: repair the calibration") from None


def camera_of(
    content: Content,
    path: Path,
    T_body_cam: Array,
    *,
    coefficients: str = "distortion_coefficients",
    below: str = "",
) -> Camera:
    """A camera whose pose is known.

    Args:
        content: keys of the camera.
        path: the file, for messages.
        T_body_cam: (4, 4), in the IMU frame.
        coefficients: key of the distortion's coefficients.
        below: the key that holds ``content``, for messages.

    Raises:
        DataError: a key is missing, its value is impossible, or the model is not supported.
    """
    projection = str(value_of(content, path, "camera_model", below))
    distortion_model = str(value_of(content, path, "distortion_model", below))
    if projection != "pinhole" or distortion_model not in _MODELS:
        raise DataError(
            f"{path}: camera_model={projection} with distortion_model={distortion_model} is not supported (pinhole "
            f"with {', '.join(_MODELS)}): calibrate with one of them"
        )
    model = _MODELS[distortion_model]
    distortion: Array = np.zeros(0)
    if model != "pinhole":
        given = value_of(content, path, coefficients, below)
        distortion = numbers_of(content, path, coefficients, len(given) if isinstance(given, list) else 4, below)
    width, height = numbers_of(content, path, "resolution", 2, below)
    try:
        return Camera(
            model=model,
            intrinsics_px=numbers_of(content, path, "intrinsics", 4, below),
            distortion=distortion,
            size_px=(int(width), int(height)),
            T_body_cam=T_body_cam,
        )
    except ShapeError as error:
        raise DataError(f"{path}: {error}: repair the calibration") from None


def imu_of_sensor(content: Content, path: Path, rate_key: str = "rate_hz") -> tuple[ImuNoise, Array]:
    """Noise, and T_body_imu (4, 4), of an IMU's ``sensor.yaml``: the body of the file need not be the IMU.

    Raises:
        DataError: with the file and the key.
    """
    return noise_of(content, path, rate_key), motion_of(content, path, "T_BS") if "T_BS" in content else np.eye(4)


def camera_of_sensor(content: Content, path: Path, T_body_imu: Array) -> Camera:
    """Camera of its ``sensor.yaml``, with its pose in the IMU frame.

    Raises:
        DataError: with the file and the key.
    """
    return camera_of(content, path, se3.inverse(T_body_imu) @ motion_of(content, path, "T_BS"))


def _full(key: str, below: str) -> str:
    return f"{below}.{key}" if below else key
