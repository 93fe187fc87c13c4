"""TVNet as a part that can be trained: what it gives in batches is what it gives in streaming."""

import dataclasses

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed (pip install 'vioframe[learn]')")
pytest.importorskip("safetensors", reason="safetensors is not installed (pip install 'vioframe[learn]')")

from vioframe.errors import ConfigError, DataError  # noqa: E402
from vioframe.interfaces import Trainable  # noqa: E402
from vioframe.learning.batch import RigBatch, WindowBatch  # noqa: E402
from vioframe.learning.weights import save_weights  # noqa: E402
from vioframe_flow import DisFrontend, TvnetFrontend  # noqa: E402


def tvnet(**options) -> TvnetFrontend:
    return TvnetFrontend(**{"size_px": None, "device": "cpu", "iterations": 3, "warps": 2, **options})


def batch_of(*windows) -> WindowBatch:
    """Windows of frames as a batch of grey images; the rest is of no interest here."""
    images = torch.stack([torch.stack([torch.from_numpy(f.images[0])[None] for f in window]) for window in windows])
    count, pairs = len(windows), len(windows[0]) - 1
    return WindowBatch(
        images=images,
        T_prev_cur=torch.eye(4).expand(count, pairs, 4, 4),
        stamps_ns=torch.arange(pairs + 1).expand(count, -1),
        imu=torch.zeros(count, pairs, 0, 6),
        imu_time_s=torch.zeros(count, pairs, 0),
        imu_mask=torch.zeros(count, pairs, 0, dtype=torch.bool),
        rig=RigBatch(
            intrinsics_px=torch.ones(count, 4),
            T_body_cam=torch.eye(4).expand(count, 4, 4),
            gravity=torch.full((count,), 9.81),
        ),
        velocity_body=torch.zeros(count, pairs + 1, 3),
        gravity_body=torch.zeros(count, pairs + 1, 3),
        recording=torch.zeros(count, dtype=torch.int64),
        start=torch.arange(count),
    ).as_float()


@pytest.mark.parametrize("quantise", [True, False])
def test_streaming_equals_batch(quantise: bool, rig_of, sliding) -> None:
    windows = [sliding(64, 48, (2, 1), count=4), sliding(64, 48, (-3, 2), count=4, seed=1)]
    part = tvnet(quantise=quantise, bound=0.25)
    with torch.no_grad():
        flow = part.forward_batch(batch_of(*windows), {})["flow"]
    assert flow.shape == (2, 3, 2, 48, 64)
    level_px = 16.0 / 127
    for index, window in enumerate(windows):
        part.setup(rig_of(64, 48))
        streamed = np.stack([features.flow for features in part.process_many(window)][1:])
        gap = np.abs(flow[index].permute(0, 2, 3, 1).numpy() - streamed)
        # A value on the edge between two levels may fall to either side.
        assert gap.max() < (level_px + 1e-3 if quantise else 1e-3)
        assert np.mean(gap > 1e-4) < 2e-3


def test_images_of_another_size_are_brought_to_that_of_streaming(rig_of, sliding) -> None:
    frames = sliding(128, 96, (4, 2), count=3)
    part = tvnet(size_px=[64, 48], quantise=False)
    with torch.no_grad():
        flow = part.forward_batch(batch_of(frames), {})["flow"]
    assert flow.shape == (1, 2, 2, 48, 64)
    part.setup(rig_of(128, 96))
    streamed = np.stack([features.flow for features in part.process_many(frames)][1:])
    gap = np.abs(flow[0].permute(0, 2, 3, 1).numpy() - streamed)[:, 6:-6, 6:-6]
    assert np.median(gap) < 0.05


def test_it_keeps_the_contract_of_what_can_be_trained(sliding) -> None:
    part = tvnet()
    assert isinstance(part, Trainable)
    assert part.context_pairs == 1
    assert part.architecture == {"part": "tvnet", "warps": 2, "iterations": 3, "start_rows": 0, "start_columns": 0}
    batch = batch_of(sliding(64, 48))
    assert set(part.loss(part.forward_batch(batch, {}), batch)) == {"loss"}
    assert tvnet(own_loss=False).loss(part.forward_batch(batch, {}), batch) == {}
    assert not [name for name, p in part.net.named_parameters() if not p.requires_grad and name != "log_constants"]


def test_gradients_pass_the_levels_unchanged(sliding) -> None:
    batch = batch_of(sliding(64, 48, count=3))
    gradients = []
    for quantise in (True, False):
        part = tvnet(quantise=quantise)
        weights = torch.linspace(-1.0, 1.0, 64)
        (part.forward_batch(batch, {})["flow"] * weights).sum().backward()
        gradients.append(part.net.gradient_kernels.grad)
    assert gradients[0].abs().max() > 0.0
    torch.testing.assert_close(*gradients)


