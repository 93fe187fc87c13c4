"""Pixels of ROS messages, and calibration files."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import yaml

from vioframe.errors import DataError
from vioframe.geometry import se3, so3

pytest.importorskip("rosbags", reason="rosbags is not installed (pip install 'vioframe[bags]')")

from vioframe_bags import bag, calibration, messages


def fields_of(image: np.ndarray, encoding: str, padding: int = 0, big_endian: bool = False) -> SimpleNamespace:
    if image.dtype == np.uint16:
        image = image.astype(">u2" if big_endian else "<u2")
    rows = np.ascontiguousarray(image).view(np.uint8).reshape(image.shape[0], -1)
    padded = np.pad(rows, ((0, 0), (0, padding)), constant_values=99)
    return SimpleNamespace(
        height=image.shape[0],
        width=image.shape[1],
        encoding=encoding,
        is_bigendian=int(big_endian),
        step=padded.shape[1],
        data=padded.reshape(-1),
    )


@pytest.mark.parametrize("padding", [0, 5])
def test_encodings(padding):
    rng = np.random.default_rng(5)
    rgb = rng.integers(0, 256, (4, 6, 3), dtype=np.uint8)
    for encoding, pixels in (("rgb8", rgb), ("bgr8", rgb[..., ::-1])):
        fields = fields_of(pixels, encoding, padding)
        color = messages.image_of(fields, bag.RAW_IMAGE, color=True, mono16_bits=16)
        np.testing.assert_array_equal(color, rgb)
        gray = messages.image_of(fields, bag.RAW_IMAGE, color=False, mono16_bits=16)
        np.testing.assert_array_equal(gray, cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY))
    deep = rng.integers(0, 4096, (4, 6), dtype=np.uint16)
    for big_endian in (False, True):
        fields = fields_of(deep, "mono16", 2 * padding, big_endian)
        np.testing.assert_array_equal(
            messages.image_of(fields, bag.RAW_IMAGE, color=False, mono16_bits=12), (deep >> 4).astype(np.uint8)
        )
        np.testing.assert_array_equal(
            messages.image_of(fields, bag.RAW_IMAGE, color=False, mono16_bits=16), (deep >> 8).astype(np.uint8)
        )
    with pytest.raises(DataError, match="bayer_rggb8"):
        messages.image_of(fields_of(rgb[..., 0], "bayer_rggb8"), bag.RAW_IMAGE, color=False, mono16_bits=16)


def test_euroc_sensor_files(tmp_path):
    """The camera's pose is relative to the IMU, also where the IMU is not the body of the files."""
    T_body_imu = se3.from_parts(so3.exp(np.array([0.1, 0.2, 0.3])), np.array([1.0, 2.0, 3.0]))
    T_body_cam = se3.from_parts(so3.exp(np.array([-1.0, 0.2, 0.5])), np.array([0.1, -0.2, 0.3]))

    def matrix(T):
        return {"rows": 4, "cols": 4, "data": T.ravel().tolist()}

    (tmp_path / "imu.yaml").write_text(
        "%YAML:1.0\n"
        + yaml.safe_dump(
            {
                "T_BS": matrix(T_body_imu),
                "rate_hz": 200,
                "gyroscope_noise_density": 1e-4,
                "gyroscope_random_walk": 1e-5,
                "accelerometer_noise_density": 1e-3,
                "accelerometer_random_walk": 1e-4,
            }
        )
    )
    (tmp_path / "cam0.yaml").write_text(
        yaml.safe_dump(
            {
                "T_BS": matrix(T_body_cam),
                "camera_model": "pinhole",
                "distortion_model": "radial-tangential",
                "distortion_coefficients": [0.1, 0.01, 0.0, 0.0],
                "intrinsics": [400.0, 401.0, 320.0, 240.0],
                "resolution": [640, 480],
            }
        )
    )
    imu = calibration.read_imu(tmp_path / "imu.yaml")
    (one,) = calibration.read_cameras([tmp_path / "cam0.yaml"], imu.T_body_imu)
    assert one.camera.model == "radtan" and one.delay_ns is None and imu.noise.rate_hz == 200.0
    np.testing.assert_allclose(T_body_imu @ one.camera.T_body_cam, T_body_cam, atol=1e-12)
