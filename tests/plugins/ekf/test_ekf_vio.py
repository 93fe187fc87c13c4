"""EKF-VIO in a stream and in training: the same numbers, honest covariances, sensors that fail, and what it learns."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs torch: pip install 'vioframe[learn]'")

import torch

from filter_runs import FilterRun, play, record, simulated, without_vo
from vioframe.errors import ConfigError, DataError
from vioframe.fusion_options import StandstillOptions, StartOptions, VisualOptions
from vioframe.geometry import se3
from vioframe.learning.weights import save_weights
from vioframe.types import ImuBlock, Measurement, RelativePose
from vioframe_ekf import EkfFuser, EkfVioFuser, ImuTrust, LearningOptions
from window_runs import batch_of, upstream_of, window_of

MOVING = StandstillOptions(enabled=False)


@pytest.fixture(scope="module")
def recording():
    return simulated("walk", 5.0)


@pytest.fixture(scope="module")
def run(recording) -> FilterRun:
    return record(recording)


def trust_of(rig, **options) -> ImuTrust:
    noise = rig.imu
    return ImuTrust(
        gyro_noise=noise.gyro_noise,
        gyro_walk=noise.gyro_walk,
        accel_noise=noise.accel_noise,
        accel_walk=noise.accel_walk,
        **options,
    )


def fuser_for(rig, **options) -> EkfVioFuser:
    learning = options.pop("learning", None) or LearningOptions(window=1)
    return EkfVioFuser(inertial=trust_of(rig), standstill=MOVING, learning=learning, **options)


def without_imu(measurement: Measurement) -> Measurement:
    """A window for which the synchronizer had no sample."""
    window = replace(measurement.window, imu=ImuBlock.none(), gap_ns=0)
    return replace(measurement, window=window, inertial_delta=None)


def motions_of(run: FilterRun, rig) -> np.ndarray:
    T_world_cam = np.array([state.T_world_body for state in run.states]) @ rig.cameras[0].T_body_cam
    return se3.inverse(T_world_cam[:-1]) @ T_world_cam[1:]


def spoil(index: int, measurement: Measurement) -> Measurement:
    """No motion for a while, no sample for a while, a motion without covariance, and one that is far off."""
    pose = measurement.relative_pose
    if 20 <= index < 30:
        return replace(measurement, relative_pose=RelativePose.invalid())
    if 40 <= index < 46:
        return without_imu(measurement)
    if index == 55:
        return replace(measurement, relative_pose=replace(pose, covariance=None))
    if index == 60:
        off = pose.T_prev_cur @ se3.exp(np.array([0.5, 0.0, 0.0, 1.0, 0.0, 0.0]))
        return replace(measurement, relative_pose=replace(pose, T_prev_cur=off))
    return measurement


def test_it_agrees_with_the_filter_of_the_core(recording, run):
    """Another error and other coordinates, the same estimate and the same covariance where errors are small."""
    start = StartOptions()
    ours = play(fuser_for(recording.rig, start=start), recording, run)
    theirs = play(EkfFuser(standstill=MOVING, start=start), recording, run)
    assert len(ours.states) == len(theirs.states)
    for one, other in zip(ours.states[5:], theirs.states[5:], strict=True):
        sigma, wanted = np.sqrt(np.diag(one.covariance)), np.sqrt(np.diag(other.covariance))
        np.testing.assert_allclose(sigma, wanted, rtol=0.05)
        away = se3.log(se3.inverse(other.T_world_body) @ one.T_world_body)
        assert (np.abs(away) < 0.3 * wanted[:6]).all()


def test_a_stream_is_a_batch(recording, run):
    learned = fuser_for(recording.rig)
    with torch.no_grad():
        learned.net.visual.copy_(torch.linspace(-0.02, 0.02, 6))
    streamed = play(learned, recording, run, change=spoil)
    assert streamed.counters["gated VO updates"] >= 1
    window = window_of([spoil(k, each) for k, each in enumerate(run.measurements)], run.truth, recording.rig)
    batch = batch_of([window, window])
    learned.net.eval()
    with torch.no_grad():
        outputs = learned.forward_batch(batch, upstream_of(batch))
    assert outputs["T_prev_cur"].dtype == torch.float32
    for motions in outputs["T_prev_cur"].double().numpy():
        np.testing.assert_allclose(motions, motions_of(streamed, recording.rig), atol=2e-5)


def test_only_what_remembers_a_window_is_answered(recording, run):
    batch = batch_of([window_of(run.measurements[:20], run.truth, recording.rig)])
    fuser = fuser_for(recording.rig, learning=LearningOptions(window=8))
    assert fuser.context_pairs == 8
    assert fuser.forward_batch(batch, upstream_of(batch))["T_prev_cur"].shape == (1, 13, 4, 4)
    # A VO that stacks ten flows answers for the last eleven pairs of twenty.
    late = {name: value[:, -11:] for name, value in upstream_of(batch).items()}
    outputs = fuser.forward_batch(batch, late)
    assert outputs["T_prev_cur"].shape == (1, 11, 4, 4) and outputs["filter_truth"].shape == (1, 12, 4, 4)
    assert fuser.loss(outputs, batch)["loss"].isfinite()


def test_its_covariance_is_that_of_its_errors():
    """NEES of the pose over 20 seeded runs, each begun at a draw from the start's covariance."""
    windows = []
    for seed in range(20):
        recording = simulated("walk", 3.0, seed=seed)
        run = record(recording, seed=seed)
        windows.append(window_of(run.measurements, run.truth, recording.rig))
    fuser = fuser_for(recording.rig)
    torch.manual_seed(1)
    fuser.net.train()
    batch = batch_of(windows)
    with torch.no_grad():
        losses = fuser.loss(fuser.forward_batch(batch, upstream_of(batch)), batch)
    assert 0.7 < float(losses["anees"]) < 1.4


