"""The filter with an unknown scale: Jacobians, the search, consistency, delay, drift and what can go wrong."""

import time
from dataclasses import replace

import numpy as np
import pytest

from filter_runs import assert_honest, benchmark, chi_square_interval, play, record, simulated, without_vo
from vioframe.error_state import Body, retract
from vioframe.errors import ConfigError
from vioframe.fusion_options import StartOptions
from vioframe.geometry import se3, so3
from vioframe.geometry.interpolation import interpolate_poses
from vioframe.initialisation import initial_covariance
from vioframe.testing import check_component
from vioframe.types import ImuBias, ImuNoise, NavState, RelativePose
from vioframe_msf import DriftOptions, ExtrinsicsOptions, MsfFuser, ScaleOptions
from vioframe_msf.search import ScaleSearch
from vioframe_msf.state import EXTRINSICS, SCALE, VISION, ScaledFilter

NOISE = ImuNoise(gyro_noise=2e-4, gyro_walk=2e-5, accel_noise=2e-3, accel_walk=3e-3, rate_hz=200.0)
VO = {"rotation_noise": 0.002, "translation_noise": 0.02}


@pytest.fixture(scope="module")
def walk():
    recording = simulated("walk", 8.0)
    return recording, record(recording, **VO, scale=2.5)


def made(seed: int = 5) -> ScaledFilter:
    """A filter with every block correlated with every other."""
    rng = np.random.default_rng(seed)
    T_body_cam = se3.exp(rng.normal(size=6))
    state = ScaledFilter(noise=NOISE, gravity=9.81, T_body_cam=T_body_cam, extrinsics_sigmas=(0.01, 0.02))
    body = Body(R=so3.exp(rng.normal(size=3)), p=rng.normal(size=3), v=rng.normal(size=3), bias=ImuBias())
    start = NavState(stamp_ns=0, T_world_body=body.T_world_body, v_world_body=body.v)
    state.start(start, initial_covariance(body.R))
    state.set_scale(1.7, 0.1)
    root = rng.normal(size=(28, 28)) * 1e-2
    state.covariance = root @ root.T
    return state


def moved(state: ScaledFilter, error: np.ndarray) -> ScaledFilter:
    """The filter whose estimate is the truth of another, off by this error."""
    truth = state.copy()
    truth.body = retract(state.body, error[:15])
    truth.scale = state.scale * float(np.exp(error[SCALE]))
    truth.T_body_cam = state.T_body_cam @ se3.exp(error[EXTRINSICS])
    if state.T_world_vision is not None:
        truth.T_world_vision = se3.exp(error[VISION]) @ state.T_world_vision
    return truth


def derivative(function, size: int = 28, step: float = 1e-5) -> np.ndarray:
    return np.stack([(function(step * e) - function(-step * e)) / (2.0 * step) for e in np.eye(size)], axis=1)


def test_keeps_the_contract():
    check_component(MsfFuser())


def test_measurement_jacobian_against_finite_differences():
    state = made()
    state.anchor_vision(np.zeros((6, 6)))
    H, residual = state.vision_measurement()
    np.testing.assert_allclose(residual, 0.0, atol=1e-12)

    def expected(error):
        truth = moved(state, error)
        return se3.log(se3.inverse(truth.T_world_vision) @ truth.T_world_cam)

    np.testing.assert_allclose(H, derivative(expected), atol=1e-6)


def test_anchor_is_a_clone_of_the_camera():
    """The covariance of the anchored vision is that of the camera, with the correlations of a copy."""
    state = made()
    before = state.covariance.copy()
    image = np.diag(np.arange(1.0, 7.0)) * 1e-4
    state.anchor_vision(image)

    def vision_error(error):
        truth = moved(state, error)
        return se3.log(truth.T_world_cam @ se3.inverse(state.T_world_cam))

    J = np.eye(28)
    J[VISION] = derivative(vision_error)
    J[VISION, VISION] = 0.0
    onto_world = se3.adjoint(state.T_world_cam)
    expected = J @ before @ J.T
    expected[VISION, VISION] += onto_world @ image @ onto_world.T
    np.testing.assert_allclose(state.covariance, expected, atol=1e-9)


