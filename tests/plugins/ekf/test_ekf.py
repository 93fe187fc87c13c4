"""The loosely coupled filter: Jacobians, consistency, gauge, and what it does with bad measurements."""

import time
from dataclasses import replace

import numpy as np
import pytest

from filter_runs import assert_honest, benchmark, chi_square_interval, play, record, simulated, without_vo
from vioframe.data.simulator import ImuSettings
from vioframe.error_state import Body, InertialFilter, retract
from vioframe.errors import ConfigError, StateError
from vioframe.fusion_options import InertialOptions, StandstillOptions, StartOptions, VisualOptions
from vioframe.geometry import se3, so3
from vioframe.initialisation import initial_covariance
from vioframe.loose_fusion import VisualMotion
from vioframe.metric_fusion import relative_pose_measurement
from vioframe.testing import check_component
from vioframe.types import ImuBias, ImuBlock, ImuNoise, InertialDelta, NavState, RelativePose, SensorRig
from vioframe_ekf import EkfFuser
from vioframe_preintegration import Preintegration

NOISE = ImuNoise(gyro_noise=2e-4, gyro_walk=2e-5, accel_noise=2e-3, accel_walk=3e-3, rate_hz=200.0)
VO = {"rotation_noise": 0.002, "translation_noise": 0.02}


@pytest.fixture(scope="module")
def walk():
    recording = simulated("walk", 6.0)
    return recording, record(recording, **VO)


def test_keeps_the_contract():
    check_component(EkfFuser())


def test_measurement_jacobian_against_finite_differences():
    rng = np.random.default_rng(2)
    T_body_cam = se3.exp(rng.normal(size=6))
    filter_ = InertialFilter(extra=0, noise=NOISE, gravity=9.81)
    body = Body(R=so3.exp(rng.normal(size=3)), p=rng.normal(size=3), v=rng.normal(size=3), bias=ImuBias())
    state = NavState(stamp_ns=0, T_world_body=body.T_world_body, v_world_body=body.v)
    filter_.start(state, initial_covariance(body.R))
    filter_.clone_pose()
    delta = InertialDelta(
        delta_R=so3.exp(rng.normal(size=3) * 0.3),
        delta_v=rng.normal(size=3),
        delta_p=rng.normal(size=3),
        duration_s=0.1,
        covariance=np.eye(9),
        bias=ImuBias(),
        bias_jacobian=np.zeros((9, 6)),
    )
    filter_.propagate(delta)
    now, T_clone = filter_.body, filter_.T_world_clone

    def residual(error):
        """What the filter would see if the truth were off by this error and the VO exact."""
        T_now = retract(now, error[:15]).T_world_body @ T_body_cam
        T_before = se3.exp(error[15:]) @ T_clone @ T_body_cam
        motion = VisualMotion(T_prev_cur=se3.inverse(T_before) @ T_now, covariance=np.eye(6))
        return relative_pose_measurement(filter_, T_body_cam, motion)

    H, at_truth, _ = residual(np.zeros(21))
    np.testing.assert_allclose(at_truth, 0.0, atol=1e-12)
    step = 1e-5
    numerical = np.stack([(residual(step * e)[1] - residual(-step * e)[1]) / (2 * step) for e in np.eye(21)], axis=1)
    np.testing.assert_allclose(H, numerical, atol=1e-6)
    # A turn about the vertical, or a shift, of both poses is not seen.
    for direction in ([0, 0, 1, 0, 0, 0], [0, 0, 0, 1, 0, 0], [0, 0, 0, 0, 1, 0], [0, 0, 0, 0, 0, 1]):
        np.testing.assert_allclose(H @ np.concatenate([direction, np.zeros(9), direction]), 0.0, atol=1e-12)


def test_nees_lies_inside_its_bounds():
    """The last states of independent runs: N·dof times the mean NEES is χ² with N·dof degrees of freedom."""
    runs = [benchmark("consistency").run_once("ekf", seed, "walk", 6.0) for seed in range(14)]
    for block, degrees in {"orientation": 3, "position": 3, "velocity": 3, "all 15": 15}.items():
        low, high = chi_square_interval(degrees * len(runs))
        anees = np.mean([run.final[block] for run in runs])
        assert low < anees < high, (block, anees, low, high)


def test_exact_measurements_close_the_path(walk):
    recording, _ = walk
    run = record(recording, rotation_noise=1e-7, translation_noise=1e-6)
    sure = StartOptions(tilt_sigma=1e-6, yaw_sigma=1e-6, position_sigma=1e-6)
    out = play(EkfFuser(start=sure), recording, run)
    assert out.position_errors().max() < 1e-3
    assert out.rotation_errors().max() < 1e-4


