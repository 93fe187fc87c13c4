"""The steps of a start in motion, each on exact data: rotations, bias, path, alignment, increments."""

import numpy as np
import pytest

from moving_scene import GRAVITY, R_BODY_CAM, Scene, rig
from vioframe.geometry import so3
from vioframe.tight.gyro_bias import PairedPoints, fit_rotations
from vioframe.tight.inertial_window import InertialWindow
from vioframe.tight.linear_alignment import Views, align, solve_path
from vioframe.tight.rotation_agreement import compare_rotations
from vioframe.tight.two_view_rotation import relative_rotations
from vioframe.types import ImuBias
from vioframe_preintegration import Preintegration

TIMES = np.arange(0.0, 2.01, 0.1)
SCENE = Scene(noise=False)
WINDOW = InertialWindow([SCENE.imu(2.5)], 0)
GYRO_BIAS, ACCEL_BIAS = np.array(SCENE.gyro_bias), np.array(SCENE.accel_bias)


def rays(times=TIMES, count=60, sigma=0.0):
    """Unit rays (K, count, 3) to points ahead, in the camera, and R_world_body, p."""
    R, p = SCENE.pose(times)
    rng = np.random.default_rng(0)
    R_cam = R @ R_BODY_CAM
    centre = p + R @ rig().cameras[0].T_body_cam[:3, 3]
    points = centre[0] + rng.uniform([-3, -3, 3], [3, 3, 8], size=(count, 3)) @ R_cam[0].T
    seen = (points[None] - centre[:, None]) @ R_cam
    seen = seen / np.linalg.norm(seen, axis=-1, keepdims=True) + sigma * rng.normal(size=seen.shape)
    return seen / np.linalg.norm(seen, axis=-1, keepdims=True), R, p


def pairs(stride=2, sigma=1e-4):
    seen, R, _ = rays(sigma=sigma)
    first, second = np.arange(len(TIMES) - stride), np.arange(stride, len(TIMES))
    return PairedPoints(
        starts=TIMES[first],
        ends=TIMES[second],
        first=seen[first],
        second=seen[second],
        common=np.ones((len(first), seen.shape[1]), dtype=bool),
        sigma=max(sigma, 1e-5),
    ), R[first].swapaxes(-1, -2) @ R[second]


def test_two_view_rotations_are_exact_from_either_start():
    made, turned = pairs(sigma=0.0)
    truth = R_BODY_CAM.T @ turned @ R_BODY_CAM
    still = np.tile(np.eye(3), (len(truth), 1, 1))
    found = relative_rotations(made.first, made.second, made.common, (still,), 1e-3)
    assert so3.angle(truth.swapaxes(-1, -2) @ found.R).max() < 1e-4


def test_two_view_rotations_bear_tracks_that_slipped():
    made, turned = pairs()
    truth = R_BODY_CAM.T @ turned @ R_BODY_CAM
    second = made.second.copy()
    second[:, :6] += [0.0, 0.01, 0.0]
    starts = (np.tile(np.eye(3), (len(truth), 1, 1)), truth)
    found = relative_rotations(made.first, second, made.common, starts, 1e-3)
    assert np.median(so3.angle(truth.swapaxes(-1, -2) @ found.R)) < 3e-3


def test_the_rotation_of_a_camera_that_only_turns_is_determined():
    seen, _, _ = rays()
    turn = so3.exp(np.array([0.05, -0.1, 0.02]))
    common = np.ones((1, seen.shape[1]), dtype=bool)
    found = relative_rotations(seen[:1], seen[:1] @ turn, common, (np.eye(3)[None],), 1e-3)
    assert so3.angle(turn.T @ found.R[0]) < 1e-6


def test_gyro_and_camera_agree_and_give_the_bias():
    made, _ = pairs()
    still = np.tile(np.eye(3), (len(made.starts), 1, 1))
    seen = relative_rotations(made.first, made.second, made.common, (still,), made.sigma)
    agreement = compare_rotations(WINDOW, made.starts, made.ends, seen, R_BODY_CAM)
    assert agreement.residual < 0.05 * agreement.turning
    assert agreement.residual_mirrored > 2.0 * agreement.residual
    assert abs(agreement.delay_s) < 3e-3
    np.testing.assert_allclose(agreement.gyro_bias, GYRO_BIAS, atol=0.01)
    assert so3.angle(agreement.R_body_cam.T @ R_BODY_CAM) < np.radians(1.5)