def test_vision_step_against_finite_differences():
    state = made()
    state.anchor_vision(np.zeros((6, 6)))
    T_metric = se3.exp(np.array([0.1, -0.05, 0.02, 0.3, 0.1, -0.2]))
    T_unit = T_metric.copy()
    T_unit[:3, 3] /= state.scale
    state.leave()
    # The body moves as the vision says, so that the expected and the measured step agree.
    T_after = state.T_world_cam @ T_metric @ se3.inverse(state.T_body_cam)
    state.body = replace(state.body, R=T_after[:3, :3], p=T_after[:3, 3])
    before = state.copy()
    drift = np.diag(np.arange(1.0, 7.0)) * 1e-4
    state.advance_vision(T_unit, drift)

    def stepped(error):
        truth = moved(before, error)
        T = T_unit.copy()
        T[:3, 3] *= truth.scale
        return se3.log(truth.T_world_vision @ T @ se3.inverse(state.T_world_vision))

    F = np.eye(28)
    F[VISION] = derivative(stepped)
    onto_world = se3.adjoint(state.T_world_vision)
    expected = F @ before.covariance @ F.T
    expected[VISION, VISION] += onto_world @ drift @ onto_world.T
    np.testing.assert_allclose(state.covariance, expected, atol=1e-8)


def test_bank_covers_the_range_evenly():
    search = ScaleSearch(made(), 2.0, 10.0)
    scales = np.array(sorted(h.state.scale for h in search.hypotheses))
    assert scales[0] <= 0.2 and scales[-1] >= 20.0
    logs, grid = np.log(scales), np.linspace(np.log(0.25), np.log(16.0), 200)
    sigma = search.hypotheses[0].state.scale_sigma
    density = np.exp(-0.5 * ((grid[:, None] - logs) / sigma) ** 2).sum(axis=1)
    assert density.max() / density.min() < 1.05


def test_bank_drops_the_hopeless_and_merges_the_same():
    search = ScaleSearch(made(), 1.0, 3.0)
    for index, hypothesis in enumerate(search.hypotheses):
        hypothesis.log_weight = -100.0 if index > 1 else 0.0
        hypothesis.state.set_scale(1.0 + 0.01 * index, 0.05)
    search.reduce()
    assert len(search.hypotheses) == 1
    assert search.found(0.1, 0.99)
    assert not search.found(0.01, 0.99)


@pytest.mark.parametrize("scale", [0.25, 2.5, 60.0])
def test_finds_the_scale(scale):
    recording = simulated("walk", 8.0, seed=11)
    run = record(recording, **VO, scale=scale)
    fuser = MsfFuser()
    out = play(fuser, recording, run, from_truth=False)
    assert_honest(out.states)
    # From a rest the body is known before the unit is.
    assert {state.status for state in out.states} == {"tracking"}
    assert abs(np.log(fuser.scale / scale)) < 4.0 * fuser.scale_sigma
    assert fuser.scale_sigma < 0.05


def test_scale_waits_for_motion():
    """At rest nothing says what the unit is, but the body is known to rest."""
    recording = simulated("standing", 6.0, standstill_s=6.0)
    run = record(recording, **VO, scale=2.5)
    fuser = MsfFuser()
    out = play(fuser, recording, run, from_truth=False)
    assert {state.status for state in out.states} == {"tracking"}
    assert fuser.scale_sigma > 0.3
    assert np.linalg.norm(out.states[-1].T_world_body[:3, 3]) < 0.02


def test_nees_lies_inside_its_bounds():
    """The last states of independent runs: N·dof times the mean NEES is χ² with N·dof degrees of freedom."""
    runs = [benchmark("consistency").run_once("msf", seed, "walk", 6.0) for seed in range(14)]
    for block, degrees in {"orientation": 3, "position": 3, "velocity": 3, "all 15": 15}.items():
        low, high = chi_square_interval(degrees * len(runs))
        anees = np.mean([run.final[block] for run in runs])
        assert low < anees < high, (block, anees, low, high)


