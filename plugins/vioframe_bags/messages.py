"""From decoded ROS messages to arrays."""

from typing import Any

import cv2
import numpy as np

from vioframe.checks import Array
from vioframe.errors import DataError
from vioframe.geometry import quaternion, se3
from vioframe.types import Image
from vioframe_bags.bag import COMPRESSED_IMAGE

_CHANNELS = {"mono8": 1, "8UC1": 1, "mono16": 1, "16UC1": 1, "bgr8": 3, "8UC3": 3, "rgb8": 3, "bgra8": 4, "rgba8": 4}
"""OpenCV's own names for ``mono8``, ``mono16`` and ``bgr8`` are used by some drivers."""

_TO_GRAY = {
    "bgr8": cv2.COLOR_BGR2GRAY,
    "8UC3": cv2.COLOR_BGR2GRAY,
    "rgb8": cv2.COLOR_RGB2GRAY,
    "bgra8": cv2.COLOR_BGRA2GRAY,
    "rgba8": cv2.COLOR_RGBA2GRAY,
}
_TO_RGB = {
    "bgr8": cv2.COLOR_BGR2RGB,
    "8UC3": cv2.COLOR_BGR2RGB,
    "bgra8": cv2.COLOR_BGRA2RGB,
    "rgba8": cv2.COLOR_RGBA2RGB,
}


def imu_row(message: Any) -> tuple[float, float, float, float, float, float]:
    """Gyro x y z rad/s and accelerometer x y z m/s² of a ``sensor_msgs/Imu``."""
    rate, force = message.angular_velocity, message.linear_acceleration
    return rate.x, rate.y, rate.z, force.x, force.y, force.z


def pose_of(message: Any) -> tuple[Array, Array]:
    """Position (3,) m and quaternion (4,), ordered (w, x, y, z), of a stamped pose or transform, or an odometry."""
    if hasattr(message, "transform"):
        position, rotation = message.transform.translation, message.transform.rotation
    else:
        # Odometry wraps its pose together with a covariance.
        pose = getattr(message.pose, "pose", message.pose)
        position, rotation = pose.position, pose.orientation
    return (
        np.array([position.x, position.y, position.z]),
        np.array([rotation.w, rotation.x, rotation.y, rotation.z]),
    )


def poses_to_matrices(positions: Array, quat_wxyz: Array) -> Array:
    """T (N, 4, 4) of positions (N, 3) and quaternions (N, 4)."""
    return se3.from_parts(quaternion.to_matrix(quat_wxyz), positions)


def image_of(message: Any, kind: str, *, color: bool, mono16_bits: int) -> Image:
    """(H, W) uint8, or (H, W, 3) uint8 RGB of a colour image if ``color``.

    Args:
        message: a ``sensor_msgs/Image`` or ``CompressedImage``.
        kind: which of the two.
        color: keep colours.
        mono16_bits: bits of a 16-bit pixel that are in use, counted from the lowest; the upper eight of them are kept.

    Raises:
        DataError: an encoding that is not supported, or pixels that are not all there.
    """
    if kind == COMPRESSED_IMAGE:
        data = np.frombuffer(message.data, dtype=np.uint8)
        flag = cv2.IMREAD_COLOR_RGB if color else cv2.IMREAD_GRAYSCALE
        decoded = cv2.imdecode(data, flag) if data.size else None
        if decoded is None:
            raise DataError(f"a compressed image ({message.format}) of {data.size} bytes cannot be decoded")
        return np.asarray(decoded, dtype=np.uint8)
    encoding = str(message.encoding)
    if encoding not in _CHANNELS:
        raise DataError(f"images with encoding {encoding!r} are not supported; {', '.join(_CHANNELS)} are")
    pixels = _pixels(message, _CHANNELS[encoding], 2 if "16" in encoding else 1)
    if pixels.dtype != np.uint8:
        kept: Image = np.minimum(pixels >> (mono16_bits - 8), 255).astype(np.uint8)
        return kept
    if pixels.ndim == 2:
        return pixels
    conversion = (_TO_RGB if color else _TO_GRAY).get(encoding)
    return pixels if conversion is None else np.asarray(cv2.cvtColor(pixels, conversion), dtype=np.uint8)


def _pixels(message: Any, channels: int, width_bytes: int) -> np.ndarray:
    height, width, step = int(message.height), int(message.width), int(message.step)
    data = np.frombuffer(message.data, dtype=np.uint8)
    used = width * channels * width_bytes
    if not used or step < used or data.size < height * step:
        raise DataError(
            f"an image of {width}×{height} px {message.encoding} with rows of {step} bytes has {data.size} bytes, "
            f"instead of {height * max(step, used)}"
        )
    # Rows may be padded at their end.
    rows = np.ascontiguousarray(data[: height * step].reshape(height, step)[:, :used])
    if width_bytes == 2:
        rows = rows.view(">u2" if message.is_bigendian else "<u2")
    return rows if channels == 1 else rows.reshape(height, width, channels)
