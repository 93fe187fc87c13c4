"""Projection against OpenCV, and back again; distortion as in EuRoC, TUM-VI and KITTI."""

import cv2
import numpy as np
import pytest

from geometry_tolerances import OPENCV_PIXELS, ROUNDING, UNDISTORTED, UNDISTORTED_CORNER
from vioframe.geometry import camera as camera_model
from vioframe.geometry import se3, so3
from vioframe.types import Camera

PINHOLE = Camera(
    model="pinhole",
    intrinsics_px=np.array([718.856, 718.856, 607.19, 185.22]),
    size_px=(1241, 376),
    T_body_cam=np.eye(4),
)
EUROC = Camera(
    model="radtan",
    intrinsics_px=np.array([458.654, 457.296, 367.215, 248.375]),
    distortion=np.array([-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]),
    size_px=(752, 480),
    T_body_cam=np.eye(4),
)
FIVE = Camera(
    model="radtan",
    intrinsics_px=np.array([458.654, 457.296, 367.215, 248.375]),
    distortion=np.array([-0.28, 0.09, 0.001, -0.002, -0.01]),
    size_px=(752, 480),
    T_body_cam=np.eye(4),
)
TUMVI = Camera(
    model="equidistant",
    intrinsics_px=np.array([190.97847715, 190.97330707, 254.93170606, 256.89744285]),
    distortion=np.array([0.00348238, 0.00071503, -0.00205323, 0.00020293]),
    size_px=(512, 512),
    T_body_cam=np.eye(4),
)
ALL = [
    pytest.param(PINHOLE, id="pinhole"),
    pytest.param(EUROC, id="radtan4"),
    pytest.param(FIVE, id="radtan5"),
    pytest.param(TUMVI, id="equidistant"),
]


def rays(camera: Camera, count: int = 400) -> np.ndarray:
    """Points in front of the camera, over the whole image and a little beyond."""
    random = np.random.default_rng(0)
    half = np.tan(np.radians(75.0)) if camera.model == "equidistant" else 0.85
    directions = np.concatenate([random.uniform(-half, half, (count, 2)), np.ones((count, 1))], axis=1)
    return directions * random.uniform(0.5, 30.0, (count, 1))


def opencv_pixels(camera: Camera, points: np.ndarray) -> np.ndarray:
    K = camera_model.intrinsic_matrix(camera)
    zero = np.zeros(3)
    if camera.model == "equidistant":
        pixels, _ = cv2.fisheye.projectPoints(points[:, None], zero, zero, K, camera.distortion)
    else:
        pixels, _ = cv2.projectPoints(points[:, None], zero, zero, K, camera.distortion)
    return pixels[:, 0]


@pytest.mark.parametrize("camera", ALL)
def test_projection_is_that_of_opencv(camera: Camera) -> None:
    points = rays(camera)
    pixels, _ = camera_model.project(camera, points)
    np.testing.assert_allclose(pixels, opencv_pixels(camera, points), atol=OPENCV_PIXELS)


@pytest.mark.parametrize("camera", ALL)
def test_bearings_invert_the_projection_inside_the_image(camera: Camera) -> None:
    width, height = camera.size_px
    columns, rows = np.meshgrid(np.linspace(0, width - 1, 25), np.linspace(0, height - 1, 25))
    pixels = np.stack([columns, rows], axis=-1).reshape(-1, 2)
    bearings = camera_model.bearings(camera, pixels)
    np.testing.assert_allclose(np.linalg.norm(bearings, axis=1), 1.0, atol=ROUNDING)
    ahead = bearings[:, 2] > 0.05
    again, _ = camera_model.project(camera, 7.0 * bearings[ahead])
    # A thousandth of a pixel at the corners of the strongest distortion; elsewhere rounding.
    np.testing.assert_allclose(again, pixels[ahead], atol=UNDISTORTED_CORNER * 1e3)
    centre = np.linalg.norm(pixels - camera.intrinsics_px[2:], axis=1) < 0.35 * min(width, height)
    middle, _ = camera_model.project(camera, bearings[centre])
    np.testing.assert_allclose(middle, pixels[centre], atol=UNDISTORTED * 1e3)


