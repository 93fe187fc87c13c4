"""The nets of VINet: samples at one rate, composition with gradient, covariances, and that it learns."""

import dataclasses

import cv2
import numpy as np
import pytest

pytest.importorskip("torch", reason="needs torch: pip install 'vioframe[learn]'")
pytest.importorskip("safetensors", reason="needs safetensors: pip install 'vioframe[learn]'")

import torch

from learned_scenes import stored
from vioframe.data.windows import cut_window
from vioframe.learning.batch import collate
from vioframe.learning.motion import exp_so3, motion_from_vector
from vioframe.testing import make_scene
from vioframe_vinet import PairEncoder, VinetFuser
from vioframe_vinet.net.core import CoreAnswer
from vioframe_vinet.net.gyro import GyroCheck, Sight
from vioframe_vinet.net.inertial import Resampled, resample, turn_by_gyro
from vioframe_vinet.net.loss import PoseErrors, motion_errors, sight_loss
from vioframe_vinet.net.seeing import stretches

UNITS = torch.tensor([0.005] * 3 + [1.0] * 3, dtype=torch.float64)


def some_motions(batch=3, pairs=5, seed=0):
    torch.manual_seed(seed)
    vectors = torch.randn(batch, pairs, 6, dtype=torch.float64) * torch.tensor([0.05] * 3 + [0.8] * 3)
    return vectors, motion_from_vector(vectors)


@pytest.mark.parametrize("count", [2, 5, 11, 12, 37])
def test_resampling_keeps_every_integral(count):
    """Of samples that are linear in between, against the trapezoid rule on a grid a thousand times as fine."""
    rng = np.random.default_rng(count)
    times = np.sort(np.concatenate([[0.0, 0.1], rng.uniform(0.0, 0.1, count - 2)]))
    values = rng.standard_normal((count, 6))
    fine = np.linspace(0.0, 0.1, 10_001)
    dense = np.stack([np.interp(fine, times, values[:, axis]) for axis in range(6)], axis=1)
    expected = [np.trapezoid(dense[k : k + 1001], fine[k : k + 1001], axis=0) / 0.01 for k in range(0, 10_000, 1000)]
    padded = torch.zeros(1, count + 3, 6, dtype=torch.float64)
    padded[0, :count] = torch.from_numpy(values)
    time_s = torch.zeros(1, count + 3, dtype=torch.float64)
    time_s[0, :count] = torch.from_numpy(times)
    mask = torch.arange(count + 3)[None] < count
    found = resample(padded, time_s, mask, 10)
    np.testing.assert_allclose(found.means[0], expected, atol=2e-4)
    assert found.duration_s.item() == pytest.approx(0.1) and found.heard.item()


def test_pairs_without_samples_are_told_and_finite():
    imu = torch.randn(3, 4, 6)
    time_s = torch.tensor([0.0, 0.03, 0.07, 0.1]).expand(3, 4)
    mask = torch.tensor([[True] * 4, [True, False, False, False], [False] * 4])
    found = resample(imu, time_s, mask, 5)
    assert found.heard.tolist() == [True, False, False]
    assert not found.means[1:].any() and found.means.isfinite().all()
    torch.testing.assert_close(turn_by_gyro(found)[1:], torch.eye(3).expand(2, 3, 3))
    empty = resample(torch.zeros(2, 0, 6), torch.zeros(2, 0), torch.zeros(2, 0, dtype=torch.bool), 5)
    assert not empty.heard.any() and empty.means.shape == (2, 5, 6)


def test_gyro_turns_by_its_integral():
    rate = torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64)
    means = torch.zeros(1, 10, 6, dtype=torch.float64)
    means[..., :3] = rate
    samples = Resampled(means, torch.tensor([0.2], dtype=torch.float64), torch.tensor([True]))
    torch.testing.assert_close(turn_by_gyro(samples)[0], exp_so3(0.2 * rate))


def test_bias_of_the_gyro_is_what_least_squares_make_of_it():
    """Without forgetting it is the Gaussian conditional of the bias, of images that are off alike each time too."""
    torch.manual_seed(0)
    check = GyroCheck(embedding=4, bias_sigma=0.05, memory=10**9)
    with torch.no_grad():
        check.lasting.copy_(torch.tensor([0.0, 0.01, 0.03]))
    noise = torch.rand(1, 6, 3) * 1e-4
    said = 0.01 * torch.randn(1, 6, 3)
    turns = torch.eye(3).expand(1, 6, 3, 3)
    checked = torch.tensor([[True, True, False, True, True, True]])
    usual = torch.full((1, 6), 0.1)
    found, _ = check(turns, Sight(said, noise.log()), checked, usual, check.begin(said, 1))
    for axis in range(3):
        heard = checked[0]
        bias, lasting = (0.05 * 0.1) ** 2, check.lasting_variance[axis].item()
        alike = check.pairs_alike[axis].item()
        covariance = torch.full((5, 5), bias + lasting) + torch.diag(alike * noise[0, heard, axis])
        gain = torch.linalg.solve(covariance, torch.full((5,), bias))
        assert found.correction[0, -1, axis].item() == pytest.approx((gain @ said[0, heard, axis]).item(), rel=1e-3)
        left = (bias - gain.sum() * bias).item() / 0.1**2
        assert found.variance[0, -1, axis].item() == pytest.approx(left, rel=1e-3)
    # Nothing was said: all that was known is left.
    assert found.kept[0, 2].tolist() == pytest.approx([1.0] * 3)
    assert found.kept[0, [0, 1, 3]].max() < 1.0
    # A pair that lasts twice as long turns by twice the bias.
    longer, _ = check(turns, Sight(said, noise.log()), checked, 2.0 * usual, check.begin(said, 1))
    assert longer.correction.isfinite().all()