def test_a_turned_and_shifted_world_changes_nothing(walk):
    recording, run = walk
    straight_fuser, turned_fuser = MsfFuser(), MsfFuser()
    straight = play(straight_fuser, recording, run)
    T_other_world = se3.from_parts(so3.rotation_z(2.1), np.array([100.0, -50.0, 20.0]))
    start = run.true_state(run.measurements[0].window.previous.stamp_ns)
    turned_start = replace(
        start,
        T_world_body=T_other_world @ start.T_world_body,
        v_world_body=T_other_world[:3, :3] @ start.v_world_body,
    )
    turned = play(turned_fuser, recording, run, initial=turned_start)
    last = straight.states[-1], turned.states[-1]
    np.testing.assert_allclose(T_other_world @ last[0].T_world_body, last[1].T_world_body, atol=1e-6)
    assert straight_fuser.scale == pytest.approx(turned_fuser.scale, rel=1e-6)


def test_an_unknown_velocity_is_a_beginning(walk):
    """Moving, from a guess of the velocity: starting, until the scale is known."""
    recording, run = walk
    start = run.true_state(run.measurements[60].window.previous.stamp_ns)
    fuser = MsfFuser(start=StartOptions(velocity_sigma=1.0))
    out = play(fuser, recording, replace(run, measurements=run.measurements[60:]), initial=start)
    statuses = [state.status for state in out.states]
    known = statuses.index("tracking")
    assert known > 2
    assert "starting" not in statuses[known:]
    assert_honest(out.states)


def test_summary_of_one_hypothesis_is_itself():
    state = made()
    search = ScaleSearch(state, 1.0, 1.0)
    for hypothesis in search.hypotheses[1:]:
        hypothesis.log_weight = -1000.0
    body, covariance = search.summary()
    np.testing.assert_allclose(body.T_world_body, state.body.T_world_body, atol=1e-12)
    np.testing.assert_allclose(covariance, state.covariance[:15, :15], atol=1e-12)


def test_follows_a_drifting_unit():
    recording = simulated("walk", 14.0, seed=4)
    run = record(recording, rotation_noise=1e-3, translation_noise=5e-3, scale=2.5, scale_drift=0.03, seed=2)
    following, stubborn = MsfFuser(scale=ScaleOptions(walk=0.03)), MsfFuser(scale=ScaleOptions(walk=0.0))
    errors = {}
    for name, fuser in (("following", following), ("stubborn", stubborn)):
        errors[name] = play(fuser, recording, run).position_errors()[-1]
    steps = [
        np.linalg.norm((run.true_pose(m.window.current.stamp_ns) - run.true_pose(m.window.previous.stamp_ns))[:3, 3])
        / np.linalg.norm(m.relative_pose.T_prev_cur[:3, 3])
        for m in run.measurements[-10:]
    ]
    assert np.median(steps) / 2.5 != pytest.approx(1.0, abs=0.03)
    assert following.scale == pytest.approx(np.median(steps), rel=0.08)
    assert errors["following"] < errors["stubborn"]


def delayed(run, delay_ns: int):
    """The same odometry, but of the camera's motion ``delay_ns`` before each window."""
    measurements = []
    T_body_cam = delayed.T_body_cam
    for measurement in run.measurements:
        stamps = np.array([measurement.window.previous.stamp_ns, measurement.window.current.stamp_ns]) - delay_ns
        poses, covered = interpolate_poses(run.truth, stamps, max_gap_ns=50_000_000)
        cameras = poses @ T_body_cam
        rng = np.random.default_rng(int(stamps[1] % 2**32))
        sigma = np.repeat([4e-4, 2e-3], 3)
        T = se3.inverse(cameras[0]) @ cameras[1] @ se3.exp(sigma * rng.standard_normal(6))
        T[:3, 3] /= 2.5
        pose = RelativePose(
            T_prev_cur=T, covariance=np.diag((sigma / np.repeat([1.0, 2.5], 3)) ** 2), valid=bool(covered.all())
        )
        measurements.append(replace(measurement, relative_pose=pose))
    return replace(run, measurements=measurements)