@pytest.mark.parametrize("camera", ALL)
def test_undistortion_is_that_of_opencv(camera: Camera) -> None:
    width, height = camera.size_px
    pixels = np.random.default_rng(1).uniform([0.2 * width, 0.2 * height], [0.8 * width, 0.8 * height], (200, 2))
    K = camera_model.intrinsic_matrix(camera)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-14)
    if camera.model == "equidistant":
        theirs = cv2.fisheye.undistortPoints(pixels[:, None], K, camera.distortion, criteria=criteria)[:, 0]
    else:
        # Five steps, the default, leave 1e-4; OpenCV 4 takes the criteria under another name than OpenCV 5.
        undistort = getattr(cv2, "undistortPointsIter", None) or cv2.undistortPoints
        theirs = undistort(pixels[:, None], K, camera.distortion, R=None, P=None, criteria=criteria)[:, 0]
    np.testing.assert_allclose(camera_model.normalised(camera, pixels), theirs, atol=1e-7)


@pytest.mark.parametrize("camera", ALL)
def test_undistort_inverts_distort(camera: Camera) -> None:
    ideal = np.random.default_rng(2).uniform(-0.45, 0.45, (300, 2))
    np.testing.assert_allclose(
        camera_model.undistort(camera, camera_model.distort(camera, ideal)), ideal, atol=UNDISTORTED_CORNER
    )


@pytest.mark.parametrize("camera", ALL)
def test_the_principal_point_looks_straight_ahead(camera: Camera) -> None:
    np.testing.assert_allclose(camera_model.bearings(camera, camera.intrinsics_px[2:]), [0, 0, 1], atol=ROUNDING)
    pixels, visible = camera_model.project(camera, np.array([0.0, 0.0, 2.0]))
    np.testing.assert_allclose(pixels, camera.intrinsics_px[2:], atol=ROUNDING)
    assert visible


def test_visible_is_ahead_and_inside_half_a_pixel_of_the_border() -> None:
    fx, fy, cx, cy = PINHOLE.intrinsics_px
    width, height = PINHOLE.size_px

    def seen(u: float, v: float, depth: float = 4.0) -> bool:
        return bool(camera_model.project(PINHOLE, depth * np.array([(u - cx) / fx, (v - cy) / fy, 1.0]))[1])

    assert seen(-0.499, 0) and seen(0, -0.499) and seen(width - 0.501, height - 0.501)
    assert not seen(-0.501, 0) and not seen(0, -0.501) and not seen(width - 0.499, 0) and not seen(0, height - 0.499)
    assert not seen(cx, cy, depth=-4.0)
    assert not camera_model.project(PINHOLE, np.zeros(3))[1]


def test_a_fisheye_sees_past_ninety_degrees() -> None:
    """The corner of a TUM-VI image is 108° off the axis: its ray points backwards, on the same side as its pixel."""
    corner = camera_model.bearings(TUMVI, np.array([0.0, 0.0]))
    assert corner[2] < -0.2 and corner[0] < -0.5 and corner[1] < -0.5
    border = np.stack([np.linspace(300.0, 511.0, 200), np.full(200, 257.0)], axis=-1)
    angles = np.arccos(camera_model.bearings(TUMVI, border)[:, 2])
    assert np.all(np.diff(angles) > 0.0)
    # At depth 1 there is no such point; it stays far out on its own side instead of jumping across.
    assert np.all(camera_model.normalised(TUMVI, border)[:, 0] > 0.0)


def test_shapes_follow_the_input() -> None:
    points = np.random.default_rng(3).uniform(0.5, 1.0, (2, 5, 3))
    pixels, visible = camera_model.project(EUROC, points)
    assert pixels.shape == (2, 5, 2) and visible.shape == (2, 5)
    assert camera_model.bearings(TUMVI, pixels).shape == (2, 5, 3)


def test_a_rig_of_two_cameras_agrees_on_a_point() -> None:
    """Extrinsics and projection together: a point seen by two cameras of one body lies on both their rays."""
    T_body_cams = se3.exp(np.array([[0.1, 0.2, -0.1, 0.1, 0.0, 0.0], [-0.1, 0.1, 0.0, -0.1, 0.05, 0.0]]))
    point_body = np.array([0.4, -0.3, 5.0])
    for T_body_cam in T_body_cams:
        point_cam = se3.transform(se3.inverse(T_body_cam), point_body[None])[0]
        pixel, visible = camera_model.project(EUROC, point_cam)
        assert visible
        ray = T_body_cam[:3, :3] @ camera_model.bearings(EUROC, pixel)
        to_point = point_body - T_body_cam[:3, 3]
        assert so3.angle(so3.from_two_vectors(ray, to_point)) < 1e-8
