"""What both heads are made of, against oracles: sums of errors, gyros, integrals, the stack; and what is refused."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs torch: pip install 'vioframe[learn]'")
pytest.importorskip("safetensors", reason="needs safetensors: pip install 'vioframe[learn]'")

import torch

from answered_scenes import batch_of, stored, upstream_of
from filter_runs import play, record, simulated
from vioframe.data.simulator import ImuSettings
from vioframe.errors import ConfigError, DataError, StateError
from vioframe.geometry import se3, so3
from vioframe.learning.likelihood import accumulated_likelihood
from vioframe.learning.weights import save_weights
from vioframe_lstm import LstmFuser, PoseOptions, ResidualOptions
from vioframe_lstm.net.gyros import GyroRecord
from vioframe_lstm.options import Unstated
from vioframe_lstm.pairs import attitudes, doubles, pairs_of_batch
from vioframe_lstm.stack import sample_paths, window_stack
from vioframe_lstm.truth import gyro_errors, true_motions

UNSTATED = Unstated(rotation_sigma=0.002, translation_sigma=0.005, translation_ratio=0.02, longest_gap_s=0.05)


@pytest.fixture(scope="module")
def drive():
    exact = ImuSettings(
        gyro_noise=0.0, gyro_walk=0.0, accel_noise=0.0, accel_walk=0.0, gyro_bias_spread=0.0, accel_bias_spread=0.0
    )
    recording = simulated("walk", 6.0, seed=9, imu=exact)
    run = record(recording, rotation_noise=1e-6, translation_noise=1e-6)
    return recording, run, stored(recording, run)


def best_variance(errors, horizon):
    """The variance at which the likelihood of the sums is highest, by a search over a grid."""
    errors = torch.from_numpy(errors)
    R = torch.from_numpy(attitudes(so3.exp(0.1 * np.ones((*errors.shape[:2], 3)))))
    grid = np.geomspace(0.1, 30.0, 40)
    counted = torch.ones(errors.shape[:2], dtype=torch.bool)
    found = [accumulated_likelihood(errors, torch.full_like(errors, v), R, counted, [horizon]) for v in grid]
    return grid[int(np.argmin(found))]


def test_variances_are_those_of_white_noise_that_adds_up_as_far():
    rng = np.random.default_rng(0)
    white = rng.standard_normal((40, 256, 3))
    assert best_variance(white, 64) == pytest.approx(1.0, rel=0.2)
    lasting = np.zeros_like(white)
    for k in range(1, 256):
        lasting[:, k] = 0.8 * lasting[:, k - 1] + 0.6 * white[:, k]
    # A sum of n of them has n (1 + ρ)/(1 − ρ) times the variance of one: 9 here, a little less where n is small.
    R_back = np.swapaxes(attitudes(so3.exp(0.1 * np.ones((40, 256, 3)))), -1, -2)
    in_body = (R_back @ lasting[..., None])[..., 0]
    assert best_variance(in_body, 1) == pytest.approx(1.0, rel=0.2)
    assert best_variance(in_body, 128) == pytest.approx(9.0, rel=0.25)


def test_gyros_are_known_by_recording():
    rng = np.random.default_rng(1)
    record_ = GyroRecord()
    biases = rng.normal(0.01, 0.002, (6, 3))
    for _ in range(30):
        numbers = rng.integers(0, 6, 16)
        errors = biases[numbers] + rng.normal(0.0, 0.001, (16, 3)) / np.sqrt(10.0)
        errors[0] += 0.5  # a hole that nobody noticed
        record_.learn(torch.from_numpy(errors), torch.full((16,), 10.0), torch.from_numpy(numbers))
    mean, spread, noise = record_.summary()
    np.testing.assert_allclose(mean, biases.mean(0), atol=1e-4)
    np.testing.assert_allclose(spread, biases.std(0, ddof=1) * np.sqrt(7 / 6), rtol=0.1)
    np.testing.assert_allclose(noise, 0.001, rtol=0.25)
    assert GyroRecord().summary() is None


def test_pairs_of_exact_sensors_agree(drive):
    _, _, sequence = drive
    batch = batch_of(sequence, 40, 60)
    pairs = pairs_of_batch(batch, upstream_of(batch), UNSTATED)
    R, t = true_motions(doubles(batch.T_prev_cur), doubles(batch.rig.T_body_cam))
    assert pairs.visual.all() and pairs.inertial.all()
    np.testing.assert_allclose(so3.log(np.swapaxes(R, -1, -2) @ pairs.R_gyro), 0.0, atol=1e-3)
    np.testing.assert_allclose(pairs.t_body, t, atol=1e-3)
    np.testing.assert_allclose(pairs.disagreement, 0.0, atol=1e-3)
    errors, _, which = gyro_errors(pairs, doubles(batch.T_prev_cur))
    assert np.abs(errors).max() < 1e-3 and which.tolist() == [0]


@pytest.mark.parametrize("every", [1, 3])
def test_the_stack_is_the_path_whatever_the_rate(drive, every):
    _, run, sequence = drive
    batch = batch_of(sequence, 30, 60)
    keep = np.r_[0 : batch.imu.shape[2] - 1 : every, batch.imu.shape[2] - 1]
    assert batch.imu_mask.all()
    imu, times = doubles(batch.imu)[:, :, keep], doubles(batch.imu_time_s)[:, :, keep]
    pairs = pairs_of_batch(batch, upstream_of(batch), UNSTATED)
    paths = sample_paths(imu, times, np.ones(times.shape, dtype=bool), pairs.duration_s, 5)
    R, p = window_stack(pairs, paths, np.ones((1, 30), dtype=bool))
    stamps = sequence.stamps_ns[60:91]
    T = np.stack([run.true_pose(stamp) for stamp in stamps])
    T = se3.inverse(T[0]) @ T[1:]
    for place in (0, -1):  # the VO's, and the inertial one at the image
        np.testing.assert_allclose(p[0, :, place], T[:, :3, 3], atol=0.02)
        np.testing.assert_allclose(R[0, :, place], T[:, :3, :3], atol=0.01)
    # The poses of a pair lead evenly from one image to the next.
    steps = np.linalg.norm(np.diff(np.concatenate([p[0, :-1, -1:], p[0, 1:, 1:]], axis=1), axis=1), axis=-1)
    np.testing.assert_allclose(steps, steps.mean(axis=1, keepdims=True).repeat(5, axis=1), atol=0.01)


def small(**options):
    plain = {"frames": 6, "residual": ResidualOptions(channels=4), "pose": PoseOptions(width=0.05, kernel=3)}
    return LstmFuser(**{**plain, "device": "cpu", **options})


@pytest.mark.parametrize(
    ("head", "change", "told"),
    [
        ("residual", {"frames": 7}, "frames=6 where 7"),
        ("pose", {"poses": 5}, "poses=10 where 5"),
        ("pose", {"frames": 9}, "frames=6 where 9"),
    ],
)
def test_weights_of_another_window_are_refused(head, change, told, tmp_path):
    path = tmp_path / "w.safetensors"
    save_weights(path, small(head=head), {})
    with pytest.raises(DataError, match=told):
        _ = small(head=head, weights=str(path), **change).net
    twin = small(head=head, weights=str(path))
    assert not twin.needs_training
    assert twin.net.state_dict().keys() == small(head=head).net.state_dict().keys()


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"head": "both"}, "fuser.head must be residual or pose"),
        ({"frames": 1}, "fuser.frames must be 2 or more"),
        ({"head": "pose", "frames": 2}, "leaves nothing of a window"),
    ],
)
def test_options_that_cannot_work(options, told):
    with pytest.raises(ConfigError, match=told):
        small(**options)


def test_more_options_that_cannot_work():
    with pytest.raises(ConfigError, match=r"fuser\.residual\.horizons"):
        ResidualOptions(horizons=[0])
    with pytest.raises(ConfigError, match=r"fuser\.pose\.kernel must be odd"):
        PoseOptions(kernel=4)
    with pytest.raises(ConfigError, match=r"fuser\.pose\.activation"):
        PoseOptions(activation="elu")


def test_update_before_setup(drive):
    _, run, _ = drive
    for head in ("residual", "pose"):
        with pytest.raises(StateError):
            small(head=head).update(run.measurements[0])


def test_images_at_another_rate_are_told_once(drive, caplog):
    recording, run, _ = drive
    part = small()
    part.net.interval_s.fill_(0.2)
    play(part, recording, replace(run, measurements=run.measurements[:5]))
    assert sum("has learned from one every 0.2 s" in line.getMessage() for line in caplog.records) == 1
