"""Both networks: the printed tables, any image size, learning, and a stream that answers as a batch does."""

import pytest

pytest.importorskip("torch", reason="needs torch: pip install 'vioframe[learn]'")

import torch

from vioframe.errors import ConfigError, ShapeError
from vioframe.learning.counting import size_of
from vioframe.learning.flownet import FlowNetConvolutions, SpatialStream, pairs_of
from vioframe.learning.losses import FixedWeights, GaussianLikelihood, LearnedWeights
from vioframe_tsvo.net.backbones import BACKBONES
from vioframe_tsvo.net.deepvo import DeepVoNet
from vioframe_tsvo.net.two_stream import TwoStreamNet, stack_flows


def test_spatial_stream_is_the_printed_table():
    with torch.device("meta"):
        stream = SpatialStream((512, 256))
        size = size_of(stream, torch.empty(1, 6, 256, 512))
        assert stream.convolutions(torch.empty(1, 6, 256, 512)).shape == (1, 1024, 4, 8)
    assert size.parameters == 24_050_752
    assert size.macs == pytest.approx(8.049e9, abs=0.5e6)
    assert size.bytes == 4 * size.parameters
    assert stream.features == 8192


@pytest.mark.parametrize("size_px", [(512, 256), (1242, 375), (160, 96), (65, 63)])
def test_predicted_sizes_are_the_true_ones(size_px):
    with torch.device("meta"):
        images = torch.empty(1, 6, *size_px[::-1])
        convolutions = FlowNetConvolutions()
        assert convolutions(images).shape[:1:-1] == convolutions.out_size(size_px)
        stream = SpatialStream(size_px)
        assert stream(images).shape == (1, stream.features)


@pytest.mark.parametrize(("name", "features"), [("googlenet", 1024), ("resnet50", 2048), ("inceptionv3", 2048)])
@pytest.mark.parametrize("stack", [3, 5, 10, 12])
def test_two_streams_are_the_sum_of_their_parts(name, features, stack):
    with torch.device("meta"):
        net = TwoStreamNet(size_px=(512, 256), stack=stack, backbone=name)
        size = size_of(net, torch.empty(1, 6, 256, 512), torch.empty(1, 2 * stack, 256, 512))
        temporal = size_of(BACKBONES[name](2 * stack), torch.empty(1, 2 * stack, 256, 512))
    head = (8192 + features) * 512 + 512 * 6
    assert size.parameters == 24_050_752 + temporal.parameters + head + 512 + 6
    assert size.macs == 8_048_869_376 + temporal.macs + head


@pytest.mark.parametrize("make", ["spatial", "resnet50", "googlenet", "inceptionv3"])
def test_counts_agree_with_torchs_own(make):
    """torch counts where kernels are dispatched, this project where layers are called; both skip the same work."""
    from torch.utils.flop_counter import FlopCounterMode

    with torch.device("meta"):
        if make == "spatial":
            net, images = SpatialStream((160, 96)), torch.empty(2, 6, 96, 160)
        else:
            net, images = BACKBONES[make](20), torch.empty(2, 20, 96, 160)
        counter = FlopCounterMode(display=False)
        with counter:
            net(images)
        assert 2 * size_of(net, images).macs == counter.get_total_flops()


def test_lstm_count_is_its_equations():
    """Four gates, each a product with the input and with the hidden state, in two layers."""
    with torch.device("meta"):
        net = DeepVoNet(size_px=(512, 256), hidden=1000)
        pairs = torch.empty(2, 5, 6, 256, 512)
        convolutions = size_of(net.convolutions, torch.empty(10, 6, 256, 512))
        size = size_of(net, pairs)
    features = 1024 * 8 * 4
    assert size.macs - convolutions.macs == 10 * (4000 * (features + 1000) + 4000 * 2000 + 1000 * 6)
    weights = 4000 * (features + 1000) + 4000 * 2000 + 4 * 4000
    assert size.parameters - convolutions.parameters == weights + 1000 * 6 + 6
    assert convolutions.parameters == 24_050_752 - (9 * 1024 * 1024 + 1024)


