from collections.abc import Callable

import cv2
import numpy as np
import pytest

from vioframe.testing import make_scene
from vioframe.types import Camera, Frame, SensorRig


@pytest.fixture
def rig_of() -> Callable[..., SensorRig]:
    """A rig with one camera of some size, or with none."""

    def make(width: int, height: int, cameras: int = 1) -> SensorRig:
        camera = Camera(
            model="pinhole",
            intrinsics_px=np.array([0.8 * width, 0.8 * width, width / 2, height / 2]),
            size_px=(width, height),
            T_body_cam=np.eye(4),
        )
        return SensorRig(cameras=(camera,) * cameras, imu=make_scene().rig.imu)

    return make


@pytest.fixture
def sliding() -> Callable[..., list[Frame]]:
    """Frames of a random picture that slides by so many pixels (x, y) an image."""

    def make(width: int, height: int, step: tuple[int, int] = (3, -2), count: int = 5, seed: int = 0) -> list[Frame]:
        random = np.random.default_rng(seed)
        margin = count * (abs(step[0]) + abs(step[1])) + 2
        noise = random.standard_normal((height + 2 * margin, width + 2 * margin)).astype(np.float32)
        picture = cv2.GaussianBlur(noise, (0, 0), 2.0) + 2.0 * cv2.GaussianBlur(noise, (0, 0), 7.0)
        picture = np.clip(128.0 + 45.0 * picture / picture.std(), 0, 255).astype(np.uint8)
        frames = []
        for k in range(count):
            top, left = margin - k * step[1], margin - k * step[0]
            image = np.ascontiguousarray(picture[top : top + height, left : left + width])
            frames.append(Frame(stamp_ns=10**9 + k * 10**8, images=(image,)))
        return frames

    return make