def test_bias_and_rotation_are_fitted_from_a_few_degrees_off():
    made, _ = pairs(stride=4)
    wrong = R_BODY_CAM @ so3.exp(np.array([0.03, -0.04, 0.02]))
    fit = fit_rotations(WINDOW, made, wrong, np.zeros(3), 0.5)
    np.testing.assert_allclose(fit.gyro_bias, GYRO_BIAS, atol=2e-3)
    error = so3.angle(fit.R_body_cam.T @ R_BODY_CAM)
    assert error < np.radians(0.3)
    assert error < 4.0 * fit.rotation_sigma


def linear(sign=1.0, accel_bias=ACCEL_BIAS):
    """Alignment by the true rotations; ``sign`` of the accelerometer."""
    seen, R, p = rays()
    turned = R[0].T @ R
    lever = turned @ rig().cameras[0].T_body_cam[:3, 3]
    views = Views(
        instants=np.arange(len(TIMES)),
        direction=seen @ R_BODY_CAM.T @ turned.swapaxes(-1, -2),
        seen=np.ones(seen.shape[:2], dtype=bool),
        lever=lever,
        metric=False,
    )
    path = solve_path(views)
    bias = ImuBias(gyro=GYRO_BIAS, accel=accel_bias)
    inc = WINDOW.increments(np.zeros(len(TIMES) - 1), TIMES[1:], bias, rig().imu)
    moved = sign * np.concatenate([np.zeros((1, 3)), inc.delta_p])
    bend = np.concatenate([np.zeros((1, 3, 3)), -inc.bias_jacobian[:, 6:, 3:]])
    alignment = align(
        path, TIMES, moved + lever - lever[0], bend, gravity=GRAVITY, accel_bias_sigma=0.1, path_sigma=0.01
    )
    return path, alignment, R, p, lever


def test_path_scale_velocity_and_gravity_are_exact():
    path, alignment, R, p, lever = linear()
    assert path.ahead == 1.0
    places = alignment.scale * path.places - lever + lever[0]
    np.testing.assert_allclose(places, (p - p[0]) @ R[0], atol=2e-3)
    np.testing.assert_allclose(alignment.velocity, R[0].T @ SCENE.velocity(TIMES[:1])[0], atol=5e-3)
    np.testing.assert_allclose(alignment.gravity, R[0].T @ [0.0, 0.0, -GRAVITY], atol=0.02)
    assert alignment.free_gravity == pytest.approx(GRAVITY, abs=0.05)


def test_an_accelerometer_of_the_wrong_sign_turns_the_scale_negative():
    _, right, *_ = linear()
    _, wrong, *_ = linear(sign=-1.0)
    assert right.scale > 0.0
    assert wrong.scale < 0.0


def test_increments_are_those_of_the_integrator():
    integrator = Preintegration()
    integrator.setup(rig())
    bias = ImuBias(gyro=GYRO_BIAS, accel=ACCEL_BIAS)
    expected = integrator.integrate(SCENE.imu(0.5), bias)
    found = WINDOW.increments(np.zeros(1), np.array([0.5]), bias, rig().imu)
    np.testing.assert_allclose(found.delta_R[0], expected.delta_R, atol=1e-6)
    np.testing.assert_allclose(found.delta_v[0], expected.delta_v, atol=1e-4)
    np.testing.assert_allclose(found.delta_p[0], expected.delta_p, atol=1e-4)
    np.testing.assert_allclose(found.bias_jacobian[0], expected.bias_jacobian, atol=5e-3)
    np.testing.assert_allclose(np.diag(found.covariance[0]), np.diag(expected.covariance), rtol=0.1)


def test_the_bias_jacobian_is_that_of_the_increments():
    bias = ImuBias(gyro=GYRO_BIAS, accel=ACCEL_BIAS)
    start, end, noise = np.array([0.203]), np.array([0.651]), rig().imu
    found = WINDOW.increments(start, end, bias, noise)
    for axis in range(6):
        change = np.zeros(6)
        change[axis] = 1e-5
        other = ImuBias(gyro=bias.gyro + change[:3], accel=bias.accel + change[3:])
        moved = WINDOW.increments(start, end, other, noise)
        slope = np.concatenate(
            [
                so3.log(found.delta_R[0].T @ moved.delta_R[0]),
                moved.delta_v[0] - found.delta_v[0],
                moved.delta_p[0] - found.delta_p[0],
            ]
        )
        np.testing.assert_allclose(slope / 1e-5, found.bias_jacobian[0, :, axis], atol=2e-3)