def test_flows_are_stacked_oldest_first():
    flow = torch.arange(2 * 5 * 2.0).reshape(2, 5, 2, 1, 1).expand(-1, -1, -1, 3, 4)
    stacked = stack_flows(flow, 3)
    assert stacked.shape == (2, 3, 6, 3, 4)
    for step in range(3):
        assert torch.equal(stacked[1, step], torch.cat([flow[1, step], flow[1, step + 1], flow[1, step + 2]]))


def test_pairs_put_the_earlier_image_first():
    images = torch.rand(2, 4, 3, 5, 6)
    pairs = pairs_of(images)
    assert pairs.shape == (2, 3, 6, 5, 6)
    assert torch.equal(pairs[:, 1, :3], images[:, 1]) and torch.equal(pairs[:, 1, 3:], images[:, 2])
    gray = pairs_of(images[:, :, :1])
    assert torch.equal(gray[:, 0, 2], images[:, 0, 0]) and torch.equal(gray[:, 0, 3], images[:, 1, 0])


def test_both_streams_and_both_images_matter():
    torch.manual_seed(0)
    net = TwoStreamNet(size_px=(96, 64), stack=2, backbone="googlenet", width=0.1).eval()
    pair, flow = torch.rand(1, 6, 64, 96), torch.randn(1, 4, 64, 96)
    base = net(pair, flow).vector
    swapped = pair.roll(3, dims=1)
    assert not torch.allclose(net(swapped, flow).vector, base, rtol=1e-3, atol=0)
    assert not torch.allclose(net(pair, -flow).vector, base, rtol=1e-3, atol=0)
    assert not torch.allclose(net(pair, flow.roll(2, dims=1)).vector, base, rtol=1e-3, atol=0)


@pytest.mark.parametrize("name", BACKBONES)
def test_training_begins_close_to_rest(name):
    torch.manual_seed(0)
    net = TwoStreamNet(size_px=(128, 96), stack=3, backbone=name, width=0.25)
    with torch.no_grad():
        vector = net(torch.rand(4, 6, 96, 128), torch.randn(4, 6, 96, 128)).vector
    assert vector.abs().max() < 1.0


@pytest.mark.parametrize("log_variances", [False, True])
def test_variances_come_only_where_asked_for(log_variances):
    net = TwoStreamNet(size_px=(64, 64), stack=1, backbone="googlenet", width=0.1, log_variances=log_variances)
    estimate = net(torch.rand(2, 6, 64, 64), torch.zeros(2, 2, 64, 64))
    assert estimate.vector.shape == (2, 6)
    assert (estimate.log_variances is not None) == log_variances


def test_half_precision_inside_single_precision_out():
    net = TwoStreamNet(size_px=(64, 64), stack=1, backbone="googlenet", width=0.1)
    with torch.autocast("cpu", torch.bfloat16):
        assert net(torch.rand(2, 6, 64, 64), torch.zeros(2, 2, 64, 64)).vector.dtype == torch.float32


def test_flows_that_a_backbone_cannot_take_are_enlarged():
    net = TwoStreamNet(size_px=(128, 64), stack=2, backbone="inceptionv3", width=0.1).eval()
    assert net.flow_size_px == (128, 75)
    with torch.no_grad():
        assert net(torch.rand(1, 6, 64, 128), torch.rand(1, 4, 64, 128)).vector.shape == (1, 6)


def test_wrong_inputs_and_settings_are_refused():
    net = TwoStreamNet(size_px=(64, 32), stack=2, backbone="googlenet", width=0.1)
    with pytest.raises(ShapeError, match=r"images of 6 channels and 64×32 px, got an array of shape \(1, 6, 64, 32\)"):
        net(torch.zeros(1, 6, 64, 32), torch.zeros(1, 4, 32, 64))
    with pytest.raises(ShapeError, match="flows of 4 channels"):
        net(torch.zeros(1, 6, 32, 64), torch.zeros(1, 6, 32, 64))
    with pytest.raises(ConfigError, match="vo.stack must be at least 1, got 0"):
        TwoStreamNet(size_px=(64, 32), stack=0, backbone="googlenet")
    with pytest.raises(ShapeError, match="pairs of images in a row"):
        DeepVoNet(size_px=(64, 32), width=0.1, hidden=8)(torch.zeros(1, 6, 32, 64))
    with pytest.raises(ConfigError, match="vo.layers must be at least 1"):
        DeepVoNet(size_px=(64, 32), layers=0)