def test_it_learns_how_far_the_odometry_may_be_believed():
    """Rotations three times worse than stated: the factor is found, and errors become what they could be."""
    windows = []
    for seed in range(8):
        recording = simulated("walk", 4.0, seed=seed)
        run = record(recording, seed=seed, rotation_noise=0.006, translation_noise=0.01)
        stated = np.repeat([1.0 / 9.0, 1.0], 3)
        told = [
            replace(m, relative_pose=replace(m.relative_pose, covariance=stated * m.relative_pose.covariance))
            for m in run.measurements
        ]
        windows += [window_of(told[k : k + 20], run.truth, recording.rig) for k in (0, 20, 40)]
    fuser = fuser_for(recording.rig, learning=LearningOptions(window=1, slope=0.3, relative=0.0, absolute=0.0))
    batch = batch_of(windows)
    optimiser = torch.optim.Adam(fuser.net.parameters(), lr=0.15)
    torch.manual_seed(0)
    fuser.net.train()
    for _ in range(20):
        optimiser.zero_grad()
        losses = fuser.loss(fuser.forward_batch(batch, upstream_of(batch)), batch)
        losses["loss"].backward()
        optimiser.step()
    factors = fuser.net.visual_factors().detach()
    assert 2.0 < float(factors[:3].log().mean().exp()) < 4.5
    assert 0.6 < float(factors[3:].log().mean().exp()) < 1.6


def test_gradients_reach_an_odometer_through_the_filter(recording, run):
    """What ``system=ekf_vio`` trains: motions and their log-variances that depend on a net."""
    batch = batch_of([window_of(run.measurements[k : k + 8], run.truth, recording.rig) for k in (0, 20)])
    motions = batch.T_prev_cur.clone().requires_grad_()
    log_variances = torch.full((2, 8, 6), -9.0, requires_grad=True)
    fuser = fuser_for(recording.rig)
    outputs = fuser.forward_batch(batch, {"T_prev_cur": motions, "log_variances": log_variances})
    fuser.loss(outputs, batch)["loss"].backward()
    assert motions.grad.isfinite().all() and log_variances.grad.isfinite().all()
    assert (log_variances.grad.abs().amax((0, 2)) > 0.0).all() and (motions.grad.abs().amax((0, 2, 3)) > 0.0).all()


def test_answers_that_are_none_do_no_harm_in_training(recording, run):
    batch = batch_of([window_of(run.measurements[:12], run.truth, recording.rig)])
    upstream = {name: value.clone() for name, value in upstream_of(batch).items()}
    upstream["T_prev_cur"][0, 3] = float("nan")
    upstream["covariance"][0, 5] = float("nan")
    upstream["valid"][0, 7] = False
    fuser = fuser_for(recording.rig)
    losses = fuser.loss(fuser.forward_batch(batch, upstream), batch)
    losses["loss"].backward()
    assert losses["loss"].isfinite() and fuser.net.visual.grad.isfinite().all()