def test_what_images_show_of_rotation_is_taught_where_there_are_images():
    _, truth = some_motions()
    sight = Sight(torch.zeros(3, 5, 3, dtype=torch.float64, requires_grad=True), torch.zeros(3, 5, 3))
    visible = torch.ones(3, 5, dtype=torch.bool)
    visible[:, 2] = False
    gradient = torch.autograd.grad(sight_loss(sight, visible, truth), sight.vector)[0]
    assert not gradient[:, 2].any() and gradient[:, 3].any()
    assert sight_loss(sight, torch.zeros_like(visible), truth).item() == 0.0


def test_gradients_pass_through_the_composition_of_poses():
    """Analytic against central differences, to 1e-4, of a loss in which all that counts is the composed poses."""
    vectors, _ = some_motions()
    _, truth = some_motions(seed=1)
    loss = PoseErrors(log_variance_rotation=-4.0, log_variance_translation=0.0, window=5, pose_weight=1e3).double()
    durations = torch.full((3, 5), 0.1, dtype=torch.float64)

    def cost(numbers):
        return loss(CoreAnswer(motion_from_vector(numbers), numbers, None), truth, durations)["loss"]

    vectors.requires_grad_(True)
    gradient = torch.autograd.grad(cost(vectors), vectors)[0]
    rng = np.random.default_rng(0)
    for _ in range(8):
        direction = torch.from_numpy(rng.standard_normal(vectors.shape))
        step = 1e-5 * direction
        numerical = (cost(vectors + step) - cost(vectors - step)).item() / 2e-5
        assert (gradient * direction).sum().item() == pytest.approx(numerical, rel=1e-4)
    # The first motion is taught by the last pose.
    assert gradient[:, 0].abs().max() > 0


def test_truth_costs_nothing():
    vectors, truth = some_motions()
    assert motion_errors(truth, truth).abs().max() < 1e-12
    errors = PoseErrors(log_variance_rotation=0.0, log_variance_translation=0.0, window=1, pose_weight=1.0)
    assert errors(CoreAnswer(truth, vectors, None), truth, torch.full((3, 5), 0.1))["loss"].item() == pytest.approx(
        0.0, abs=1e-12
    )


def test_stretches_are_one_run_in_their_share_of_windows():
    torch.manual_seed(0)
    found = stretches(4000, 9, 0.25)
    assert found.any(1).float().mean().item() == pytest.approx(0.25, abs=0.03)
    # One run: it begins once at most.
    begins = found[:, :1].long().sum(1) + (found[:, 1:] & ~found[:, :-1]).sum(1)
    assert begins.max() == 1
    assert not stretches(50, 9, 0.0).any()


@pytest.mark.parametrize("loss", ["likelihood", "learned"])
def test_it_learns_a_short_scene_through_the_front_end(loss):
    """One batch is learned by heart: translations that the untrained net does not know, and rotation stays right."""
    torch.manual_seed(0)
    front = PairEncoder(size_px=(96, 64), features=16, width=0.1, batch_norm=True, device="cpu")
    options = {"embedding": 16, "window": 3, "imu_hidden": 8, "hidden": 32, "joined": 16, "dropout": 0.0}
    options |= {"lost_images": 0.0, "lost_imu": 0.0, "horizons": [2, 4]}
    fuser = VinetFuser(**options, translation_unit_m=0.1, loss=loss, device="cpu")
    whole = stored(make_scene())
    small = np.stack([cv2.resize(image, (96, 64), interpolation=cv2.INTER_AREA) for image in whole.images])
    scene = dataclasses.replace(whole, images=small[..., None])
    batch = collate([cut_window(scene, start, 4) for start in (0, 3, 6)]).as_float()
    nets = torch.nn.ModuleList([front.net, fuser.net]).train()
    optimizer = torch.optim.Adam(nets.parameters(), lr=4e-3)
    seen = []
    for _ in range(60):
        losses = fuser.loss(fuser.forward_batch(batch, front.forward_batch(batch, {})), batch)
        optimizer.zero_grad()
        losses["loss"].backward()
        optimizer.step()
        seen.append((losses["translation"].item(), losses["rotation"].item()))
        if len(seen) == 1:
            for name, parameter in nets.named_parameters():
                if loss == "learned" and name.endswith(("gyro.lasting", "gyro.alike")):
                    continue  # only a likelihood teaches these
                assert parameter.grad is not None and parameter.grad.isfinite().all(), name
    assert seen[-1][0] < 0.5 * seen[0][0]
    assert seen[-1][1] ** 0.5 < 0.02