def test_deepvo_in_a_stream_is_deepvo_in_a_batch():
    torch.manual_seed(1)
    net = DeepVoNet(size_px=(64, 64), width=0.1, hidden=24, batch_norm=True).eval()
    pairs = torch.rand(2, 7, 6, 64, 64)
    with torch.no_grad():
        whole, _ = net(pairs)
        state, parts = None, []
        for steps in pairs.split([1, 1, 3, 2], dim=1):
            estimate, state = net(steps, state)
            parts.append(estimate.vector)
        fresh, _ = net(pairs[:, 3:])
    torch.testing.assert_close(torch.cat(parts, dim=1), whole.vector, rtol=1e-5, atol=1e-6)
    assert not torch.allclose(fresh.vector, whole.vector[:, 3:], rtol=1e-3, atol=0), "the past leaves no trace"


def test_two_streams_answer_the_same_alone_as_in_a_batch():
    torch.manual_seed(2)
    net = TwoStreamNet(size_px=(96, 80), stack=3, backbone="inceptionv3", width=0.1).eval()
    pair, flow = torch.rand(3, 6, 80, 96), torch.randn(3, 6, 80, 96)
    with torch.no_grad():
        alone = torch.cat([net(pair[k : k + 1], flow[k : k + 1]).vector for k in range(3)])
        torch.testing.assert_close(alone, net(pair, flow).vector, rtol=1e-4, atol=1e-6)


def fit(parameters, step, *, rate, steps):
    """First loss, and the first below a hundredth of it (or the last)."""
    optimizer = torch.optim.Adam(parameters, lr=rate, fused=True)
    first = value = None
    for _ in range(steps):
        optimizer.zero_grad()
        loss = step()
        loss.backward()
        optimizer.step()
        value = loss.item()
        first = value if first is None else first
        if value < 0.01 * first:
            break
    return first, value


@pytest.mark.parametrize(("name", "side"), [("googlenet", 48), ("resnet50", 48), ("inceptionv3", 75)])
def test_one_batch_is_learned_by_heart(name, side):
    torch.manual_seed(3)
    net = TwoStreamNet(
        size_px=(64, 64), stack=3, backbone=name, flow_size_px=(side, side), width=0.125, hidden=64, dropout=0.0
    )
    pair, flow = torch.rand(4, 6, 64, 64), torch.randn(4, 6, 64, 64)
    target = torch.randn(4, 6) * torch.tensor([0.02, 0.05, 0.02, 0.05, 0.05, 1.0])
    loss = FixedWeights()
    first, last = fit(net.parameters(), lambda: loss(net(pair, flow).vector, target)["loss"], rate=1e-3, steps=60)
    assert last < 0.01 * first


def test_deepvo_learns_one_batch_by_heart():
    torch.manual_seed(4)
    net = DeepVoNet(size_px=(64, 64), width=0.125, hidden=64, conv_dropout=0.0, last_conv_dropout=0.0, lstm_dropout=0.0)
    pairs = torch.rand(2, 5, 6, 64, 64)
    target = torch.randn(2, 5, 6) * torch.tensor([0.02, 0.05, 0.02, 0.05, 0.05, 1.0])
    loss = FixedWeights()
    first, last = fit(net.parameters(), lambda: loss(net(pairs)[0].vector, target)["loss"], rate=3e-3, steps=150)
    assert last < 0.01 * first


def test_learned_weights_and_variances_train_with_the_net():
    torch.manual_seed(5)
    net = TwoStreamNet(
        size_px=(64, 64), stack=1, backbone="googlenet", width=0.1, hidden=32, dropout=0.0, log_variances=True
    )
    pair, flow = torch.rand(4, 6, 64, 64), torch.randn(4, 2, 64, 64)
    target = 0.3 * torch.randn(4, 6)
    weights, likelihood = LearnedWeights(), GaussianLikelihood()

    def step():
        estimate = net(pair, flow)
        return weights(estimate.vector, target)["loss"] + likelihood(*estimate[:1], target, estimate[1])["loss"]

    before = step().item()
    fit([*net.parameters(), *weights.parameters()], step, rate=1e-3, steps=20)
    assert step().item() < before - 1.0
    assert weights.log_variance_rotation.grad is not None