@pytest.mark.parametrize("delay_s", [0.03, 0.12], ids=["within a window", "over windows"])
def test_a_known_delay_is_undone(delay_s):
    recording = simulated("drone", 8.0, standstill_s=1.0)
    delayed.T_body_cam = recording.rig.cameras[0].T_body_cam
    run = delayed(record(recording), round(delay_s * 1e9))
    aware, unaware = (play(MsfFuser(delay_s=delay), recording, run) for delay in (delay_s, 0.0))
    prompt = play(MsfFuser(), recording, delayed(run, 0))
    assert_honest(aware.states)
    assert [s.stamp_ns for s in aware.states] == [s.stamp_ns for s in prompt.states]
    assert aware.counters.get("gated VO updates", 0) == 0
    assert aware.position_errors()[-40:].mean() < prompt.position_errors()[-40:].mean() + 0.1
    assert aware.rotation_errors()[-40:].mean() < 0.5 * unaware.rotation_errors()[-40:].mean()


def test_a_filter_behind_predicts_with_the_wider_covariance():
    recording = simulated("walk", 6.0)
    run = record(recording, **VO, scale=2.5)
    late, prompt = (play(MsfFuser(delay_s=delay), recording, run) for delay in (0.1, 0.0))
    assert np.trace(late.states[-1].covariance[3:6, 3:6]) > np.trace(prompt.states[-1].covariance[3:6, 3:6])


def test_image_noise_is_told_from_drift():
    """An odometer located in a map: its steps' errors cancel, and the filter that knows makes more of them."""
    recording = simulated("walk", 10.0, seed=6)
    run = record(recording)
    rng = np.random.default_rng(0)
    T_body_cam = recording.rig.cameras[0].T_body_cam
    image, drift = np.repeat([5e-4, 5e-3], 3), np.repeat([1e-4, 1e-3], 3)
    noise = se3.exp(image * rng.standard_normal(6))
    measurements = []
    for measurement in run.measurements:
        poses = [
            run.true_pose(stamp) @ T_body_cam
            for stamp in (measurement.window.previous.stamp_ns, measurement.window.current.stamp_ns)
        ]
        after = se3.exp(image * rng.standard_normal(6))
        T = se3.inverse(poses[0] @ noise) @ poses[1] @ se3.exp(drift * rng.standard_normal(6)) @ after
        covariance = np.diag(2.0 * image**2 + drift**2)
        measurements.append(replace(measurement, relative_pose=RelativePose(T_prev_cur=T, covariance=covariance)))
        noise = after
    run = replace(run, measurements=measurements)
    share = float(drift[0] ** 2 / (2.0 * image[0] ** 2 + drift[0] ** 2))
    knowing = play(MsfFuser(drift=DriftOptions(share=share)), recording, run)
    white = play(MsfFuser(), recording, run)
    assert_honest(knowing.states)
    assert np.trace(knowing.states[-1].covariance[3:6, 3:6]) < 0.5 * np.trace(white.states[-1].covariance[3:6, 3:6])
    spread = np.sqrt(np.trace(knowing.states[-1].covariance[3:6, 3:6]))
    assert knowing.position_errors()[-1] < 4.0 * spread
    assert knowing.position_errors()[-40:].mean() < white.position_errors()[-40:].mean()


def test_extrinsics_are_refined_where_allowed():
    recording = simulated("drone", 14.0, standstill_s=1.0)
    run = record(recording, rotation_noise=2e-4, translation_noise=2e-3, scale=1.5)
    camera = recording.rig.cameras[0]
    tilt = se3.exp(np.array([0.02, -0.015, 0.01, 0.0, 0.0, 0.0]))
    wrong = replace(recording.rig, cameras=(replace(camera, T_body_cam=camera.T_body_cam @ tilt),))

    class Miscalibrated:
        rig = wrong

    refining = MsfFuser(extrinsics=ExtrinsicsOptions(rotation_sigma=0.02))
    out = play(refining, Miscalibrated(), run)
    assert_honest(out.states)
    error = so3.angle(refining.T_body_cam[:3, :3].T @ camera.T_body_cam[:3, :3])
    assert error < 0.25 * so3.angle(tilt[:3, :3])
    fixed = MsfFuser()
    play(fixed, Miscalibrated(), run)
    np.testing.assert_array_equal(fixed.T_body_cam, wrong.cameras[0].T_body_cam)


