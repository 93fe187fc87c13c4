"""What flows between the parts: wrong values are refused where they are made, with field, expected and got."""

from dataclasses import replace

import numpy as np
import pytest

from vioframe.errors import ClockError, ShapeError
from vioframe.geometry import se3, so3
from vioframe.testing import make_scene, measurement_of
from vioframe.types import (
    Camera,
    Frame,
    ImuBias,
    ImuBlock,
    ImuNoise,
    NavState,
    RelativePose,
    SyncedWindow,
    Tracks,
    Trajectory,
)

SCENE = make_scene()


def block(stamps, gyro=None, accel=None):
    n = len(stamps)
    return ImuBlock(
        stamps_ns=np.array(stamps, dtype=np.int64),
        gyro=np.zeros((n, 3)) if gyro is None else gyro,
        accel=np.zeros((n, 3)) if accel is None else accel,
    )


@pytest.mark.parametrize(
    ("stamps", "words"),
    [([0, 10, 10], "entry 2 repeats: 10 then 10"), ([0, 10, 5], "entry 2 goes back: 10 then 5")],
)
def test_stamps_that_do_not_increase(stamps, words):
    with pytest.raises(ClockError, match=words):
        block(stamps)


def test_inertial_samples_of_the_wrong_shape_or_value():
    with pytest.raises(ShapeError, match=r"ImuBlock.gyro must have shape \(2, 3\), got \(2, 2\)"):
        block([0, 1], gyro=np.zeros((2, 2)))
    bad = np.zeros((2, 3))
    bad[1, 2] = np.nan
    with pytest.raises(ShapeError, match=r"ImuBlock.accel must be finite, got nan at index \(1, 2\)"):
        block([0, 1], accel=bad)
    with pytest.raises(ShapeError, match=r"ImuBlock.stamps_ns must be of kind integer, got float64"):
        ImuBlock(stamps_ns=np.array([0.0]), gyro=np.zeros((1, 3)), accel=np.zeros((1, 3)))


def test_images_that_are_not_uint8():
    with pytest.raises(ShapeError, match=r"Frame.images\[0\]"):
        Frame(stamp_ns=0, images=(np.zeros((4, 4)),))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"model": "fisheye9"}, "must be one of pinhole, radtan, equidistant"),
        ({"model": "radtan"}, "4 or 5 values, got 0"),
        ({"intrinsics_px": np.array([0.0, 1.0, 1.0, 1.0])}, "positive fx, fy"),
        ({"size_px": (0, 10)}, "size_px"),
        ({"T_body_cam": 2 * np.eye(4)}, "rigid motion"),
        ({"T_body_cam": np.diag([1.0, 1.0, -1.0, 1.0])}, "mirrored"),
    ],
)
def test_calibration_that_cannot_be(change, words):
    good = {
        "model": "pinhole",
        "intrinsics_px": np.array([100.0, 100.0, 50.0, 40.0]),
        "size_px": (100, 80),
        "T_body_cam": np.eye(4),
    }
    Camera(**good)
    with pytest.raises(ShapeError, match=words):
        Camera(**{**good, **change})


def test_noise_that_cannot_be():
    with pytest.raises(ShapeError, match="gyro_walk must not be negative"):
        ImuNoise(gyro_noise=0.0, gyro_walk=-1.0, accel_noise=0.0, accel_walk=0.0, rate_hz=100.0)
    with pytest.raises(ShapeError, match="rate_hz must be positive"):
        ImuNoise(gyro_noise=0.0, gyro_walk=0.0, accel_noise=0.0, accel_walk=0.0, rate_hz=0.0)


def test_window_whose_samples_miss_its_ends():
    window = SCENE.windows[0]
    with pytest.raises(ShapeError, match="begin and end at the stamps of the frames"):
        SyncedWindow(previous=window.previous, current=window.current, imu=SCENE.windows[1].imu, gap_ns=0)


def test_tracks_of_different_lengths():
    with pytest.raises(ShapeError, match=r"Tracks.pixels must have shape \(2, 2\), got \(1, 2\)"):
        Tracks(ids=np.arange(2), pixels=np.zeros((1, 2)), bearings=np.zeros((2, 3)), scores=np.zeros(2))


def test_trajectory_that_is_none():
    with pytest.raises(ShapeError, match="rigid"):
        Trajectory(stamps_ns=np.array([0]), T_world_body=np.zeros((1, 4, 4)))
    with pytest.raises(ClockError):
        Trajectory(stamps_ns=np.array([1, 0]), T_world_body=np.stack([np.eye(4)] * 2))


def test_states_make_a_trajectory_also_when_there_are_none():
    assert len(Trajectory.from_states([])) == 0
    made = Trajectory.from_states([NavState(stamp_ns=5, T_world_body=np.eye(4))])
    assert made.causal and made.stamps_ns.tolist() == [5]


def test_camera_motion_in_the_body_undoes_the_lever_arm():
    random = np.random.default_rng(3)
    T_body_cam = SCENE.rig.cameras[0].T_body_cam
    T_prev_cur_body = se3.exp(random.normal(size=6) * 0.3)
    T_prev_cur_cam = se3.inverse(T_body_cam) @ T_prev_cur_body @ T_body_cam
    scaled = T_prev_cur_cam.copy()
    scaled[:3, 3] /= 4.0
    np.testing.assert_allclose(RelativePose(T_prev_cur=scaled).in_body(SCENE.rig, 4.0), T_prev_cur_body, atol=1e-12)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_motion_that_is_not_finite_is_none(bad: float) -> None:
    T = np.eye(4)
    T[0, 3] = bad
    covariance = np.eye(6)
    covariance[2, 2] = bad
    for pose in (RelativePose(T_prev_cur=T), RelativePose(T_prev_cur=np.eye(4), covariance=covariance)):
        assert not pose.valid
        np.testing.assert_array_equal(pose.T_prev_cur, np.eye(4))
        assert pose.covariance is None


def test_increment_at_another_bias_is_first_order_near_and_integrated_again_far():
    delta = measurement_of(SCENE, 0, SCENE.windows[0]).inertial_delta
    asked = []

    def reintegrate(bias):
        asked.append(bias)
        return delta

    with_source = replace(delta, reintegrate=reintegrate)
    near = ImuBias(gyro=np.array([1e-3, 0.0, 0.0]), accel=np.array([0.0, 1e-2, 0.0]))
    moved = with_source.at(near)
    assert not asked and moved.bias is near
    expected = delta.delta_R @ so3.exp(delta.bias_jacobian[:3, :3] @ near.gyro)
    np.testing.assert_allclose(moved.delta_R, expected, atol=1e-15)
    np.testing.assert_allclose(moved.delta_v - delta.delta_v, delta.bias_jacobian[3:6, 3:] @ near.accel, atol=1e-15)
    with_source.at(ImuBias(gyro=np.array([0.5, 0.0, 0.0])))
    assert len(asked) == 1
