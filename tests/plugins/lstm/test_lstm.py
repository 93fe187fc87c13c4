"""Both heads: the contract, streams that are answered as batches are, what they learn, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs torch: pip install 'vioframe[learn]'")
pytest.importorskip("safetensors", reason="needs safetensors: pip install 'vioframe[learn]'")

import torch

from answered_scenes import batch_of, stored, upstream_of
from filter_runs import play, record, simulated
from vioframe.geometry import se3
from vioframe.interfaces import Trainable
from vioframe.testing import check_component
from vioframe_lstm import LstmFuser, PoseOptions, ResidualOptions
from vioframe_lstm.net.causal import CausalNet, Memory
from vioframe_lstm.pairs import pairs_of_batch

FRAMES = 12
VO = {"rotation_noise": 0.004, "translation_noise": 0.03}


def lstm(head="residual", *, frames=FRAMES, pose=None, residual=None, **options) -> LstmFuser:
    torch.manual_seed(3)
    return LstmFuser(
        head=head,
        frames=frames,
        pose=PoseOptions(**{"width": 0.1, "kernel": 3, **(pose or {})}),
        residual=ResidualOptions(
            **{"channels": 8, "dropout": 0.0, "lost_share": 0.0, "horizons": (4, 16, 30), **(residual or {})}
        ),
        device="cpu",
        **options,
    )


def enliven(part: LstmFuser) -> LstmFuser:
    """Answers that depend on what is seen, as after a training."""
    torch.manual_seed(4)
    for name, parameter in part.net.named_parameters():
        if name.endswith("exit.weight"):
            torch.nn.init.normal_(parameter, std=0.3)
    return part


HEADS = pytest.mark.parametrize(
    "make",
    [
        lambda **options: lstm(**options),
        lambda **options: lstm("pose", **options),
        lambda **options: lstm("pose", pose={"pose": "absolute", "activation": "relu", "refines": False}, **options),
        lambda **options: lstm("pose", pose={"padding": "valid"}, **options),
    ],
    ids=["residual", "pose", "as the paper", "valid padding"],
)


@pytest.fixture(scope="module")
def drive():
    recording = simulated("car", 8.0, seed=5)
    run = record(recording, **VO)
    return recording, run, stored(recording, run)


@HEADS
def test_contract(make):
    part = make()
    check_component(part)
    assert isinstance(part, Trainable)
    assert part.needs_training
    assert part.learns_from == "answers"


@HEADS
def test_a_stream_is_answered_as_a_batch(make, drive):
    recording, run, sequence = drive
    part = enliven(make())
    pairs = 30
    batch = batch_of(sequence, pairs, 0)
    with torch.inference_mode():
        outputs = part.forward_batch(batch, upstream_of(batch))
    states = play(part, recording, replace(run, measurements=run.measurements[:pairs])).states
    if "fused_poses" in outputs:
        # States of the stream, moved as the batch says the camera moves.
        T_body_cam = recording.rig.cameras[0].T_body_cam
        streamed = np.stack([state.T_world_body @ T_body_cam for state in states])
        motions = se3.inverse(streamed[:-1]) @ streamed[1:]
        answered = outputs["T_prev_cur"][0].numpy()
        assert len(answered) == pairs - FRAMES + 1
        np.testing.assert_allclose(motions[-len(answered) :], answered, atol=2e-4)
        return
    head = part._head
    head.setup(recording.rig)
    R_body_cam = recording.rig.cameras[0].T_body_cam[:3, :3]
    pairs_seen = pairs_of_batch(batch, upstream_of(batch), head._unstated)
    shifts = pairs_seen.t_camera_of(outputs["corrected_shift"].double().numpy())[0]
    for index, measurement in enumerate(run.measurements[:pairs]):
        pose = head.corrected(measurement)
        blocks = [R_body_cam @ pose.covariance[block, block] @ R_body_cam.T for block in (slice(3), slice(3, 6))]
        logarithms = np.log(np.concatenate([np.diag(block) for block in blocks]))
        np.testing.assert_allclose(logarithms, outputs["corrected_log_variances"][0, index].numpy(), atol=1e-3)
        np.testing.assert_array_equal(pose.T_prev_cur[:3, :3], measurement.relative_pose.T_prev_cur[:3, :3])
        np.testing.assert_allclose(pose.T_prev_cur[:3, 3], shifts[index], atol=2e-5)


def test_an_answer_looks_at_no_more_than_its_frames(drive):
    _, _, sequence = drive
    part = enliven(lstm())
    short, long = batch_of(sequence, FRAMES, 28), batch_of(sequence, 40, 0)
    with torch.inference_mode():
        of_short, of_long = (
            part.forward_batch(one, upstream_of(one))["corrected_log_variances"][0, -1] for one in (short, long)
        )
    np.testing.assert_allclose(of_short, of_long, atol=1e-4)


@pytest.mark.parametrize("frames", [1, 2, 3, 7, 8, 59, 60])
def test_the_net_looks_back_at_exactly_its_frames(frames):
    torch.manual_seed(0)
    net = CausalNet(2, 3, channels=4, frames=frames, dropout=0.0).double()
    torch.nn.init.normal_(net.exit.weight)
    memory = Memory(net)
    streamed = torch.stack([net.step(frame, memory) for frame in torch.ones(frames + 5, 2, dtype=torch.float64)])
    torch.testing.assert_close(streamed, net(torch.ones(1, frames + 5, 2, dtype=torch.float64))[0])
    signal = torch.randn(1, frames + 5, 2, dtype=torch.float64, requires_grad=True)
    net(signal)[0, -3].sum().backward()
    felt = (signal.grad[0].abs().sum(-1) > 0.0).nonzero().flatten().tolist()
    assert felt == list(range(3, frames + 3))


def test_untrained_it_is_the_filter(drive):
    """The last layer begins at zero: motions and covariances of the VO pass as they are."""
    recording, run, _ = drive
    head = lstm()._head
    head.setup(recording.rig)
    for measurement in run.measurements[:5]:
        pose = head.corrected(measurement)
        np.testing.assert_allclose(pose.T_prev_cur, measurement.relative_pose.T_prev_cur, atol=1e-5)
        np.testing.assert_allclose(pose.covariance, measurement.relative_pose.covariance, rtol=1e-3, atol=1e-9)


@HEADS
def test_learns(make, drive):
    """The loss of a fixed batch falls: every part of the net gets a gradient that leads somewhere."""
    _, _, sequence = drive
    part = make()
    batch = batch_of(sequence, 30, 0, 10, 20)
    part.net.train()
    optimizer = torch.optim.Adam(part.net.parameters(), lr=3e-3)
    losses = []
    for _ in range(25):
        torch.manual_seed(0)
        loss = part.loss(part.forward_batch(batch, upstream_of(batch)), batch)["loss"]
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert np.isfinite(losses).all()
    assert losses[-1] < losses[0] - 0.1