def test_a_turned_and_shifted_world_changes_nothing(walk):
    recording, run = walk
    straight = play(EkfFuser(), recording, run)
    T_other_world = se3.from_parts(so3.rotation_z(2.1), np.array([100.0, -50.0, 20.0]))
    start = run.true_state(run.measurements[0].window.previous.stamp_ns)
    turned_start = replace(
        start,
        T_world_body=T_other_world @ start.T_world_body,
        v_world_body=T_other_world[:3, :3] @ start.v_world_body,
    )
    turned = play(EkfFuser(), recording, run, initial=turned_start)
    for a, b in zip(straight.states, turned.states, strict=True):
        np.testing.assert_allclose(T_other_world @ a.T_world_body, b.T_world_body, atol=1e-8)
        np.testing.assert_allclose(a.bias.gyro, b.bias.gyro, atol=1e-10)
        np.testing.assert_allclose(a.covariance[:3, :3], b.covariance[:3, :3], atol=1e-10)


def test_gravity_of_the_wrong_sign_fails_loudly(walk):
    """A sensor that reads -g at rest: the odometry is refused, and the status says so."""
    recording, run = walk

    def upside_down(index, measurement):
        pose = run.true_pose(measurement.window.previous.stamp_ns)
        delta = measurement.inertial_delta
        lift = 2.0 * 9.81 * pose[:3, :3].T @ np.array([0.0, 0.0, 1.0])
        wrong = replace(
            delta,
            delta_v=delta.delta_v - lift * delta.duration_s,
            delta_p=delta.delta_p - 0.5 * lift * delta.duration_s**2,
            reintegrate=None,
        )
        return replace(measurement, inertial_delta=wrong)

    out = play(EkfFuser(visual=VisualOptions(recover_after_s=100.0)), recording, run, change=upside_down)
    assert_honest(out.states)
    assert out.counters["gated VO updates"] > 50
    assert out.states[-1].status == "lost"
    assert out.position_errors()[-1] > 10.0


def test_starts_from_rest():
    recording = simulated("walk", 6.0, standstill_s=2.0)
    run = record(recording, **VO)
    out = play(EkfFuser(), recording, run, from_truth=False)
    assert_honest(out.states)
    assert {state.status for state in out.states} == {"tracking"}
    # Rest is known after the first second; heading and position are the filter's own.
    assert len(out.states) >= len(run.measurements) - 21
    T_true_own = run.true_pose(out.states[0].stamp_ns) @ se3.inverse(out.states[0].T_world_body)
    error = T_true_own @ out.states[-1].T_world_body - run.true_pose(out.states[-1].stamp_ns)
    assert np.linalg.norm(error[:3, 3]) < 0.3


def test_without_odometry_it_coasts_and_says_lost(walk):
    recording, run = walk
    out = play(EkfFuser(), recording, run, change=lambda i, m: without_vo(m) if 60 <= i < 100 else m)
    assert_honest(out.states)
    # State i + 1 closes window i; a second may pass before "lost", and one used pose ends it.
    assert {s.status for s in out.states[: 60 + 20]} == {"tracking"}
    assert {s.status for s in out.states[83:101]} == {"lost"}
    assert {s.status for s in out.states[102:]} == {"tracking"}
    assert out.counters["missing VO updates"] == 40
    spread = [np.sqrt(np.trace(s.covariance[3:6, 3:6])) for s in out.states]
    assert spread[100] > 3.0 * spread[60]
    assert out.position_errors()[100] < 3.0 * spread[100]


def test_invalid_odometry_is_not_used(walk):
    recording, run = walk
    wild = RelativePose(T_prev_cur=se3.exp(np.full(6, 2.0)), valid=False)
    with_wild = play(EkfFuser(), recording, run, change=lambda i, m: replace(m, relative_pose=wild) if i == 50 else m)
    without = play(EkfFuser(), recording, run, change=lambda i, m: without_vo(m) if i == 50 else m)
    np.testing.assert_array_equal(with_wild.states[-1].T_world_body, without.states[-1].T_world_body)


def test_an_outlier_is_gated(walk):
    recording, run = walk
    clean = play(EkfFuser(), recording, run)

    def spoilt(index, measurement):
        if index % 25 != 13:
            return measurement
        pose = measurement.relative_pose
        return replace(measurement, relative_pose=replace(pose, T_prev_cur=pose.T_prev_cur @ se3.exp(np.full(6, 0.2))))

    out = play(EkfFuser(), recording, run, change=spoilt)
    assert out.counters["gated VO updates"] == sum(i % 25 == 13 for i in range(len(run.measurements)))
    assert out.position_errors()[-1] < clean.position_errors()[-1] + 0.1


@pytest.mark.parametrize("adapt_most", [1.0, 30.0], ids=["stated noise", "adapted noise"])
def test_recovers_from_a_wrong_velocity(walk, adapt_most):
    """Sure of a velocity that is 3 m/s off, it refuses everything at first, then follows again."""
    recording, run = walk
    start = run.true_state(run.measurements[60].window.previous.stamp_ns)
    start = replace(start, v_world_body=start.v_world_body + 3.0)
    rest = replace(run, measurements=run.measurements[60:])
    out = play(EkfFuser(inertial=InertialOptions(adapt_most=adapt_most)), recording, rest, initial=start)
    assert_honest(out.states)
    assert out.counters["gated VO updates"] >= 3
    assert out.counters["recoveries"] >= 1
    assert out.states[-1].status == "tracking"
    error = out.states[-1].v_world_body - run.true_state(out.states[-1].stamp_ns).v_world_body
    assert np.linalg.norm(error) < 0.2


