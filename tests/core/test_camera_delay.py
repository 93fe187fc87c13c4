"""The delay of a camera is found from the rotations of odometry and gyro, and from nothing else."""

import logging
from dataclasses import replace

import numpy as np
import pytest

from composing import composed
from vioframe.build import build_dataset, build_pipeline
from vioframe.camera_delay import DelayEstimator, DelayOptions
from vioframe.conventions import NANOSECONDS
from vioframe.errors import ConfigError
from vioframe.evaluation.rows import evaluate_run
from vioframe.geometry import se3, so3
from vioframe.tasks.run_sequence import run_sequence
from vioframe.types import (
    Camera,
    Frame,
    ImuBias,
    ImuBlock,
    ImuNoise,
    InertialDelta,
    Measurement,
    RelativePose,
    SensorRig,
    SyncedWindow,
)

STEP_S = 0.1
RIG = SensorRig(
    cameras=(
        Camera(
            model="pinhole",
            intrinsics_px=np.array([100.0, 100.0, 50.0, 40.0]),
            size_px=(100, 80),
            T_body_cam=se3.exp(np.array([0.4, -1.2, 0.7, 0.1, 0.2, 0.3])),
        ),
    ),
    imu=ImuNoise(gyro_noise=1e-4, gyro_walk=1e-5, accel_noise=1e-3, accel_walk=1e-4, rate_hz=100.0),
    gravity=9.81,
    camera_delay_ns=20_000_000,
)


def rotation(t_s: float):
    """Of the body at an instant: a turn about one axis that swings."""
    return so3.exp(np.array([0.2, 0.1, 1.0]) * 0.8 * np.sin(1.3 * t_s))


def rate(t_s: float):
    return np.array([0.2, 0.1, 1.0]) * 0.8 * 1.3 * np.cos(1.3 * t_s)


def stamped(t_s: float) -> int:
    return round(t_s * NANOSECONDS)


def window_at(start_s: float, previous_s: float, current_s: float, true_s: float, noise=0.0, velocity=0.0, rng=None):
    """A window whose images were stamped with two delays, while the camera's true delay is ``true_s``."""
    # Camera clock, then the IMU clock as it is assumed, then as it is.
    told = start_s + previous_s, start_s + STEP_S + current_s
    true = start_s + true_s, start_s + STEP_S + true_s
    T_body_cam = RIG.cameras[0].T_body_cam
    T_prev_cur_body = np.eye(4)
    T_prev_cur_body[:3, :3] = rotation(true[0]).T @ rotation(true[1])
    T_prev_cur_body[0, 3] = velocity * STEP_S
    T_prev_cur = se3.inverse(T_body_cam) @ T_prev_cur_body @ T_body_cam
    if rng is not None:
        T_prev_cur = T_prev_cur @ se3.exp(noise * np.concatenate([rng.standard_normal(3), np.zeros(3)]))
    stamps = np.array([stamped(t) for t in told])
    imu = ImuBlock(stamps_ns=stamps, gyro=np.array([rate(t) for t in told]), accel=np.zeros((2, 3)))
    delta = InertialDelta(
        delta_R=rotation(told[0]).T @ rotation(told[1]),
        delta_v=np.zeros(3),
        delta_p=np.zeros(3),
        duration_s=told[1] - told[0],
        covariance=1e-8 * np.eye(9),
        bias=ImuBias(),
        bias_jacobian=np.zeros((9, 6)),
        path=None,
    )
    return Measurement(
        window=SyncedWindow(
            previous=Frame(stamp_ns=int(stamps[0])),
            current=Frame(stamp_ns=int(stamps[1])),
            imu=imu,
            gap_ns=1,
            camera_delay_ns=stamped(current_s),
        ),
        relative_pose=RelativePose(
            T_prev_cur=T_prev_cur, covariance=np.diag(np.repeat([max(noise, 1e-4) ** 2, 1e-4], 3)), inliers=10
        ),
        inertial_delta=delta,
    )


def follow(true_s: float, count: int, **options):
    """An estimator that has seen so many windows, each stamped as it wished; and what it assumed, s."""
    estimator = DelayEstimator(DelayOptions(estimate=True, **options), RIG, 1.0, 0.002)
    rng = np.random.default_rng(1)
    assumed = [RIG.camera_delay_ns / NANOSECONDS]
    for k in range(count):
        previous_s, current_s = assumed[-2:] if len(assumed) > 1 else assumed * 2
        estimator.learn(window_at(k * STEP_S, previous_s, current_s, true_s, noise=0.002, rng=rng), ImuBias())
        assumed.append(estimator.assumed_ns() / NANOSECONDS)
    return estimator, np.array(assumed)


@pytest.mark.parametrize("off_s", [-0.05, 0.0, 0.05])
def test_delay_is_found_and_followed_a_little_at_a_time(off_s):
    true_s = 0.02 + off_s
    estimator, assumed = follow(true_s, 150)
    assert estimator.change_s == pytest.approx(off_s, abs=0.005)
    assert estimator.sigma_s < 0.002
    assert assumed[-1] == pytest.approx(true_s, abs=0.005)
    assert np.abs(np.diff(assumed)).max() <= 0.005 + 1e-9


