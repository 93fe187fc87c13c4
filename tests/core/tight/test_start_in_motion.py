"""A start in motion on exact scenes: what it must recover, and that it keeps little."""

from dataclasses import replace

import numpy as np
import pytest

from moving_scene import R_BODY_CAM, Scene, rig, turned_rig
from vioframe.errors import ConfigError
from vioframe.geometry import so3
from vioframe.tight.motion_options import MotionStartOptions
from vioframe.tight.motion_start import MotionStart
from vioframe.tight.motion_window import MotionWindow
from vioframe.tight.options import CalibrationOptions
from vioframe.tight.start import Starter, TightStartOptions
from vioframe.tight.step import Start
from vioframe.types import NavState


def start_of(scene, *, the_rig=None, calibration=None, duration_s=4.0, **options):
    motion = MotionStart(
        the_rig or rig(scene.cameras), MotionStartOptions(**options), calibration or CalibrationOptions()
    )
    for measurement in scene.measurements(duration_s):
        start, _ = motion.push(measurement)
        if start is not None:
            return start
    raise AssertionError("no start")


def errors(start: Start, scene: Scene):
    """Tilt (rad), velocity in the body (m/s) and gyro bias (rad/s) errors, (7,): tilt 2, v 3, |b_g|, scale."""
    state = start.state
    t = np.array([state.stamp_ns * 1e-9])
    R, _ = scene.pose(t)
    v = scene.velocity(t)[0]
    tilt = np.arccos(np.clip(R[0][2] @ state.T_world_body[2, :3], -1.0, 1.0))
    in_body = state.T_world_body[:3, :3].T @ state.v_world_body - R[0].T @ v
    return float(tilt), float(np.linalg.norm(in_body)), float(np.linalg.norm(state.bias.gyro - scene.gyro_bias))


@pytest.mark.parametrize("cameras", [1, 2])
def test_exact_data_give_the_exact_state(cameras):
    scene = Scene(pixel_noise=0.0, noise=False, accel_bias=(0.0, 0.0, 0.0), cameras=cameras)
    start = start_of(scene, shortest_s=1.5)
    tilt, velocity, gyro_bias = errors(start, scene)
    # What is left is the interpolation of samples 5 ms apart.
    assert tilt < 2e-3
    assert velocity < 5e-3
    assert gyro_bias < 5e-4
    assert np.linalg.norm(start.state.bias.accel) < 0.02


@pytest.mark.parametrize("seed", range(4))
def test_noisy_data_stay_within_the_stated_covariance(seed):
    scene = Scene(seed=seed)
    start = start_of(scene)
    tilt, velocity, gyro_bias = errors(start, scene)
    variances = np.diag(start.state.covariance)
    assert tilt < 3.0 * np.sqrt(variances[:3].sum())
    assert velocity < 3.0 * np.sqrt(variances[6:9].sum())
    assert gyro_bias < 3.0 * np.sqrt(variances[9:12].sum())
    assert velocity < 0.05 * np.linalg.norm(scene.velocity(np.array([start.state.stamp_ns * 1e-9])))


def test_the_covariance_is_symmetric_and_positive():
    covariance = start_of(Scene()).state.covariance
    np.testing.assert_allclose(covariance, covariance.T, atol=1e-12)
    assert np.linalg.eigvalsh(covariance).min() > 0.0


def test_the_windows_after_the_state_are_replayed():
    start = start_of(Scene())
    assert start.method == "motion"
    assert start.replay[0].window.previous.stamp_ns == start.state.stamp_ns
    for before, after in zip(start.replay[:-1], start.replay[1:], strict=True):
        assert before.window.current.stamp_ns == after.window.previous.stamp_ns


@pytest.mark.parametrize("delay_s", [-0.04, 0.04])
def test_a_delay_of_the_camera_is_found(delay_s):
    scene = Scene(delay_s=delay_s)
    start = start_of(scene)
    # Images show what was ``delay_s`` before their stamp.
    assert start.camera_delay_s == pytest.approx(-delay_s, abs=4e-3)
    tilt, velocity, _ = errors(start, scene)
    assert tilt < np.radians(1.0)
    assert velocity < 0.06


def test_the_cameras_rotation_is_found_from_nothing():
    start = start_of(
        Scene(), the_rig=turned_rig(90.0, (0.0, 0.0, 1.0)), calibration=CalibrationOptions(extrinsics="find")
    )
    assert start.T_body_cam is not None
    error = so3.angle(start.T_body_cam[:3, :3].T @ R_BODY_CAM)
    assert error < np.radians(1.0)
    assert error < 3.0 * start.rotation_sigma


def test_a_camera_turned_by_three_degrees_starts():
    scene = Scene()
    tilt, velocity, _ = errors(start_of(scene, the_rig=turned_rig(3.0, (0.6, 0.8, 0.0))), scene)
    assert tilt < np.radians(2.0)
    assert velocity < 0.06


def test_the_window_forgets_what_is_old_and_keeps_no_pixels():
    window = MotionWindow(1.0)
    image = np.zeros((4, 4), dtype=np.uint8)
    for measurement in Scene().measurements(3.0):
        frame = replace(measurement.window.current, images=(image,))
        window.push(
            replace(
                measurement,
                window=replace(measurement.window, current=frame),
                features=replace(measurement.features, frame=frame),
            )
        )
    assert window.span_s == pytest.approx(1.0)
    assert len(window) == 21
    for kept in window.after_origin:
        assert not kept.window.current.images
        assert not kept.window.previous.images
        assert not kept.features.frame.images


def test_a_hole_between_windows_forgets_what_came_before():
    window = MotionWindow(2.0)
    measurements = list(Scene().measurements(1.0))
    for measurement in (*measurements[:5], *measurements[10:12]):
        window.push(measurement)
    assert len(window) == 2


def test_a_given_state_starts_at_once_with_the_stated_sigmas():
    starter = Starter(rig(), TightStartOptions(method="motion", velocity_sigma=0.3), CalibrationOptions())
    measurement = next(Scene().measurements(1.0))
    starter.give(NavState(stamp_ns=0, T_world_body=np.eye(4)))
    start = starter.push(measurement)
    assert start.method == "given"
    assert start.replay == (measurement,)
    assert start.state.covariance[6, 6] == pytest.approx(0.09)
    assert [(each.method, each.succeeded) for each in starter.attempts] == [("given", True)]


@pytest.mark.parametrize("name", ["shortest_s", "pixel_sigma", "max_scale_sigma"])
def test_options_must_be_positive(name):
    with pytest.raises(ConfigError, match=f"fuser.start.motion.{name}"):
        MotionStartOptions(**{name: 0.0})


def test_the_longest_window_cannot_be_shorter_than_the_shortest():
    with pytest.raises(ConfigError, match="longest_s"):
        MotionStartOptions(shortest_s=2.0, longest_s=1.0)