def test_a_hole_in_the_samples_widens_the_covariance():
    spread = {}
    for name, gaps in (("whole", ()), ("hole", ((3.0, 0.3),))):
        recording = simulated("walk", 5.0, imu=ImuSettings(gaps_s=gaps))
        run = record(recording, **VO)
        out = play(EkfFuser(), recording, run)
        assert_honest(out.states)
        spread[name] = np.sqrt(np.trace(out.states[int(20 * 3.3)].covariance[6:9, 6:9]))
        if gaps:
            assert out.counters["inertial gaps"] >= 1
            assert out.position_errors()[-1] < 0.5
    assert spread["hole"] > 1.5 * spread["whole"]


def test_a_missing_window_is_crossed(walk):
    recording, run = walk
    fewer = replace(run, measurements=run.measurements[:50] + run.measurements[54:])
    out = play(EkfFuser(), recording, fewer)
    assert_honest(out.states)
    assert out.counters["missing windows"] == 1
    assert out.position_errors()[-1] < 1.0


def test_standstill_holds_position_without_odometry():
    recording = simulated("standing", 8.0, standstill_s=8.0)
    run = record(recording, **VO)
    ends = {}
    for enabled in (True, False):
        fuser = EkfFuser(standstill=StandstillOptions(enabled=enabled))
        out = play(fuser, recording, run, from_truth=False, change=lambda i, m: without_vo(m))
        ends[enabled] = np.linalg.norm(out.states[-1].T_world_body[:3, 3] - out.states[0].T_world_body[:3, 3])
        if enabled:
            assert {state.status for state in out.states} == {"tracking"}
    assert ends[True] < 0.02
    assert ends[True] < ends[False]


def test_covariance_stands_in_where_the_odometry_states_none(walk):
    recording, run = walk
    out = play(
        EkfFuser(visual=VisualOptions(rotation_sigma=0.001, translation_sigma=0.005, translation_ratio=0.0)),
        recording,
        run,
        change=lambda i, m: replace(m, relative_pose=replace(m.relative_pose, covariance=None)),
    )
    assert_honest(out.states)
    assert out.position_errors()[-1] < 0.3


def test_the_bias_is_found():
    recording = simulated("walk", 8.0)
    run = record(recording, rotation_noise=2e-4, translation_noise=2e-3)
    out = play(EkfFuser(), recording, run)
    samples = list(recording.samples())
    true_gyro = samples[-1].gyro_bias[-1]
    assert np.linalg.norm(true_gyro) > 3e-3
    np.testing.assert_allclose(out.states[-1].bias.gyro, true_gyro, atol=1e-3)


def test_an_update_costs_little(walk):
    recording, run = walk
    fuser = EkfFuser()
    fuser.setup(recording.rig)
    fuser.start_from(run.true_state(run.measurements[0].window.previous.stamp_ns))
    started = time.process_time()
    for measurement in run.measurements:
        fuser.update(measurement)
    # 0.8 ms here; the bound leaves room for a slow and busy machine.
    assert (time.process_time() - started) / len(run.measurements) < 0.005


def test_says_what_it_needs():
    fuser = EkfFuser()
    with pytest.raises(StateError, match="setup"):
        fuser.update(None)
    with pytest.raises(ConfigError, match="no camera"):
        fuser.setup(SensorRig(cameras=(), imu=NOISE))


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: VisualOptions(covariance_scale=0.0), "covariance_scale"),
        (lambda: VisualOptions(gate_probability=1.5), "gate_probability"),
        (lambda: VisualOptions(translation_sigma=0.0, translation_ratio=0.0), "translation_sigma"),
        (lambda: VisualOptions(lost_after_s=-1.0), "lost_after_s"),
        (lambda: InertialOptions(gyro_noise_scale=0.0), "gyro_noise_scale"),
        (lambda: InertialOptions(walk_scale=-1.0), "walk_scale"),
        (lambda: StandstillOptions(velocity_sigma=0.0), "velocity_sigma"),
        (lambda: StartOptions(velocity_sigma=0.0), "velocity_sigma"),
    ],
)
def test_refuses_options_that_cannot_be(make, named):
    with pytest.raises(ConfigError, match=named):
        make()


def test_other_integrators_serve_too(walk):
    """An increment assumed at another bias is moved to the filter's."""
    recording, run = walk
    integrator = Preintegration()
    integrator.setup(recording.rig)
    wrong = ImuBias(gyro=np.full(3, 0.004), accel=np.full(3, 0.04))

    def at_wrong_bias(index, measurement):
        imu = measurement.window.imu
        block = ImuBlock(stamps_ns=imu.stamps_ns, gyro=imu.gyro, accel=imu.accel)
        return replace(measurement, inertial_delta=integrator.integrate(block, wrong))

    same = play(EkfFuser(), recording, run)
    moved = play(EkfFuser(), recording, run, change=at_wrong_bias)
    assert np.linalg.norm(same.states[-1].T_world_body - moved.states[-1].T_world_body) < 1e-3