def test_one_batch_can_be_learned_by_heart(sliding) -> None:
    """Towards the true flow, through the part's own output: the chain that a part after it would train it by."""
    torch.manual_seed(0)
    batch = batch_of(sliding(64, 48, (2, -1), count=3))
    part = tvnet(max_scales=1, learn_constants=True, start_grid=[2, 2], own_loss=False, quantise=False)
    truth = torch.tensor([2.0, -1.0]).view(1, 1, 2, 1, 1)
    optimiser = torch.optim.Adam(part.net.parameters(), lr=0.02)
    errors = []
    for _ in range(25):
        error = (part.forward_batch(batch, {})["flow"] - truth).abs()[..., 8:-8, 8:-8].mean()
        optimiser.zero_grad()
        error.backward()
        optimiser.step()
        errors.append(error.item())
    assert errors[-1] < 0.25 * errors[0]


def test_the_cache_knows_the_weights(tmp_path, rig_of, sliding) -> None:
    frames = sliding(64, 48)
    for change, computed in ((0.0, 4), (0.0, 0), (0.01, 4)):
        part = tvnet(cache=str(tmp_path))
        with torch.no_grad():
            part.net.gradient_kernels += change
        part.setup(rig_of(64, 48))
        part.process_many(frames)
        assert part.counters()["flows computed"] == computed


def test_a_frozen_net_is_served_from_the_cache(tmp_path, rig_of, sliding, monkeypatch) -> None:
    frames = sliding(64, 48)
    part = tvnet(cache=str(tmp_path))
    part.setup(rig_of(64, 48))
    streamed = np.stack([features.flow for features in part.process_many(frames)][1:])
    part.net.requires_grad_(False)
    monkeypatch.setattr(TvnetFrontend, "solve", lambda *_: pytest.fail("computed again"))
    flow = part.forward_batch(batch_of(frames), {})["flow"]
    np.testing.assert_array_equal(flow[0].permute(0, 2, 3, 1).numpy(), streamed)
    # One that is being trained computes, and so has a gradient.
    part.net.requires_grad_(True)
    assert part.forward_batch(batch_of(frames), {})["flow"].requires_grad


@pytest.mark.parametrize("colour", [1, 3])
def test_dis_takes_part_in_training_as_it_streams(colour: int, tmp_path, rig_of, sliding) -> None:
    windows = [sliding(64, 48), sliding(64, 48, seed=1)]
    part = DisFrontend(cache=str(tmp_path), size_px=[48, 40])
    assert isinstance(part, Trainable)
    batch = batch_of(*windows)
    coloured = dataclasses.replace(batch, images=batch.images.expand(-1, -1, colour, -1, -1))
    for _ in range(2):
        flow = part.forward_batch(coloured, {})["flow"]
        assert flow.shape == (2, 4, 2, 40, 48)
        for index, window in enumerate(windows):
            part.setup(rig_of(64, 48))
            streamed = np.stack([features.flow for features in part.process_many(window)][1:])
            np.testing.assert_array_equal(flow[index].permute(0, 2, 3, 1).numpy(), streamed)
    assert part.loss({"flow": flow}, batch) == {}
    assert list(part.net.parameters()) == []


def test_weights_come_back(tmp_path, sliding) -> None:
    trained = tvnet(start_grid=[2, 3], learn_constants=True)
    with torch.no_grad():
        for parameter in trained.net.parameters():
            parameter += 0.01 * torch.randn_like(parameter)
    save_weights(tmp_path / "flow.safetensors", trained, {})
    again = tvnet(start_grid=[2, 3], weights=str(tmp_path / "flow.safetensors"))
    batch = batch_of(sliding(64, 48))
    with torch.no_grad():
        torch.testing.assert_close(again.forward_batch(batch, {}), trained.forward_batch(batch, {}))
    with pytest.raises(DataError, match=r"frontend\.weights=.*another architecture.*iterations=3 where 4 is needed"):
        _ = tvnet(start_grid=[2, 3], iterations=4, weights=str(tmp_path / "flow.safetensors")).net
    with pytest.raises(ConfigError, match=r"frontend\.weights=.*no such file"):
        _ = tvnet(weights=str(tmp_path / "nothing.safetensors")).net
    (tmp_path / "cut.safetensors").write_bytes((tmp_path / "flow.safetensors").read_bytes()[:-100])
    with pytest.raises(DataError, match="not a whole safetensors file"):
        _ = tvnet(start_grid=[2, 3], weights=str(tmp_path / "cut.safetensors")).net


def test_a_gpu_that_is_not_there_is_missed_in_setup(rig_of, monkeypatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(ConfigError, match=r"frontend\.device=cuda"):
        tvnet(device="cuda").setup(rig_of(64, 48))
    tvnet(device="auto").setup(rig_of(64, 48))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU here")
def test_a_gpu_finds_the_same_flow(rig_of, sliding) -> None:
    frames = sliding(64, 48)
    flows = []
    for device in ("cpu", "cuda"):
        part = tvnet(device=device, quantise=False)
        part.setup(rig_of(64, 48))
        flows.append(np.stack([features.flow for features in part.process_many(frames)]))
    np.testing.assert_allclose(*flows, atol=1e-2)