@pytest.mark.parametrize("lost", ["camera", "imu"])
@pytest.mark.parametrize("first", [0, 30])
def test_it_goes_on_without_a_sensor(recording, run, lost, first):
    """Two seconds without one of them: bounded error, a covariance that grows and comes back, and a status."""
    silent = range(first, first + 40)
    change = {"camera": without_vo, "imu": without_imu}[lost]
    out = play(fuser_for(recording.rig), recording, run, change=lambda k, each: change(each) if k in silent else each)
    offset = 1
    spread = np.array([np.sqrt(np.trace(state.covariance[6:9, 6:9])) for state in out.states])
    during = spread[offset + silent.stop - 2]
    before = spread[offset + first - 1] if first else spread[0]
    assert during > (2.0 if lost == "camera" else 1.2) * before
    assert spread[-1] < 0.5 * during
    assert out.position_errors().max() < (2.0 if lost == "camera" else 1.0)
    status = [state.status for state in out.states]
    assert status[-1] == "tracking"
    if lost == "camera":
        assert status[offset + silent.stop - 2] == "lost"
        assert out.counters["missing VO updates"] == 40


def test_it_starts_at_rest_by_itself():
    recording = simulated("walk", 4.0)
    run = record(recording)
    out = play(EkfVioFuser(inertial=trust_of(recording.rig)), recording, run, from_truth=False)
    assert out.states and out.states[0].T_world_body[2, 2] <= 1.0


def test_a_covariance_that_is_none_is_refused_and_counted(recording, run):
    def impossible(index, measurement):
        pose = replace(measurement.relative_pose, covariance=-np.eye(6)) if index == 10 else measurement.relative_pose
        return replace(measurement, relative_pose=pose)

    out = play(fuser_for(recording.rig), recording, run, change=impossible)
    assert out.counters["VO covariances that are none"] == 1
    assert all(np.isfinite(state.T_world_body).all() for state in out.states)


def test_a_large_bias_is_brought_in_by_integrating_again(recording, run):
    """What the integrator subtracts follows the estimate in steps, so that its first order holds."""
    fuser = fuser_for(recording.rig)
    shift = np.array([0.05, -0.04, 0.06])

    def biased(index, measurement):
        window = measurement.window
        imu = replace(window.imu, gyro=window.imu.gyro + shift)
        delta = measurement.inertial_delta.reintegrate.func.__self__.integrate(imu, fuser.bias())
        return replace(measurement, window=replace(window, imu=imu), inertial_delta=delta)

    start = StartOptions(gyro_bias_sigma=0.1)
    fuser = fuser_for(recording.rig, start=start)
    out = play(fuser, recording, run, change=biased)
    assert np.linalg.norm(fuser.bias().gyro - out.states[-1].bias.gyro) < 0.011
    np.testing.assert_allclose(out.states[-1].bias.gyro - shift, 0.0, atol=0.03)


def test_weights_come_back_and_others_are_refused(recording, run, tmp_path):
    fuser = fuser_for(recording.rig)
    with torch.no_grad():
        fuser.net.visual.fill_(0.04)
    path = tmp_path / "fuser.safetensors"
    save_weights(path, fuser, {})
    again = fuser_for(recording.rig, weights=str(path))
    assert not again.needs_training and fuser.needs_training
    assert torch.equal(again.net.visual, fuser.net.visual)
    other = EkfVioFuser(inertial=ImuTrust(gyro_noise=0.5), weights=str(path))
    with pytest.raises(DataError, match="gyro_noise"):
        other.setup(recording.rig)


@pytest.mark.parametrize(
    ("group", "options", "told"),
    [
        (LearningOptions, {"learns_from": "both"}, "answers or images"),
        (LearningOptions, {"window": 0}, "window"),
        (LearningOptions, {"relative": 0.0, "absolute": 0.0, "likelihood": 0.0}, "nothing to learn"),
        (LearningOptions, {"decades": -1.0}, "decades"),
        (ImuTrust, {"gyro_noise": 0.0}, "gyro_noise"),
        (ImuTrust, {"accel_walk": -1.0}, "accel_walk"),
    ],
)
def test_options_out_of_range_are_told(group, options, told):
    with pytest.raises(ConfigError, match=told):
        group(**options)


def test_without_a_vo_it_says_what_to_choose(recording, run):
    batch = batch_of([window_of(run.measurements[:4], run.truth, recording.rig)])
    with pytest.raises(ConfigError, match="vo=tsvo"):
        fuser_for(recording.rig, visual=VisualOptions()).forward_batch(batch, {})