def test_interruption_keeps_the_unit_or_not(walk):
    recording, run = walk

    def interrupted(index, measurement):
        if 100 <= index < 104:
            return without_vo(measurement)
        if index < 104:
            return measurement
        pose = measurement.relative_pose
        T = pose.T_prev_cur.copy()
        T[:3, 3] *= 0.2
        scaling = np.repeat([1.0, 0.2], 3)
        covariance = pose.covariance * np.outer(scaling, scaling)
        return replace(measurement, relative_pose=replace(pose, T_prev_cur=T, covariance=covariance))

    fuser = MsfFuser(scale=ScaleOptions(kept_by_vo=False))
    out = play(fuser, recording, run, change=interrupted)
    assert_honest(out.states)
    assert fuser.scale == pytest.approx(12.5, rel=0.15)
    # Once known, a new search does not make the state a beginner's.
    first = next(i for i, s in enumerate(out.states) if s.status == "tracking")
    assert all(s.status != "starting" for s in out.states[first:])
    keeping = MsfFuser()
    play(keeping, recording, run, change=lambda i, m: without_vo(m) if 100 <= i < 104 else m)
    assert keeping.scale == pytest.approx(2.5, rel=0.1)


def test_an_outlier_is_gated(walk):
    recording, run = walk
    clean = play(MsfFuser(), recording, run)

    def spoilt(index, measurement):
        if index % 25 != 13 or index < 80:
            return measurement
        pose = measurement.relative_pose
        return replace(measurement, relative_pose=replace(pose, T_prev_cur=pose.T_prev_cur @ se3.exp(np.full(6, 0.2))))

    out = play(MsfFuser(), recording, run, change=spoilt)
    assert out.counters["gated VO updates"] == sum(i % 25 == 13 and i >= 80 for i in range(len(run.measurements)))
    assert out.position_errors()[-1] < clean.position_errors()[-1] + 0.1


def test_gravity_of_the_wrong_sign_fails_loudly(walk):
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

    out = play(MsfFuser(), recording, run, change=upside_down)
    assert_honest(out.states)
    assert out.position_errors()[-1] > 10.0
    assert out.counters.get("gated VO updates", 0) > 20 or out.states[-1].status == "starting"


def test_a_moving_start_with_known_velocity():
    """As on the road: no rest, but the velocity is given, and the first steps tell the scale."""
    recording = simulated("car", 6.0, standstill_s=0.0)
    run = record(recording, rotation_noise=1e-3, translation_noise=0.03, scale=20.0)
    fuser = MsfFuser(start=StartOptions(velocity_sigma=0.1))
    out = play(fuser, recording, run)
    assert_honest(out.states)
    assert {state.status for state in out.states} == {"tracking"}
    speed = np.linalg.norm(run.true_state(out.states[0].stamp_ns).v_world_body)
    assert out.position_errors()[-1] < 0.03 * 6.0 * max(speed, 5.0)


def test_an_update_costs_little(walk):
    recording, run = walk
    fuser = MsfFuser()
    fuser.setup(recording.rig)
    fuser.start_from(run.true_state(run.measurements[0].window.previous.stamp_ns))
    for measurement in run.measurements[:100]:
        fuser.update(measurement)
    started = time.process_time()
    for measurement in run.measurements[100:]:
        fuser.update(measurement)
    # 1 ms here; the bound leaves room for a slow and busy machine.
    assert (time.process_time() - started) / (len(run.measurements) - 100) < 0.006


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: ScaleOptions(guess=0.0), "guess"),
        (lambda: ScaleOptions(ratio=0.5), "ratio"),
        (lambda: ScaleOptions(known_probability=1.0), "known_probability"),
        (lambda: ScaleOptions(walk=-1.0), "walk"),
        (lambda: DriftOptions(share=0.0), "share"),
        (lambda: ExtrinsicsOptions(position_sigma=-1.0), "position_sigma"),
        (lambda: MsfFuser(delay_s=-0.1), "delay_s"),
    ],
)
def test_refuses_options_that_cannot_be(make, named):
    with pytest.raises(ConfigError, match=named):
        make()
