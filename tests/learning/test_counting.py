"""What a net weighs and costs: counted by hand, by torch, and shown by ``task=model_card``."""

import time

import pytest

pytest.importorskip("torch", reason="needs torch: pip install 'vioframe[learn]'")
pytest.importorskip("safetensors", reason="needs safetensors: pip install 'vioframe[learn]'")

import torch
from torch import nn

from vioframe.errors import ConfigError
from vioframe.learning.counting import counting, milliseconds, size_of


def test_layers_are_counted_from_the_shapes_that_pass():
    net = nn.Sequential(nn.Conv2d(4, 6, 3, stride=2, padding=1, groups=2), nn.BatchNorm2d(6), nn.Flatten())
    size = size_of(net, torch.zeros(2, 4, 8, 10))
    assert size.macs == 2 * 6 * (4 * 5) * 9 * 2
    assert size.parameters == 6 * 2 * 9 + 6 + 12
    assert size.bytes == 4 * (size.parameters + 12) + 8, "running statistics and their count are saved, too"
    assert size_of(nn.Linear(3, 5), torch.zeros(7, 2, 3)).macs == 7 * 2 * 3 * 5
    assert size_of(nn.Conv1d(3, 5, 7), torch.zeros(1, 3, 17)).macs == 5 * 11 * 3 * 7
    assert size_of(nn.LSTM(3, 4, 2), torch.zeros(6, 2, 3)).macs == 12 * 4 * 4 * ((3 + 4) + (4 + 4))


def test_layers_that_are_called_twice_count_twice():
    layer = nn.Linear(3, 3)
    with counting(layer) as work:
        layer(layer(torch.zeros(1, 3)))
    assert work.macs == 18
    layer(torch.zeros(1, 3))
    assert work.macs == 18, "it counts on after its block"


def test_counting_leaves_the_net_as_it_was():
    net = nn.Sequential(nn.Conv2d(1, 1, 1), nn.BatchNorm2d(1)).train()
    before = {name: value.clone() for name, value in net.state_dict().items()}
    size_of(net, torch.randn(2, 1, 4, 4))
    assert net.training
    assert all(torch.equal(value, before[name]) for name, value in net.state_dict().items())


def test_a_layer_that_cannot_be_counted_is_refused():
    with pytest.raises(ConfigError, match="Conv3d are not known"):
        size_of(nn.Conv3d(1, 1, 3), torch.zeros(1, 1, 3, 3, 3))
    with pytest.raises(ConfigError, match="LSTM are not known"):
        size_of(nn.LSTM(3, 4, bidirectional=True), torch.zeros(2, 1, 3))


def test_time_is_that_of_most_calls():
    times = iter([0.0, 0.0, *[0.0] * 4, 0.05])
    assert 0.0 <= milliseconds(lambda: time.sleep(next(times)), repeats=5) < 25.0


def test_model_card_shows_the_parts_with_a_net(cli):
    small = ["vo.size_px=[96,64]", "vo.width=0.125", "vo.hidden=16"]
    done = cli("task=model_card", "vo=deepvo", *small)
    assert done.returncode == 0, done.stderr
    assert "vo=deepvo" in done.stdout and "multiply-accumulates" in done.stdout and "width_px=96" in done.stdout


def test_model_card_of_parts_without_a_net_says_so(cli):
    done = cli("task=model_card", "vo=stereo")
    assert done.returncode == 1
    assert "none of" in done.stderr and "vo=stereo has a net" not in done.stdout
    assert "Traceback" not in done.stderr