def test_error_is_of_the_size_that_is_stated():
    """Sixteen runs: the mean of sixteen squared errors, each over its variance, lies in χ²'s 0.999 interval."""
    squares = []
    for seed in range(16):
        estimator = DelayEstimator(DelayOptions(estimate=True, walk=0.0), RIG, 1.0, 0.002)
        rng = np.random.default_rng(seed)
        for k in range(40):
            estimator.learn(window_at(k * STEP_S, 0.02, 0.02, 0.025, noise=0.004, rng=rng), ImuBias())
        squares.append(((estimator.change_s - 0.005) / estimator.sigma_s) ** 2)
    # The factor that odometry is distrusted by is 1 or more, so errors may be smaller than told.
    assert 0.1 < np.mean(squares) < 2.7


def test_constant_turn_tells_nothing():
    estimator = DelayEstimator(DelayOptions(estimate=True), RIG, 1.0, 0.002)
    still = window_at(0.0, 0.02, 0.02, 0.05)
    gyro = np.tile(still.window.imu.gyro[:1], (2, 1))
    turning = so3.exp(gyro[0] * STEP_S)
    R_body_cam = RIG.cameras[0].T_body_cam[:3, :3]
    T_prev_cur = np.eye(4)
    T_prev_cur[:3, :3] = R_body_cam.T @ turning @ R_body_cam
    window = replace(still.window, imu=replace(still.window.imu, gyro=gyro))
    same = replace(
        still,
        window=window,
        relative_pose=replace(still.relative_pose, T_prev_cur=T_prev_cur),
        inertial_delta=replace(still.inertial_delta, delta_R=turning),
    )
    for _ in range(50):
        estimator.learn(same, ImuBias())
    assert estimator.sigma_s > 0.049
    assert estimator.assumed_ns() == RIG.camera_delay_ns


def test_motion_is_told_for_the_window_where_its_images_were_stamped_differently():
    """At the same velocity over a window that is longer than the time between the images."""
    estimator = DelayEstimator(DelayOptions(estimate=True), RIG, 1.0, 0.002)
    first = window_at(0.0, 0.02, 0.02, 0.02, velocity=2.0)
    assert estimator.learn(first, ImuBias()) is first
    told = estimator.learn(window_at(STEP_S, 0.02, 0.03, 0.02, velocity=2.0), ImuBias())
    moved = se3.log(told.relative_pose.T_prev_cur)
    before = se3.log(window_at(STEP_S, 0.02, 0.03, 0.02, velocity=2.0).relative_pose.T_prev_cur)
    assert np.allclose(moved, before * 0.11 / 0.10, atol=1e-9)


def test_window_that_lacks_a_sensor_teaches_nothing():
    estimator = DelayEstimator(DelayOptions(estimate=True), RIG, 1.0, 0.002)
    whole = window_at(0.0, 0.02, 0.02, 0.05)
    for lame in (
        replace(whole, relative_pose=RelativePose.invalid()),
        replace(whole, relative_pose=None),
        replace(whole, inertial_delta=None, window=replace(whole.window, imu=ImuBlock.none())),
    ):
        assert estimator.learn(lame, ImuBias()) is lame
    assert estimator.sigma_s == pytest.approx(0.05) and estimator.change_s == 0.0


def test_filter_gets_back_what_an_offset_costs(tmp_path):
    logging.disable(logging.WARNING)
    try:
        errors = {}
        for off_s, estimate in ((0.0, False), (0.06, False), (0.06, True)):
            config = composed(
                "fuser=msf",
                "vo=simulated",
                "vo.translation_noise=0.005",
                "dataset.duration_s=12",
                f"faults.time_offset_s={off_s}",
                f"fuser.camera_delay.estimate={str(estimate).lower()}",
            )
            dataset = build_dataset(config)
            run, _, stop = run_sequence(
                build_pipeline(config, {}),
                dataset.open(dataset.sequences[0]),
                folder=tmp_path,
                init="groundtruth",
                sample_count=0,
                progress=lambda done: None,
            )
            assert stop is None
            errors[off_s, estimate] = evaluate_run(run)["ate_se3_m"]
            found = run.calibration
    finally:
        logging.disable(logging.NOTSET)
    assert found["camera delay"].value == pytest.approx(60.0, abs=4.0)
    assert errors[0.06, True] < 0.5 * (errors[0.0, False] + errors[0.06, False])


def test_two_delays_are_refused():
    from vioframe_msf import MsfFuser

    with pytest.raises(ConfigError, match=r"fuser\.delay_s=0\.01 and fuser\.camera_delay\.estimate=true"):
        MsfFuser(delay_s=0.01, camera_delay=DelayOptions(estimate=True))


@pytest.mark.parametrize("options", [{"sigma_s": 0.0}, {"walk": -1.0}, {"follow_s": 0.0}])
def test_wrong_values_are_refused(options):
    with pytest.raises(ConfigError, match=r"fuser\.camera_delay"):
        DelayOptions(**options)
