"""What an experiment records of its nets: as counted layer by layer, without computing."""

import json

import pytest

pytest.importorskip("torch", reason="needs torch: pip install 'vioframe[learn]'")
pytest.importorskip("safetensors", reason="needs safetensors: pip install 'vioframe[learn]'")

import torch
from torch import nn

from learned_parts import TinyVo
from vioframe.learning.counting import counting, idling, parameters_of
from vioframe.learning.figures import model_figures
from vioframe.tracking import metrics_of


@pytest.mark.parametrize(
    ("net", "shape"),
    [
        (nn.Conv2d(3, 5, (3, 5), stride=(2, 1), padding=(1, 0), dilation=(1, 2)), (2, 3, 17, 21)),
        (nn.Conv2d(4, 6, 3, padding="same", groups=2), (1, 4, 8, 9)),
        (nn.Conv2d(4, 6, 3, padding="valid"), (4, 8, 9)),
        (nn.Conv1d(3, 5, 7, stride=3), (2, 3, 30)),
        (nn.Linear(6, 4), (2, 3, 6)),
    ],
)
def test_idle_layers_answer_in_the_right_shape(net, shape):
    x = torch.randn(shape)
    with counting(net) as work:
        wanted = net(x)
    with counting(net) as idle, idling(net):
        answer = net(x)
    assert answer.shape == wanted.shape and not answer.any()
    assert idle.macs == work.macs > 0
    assert torch.equal(net(x), wanted), "it computes again after the block"


@pytest.mark.parametrize("batch_first", [False, True])
@pytest.mark.parametrize("shape", [(4, 2, 3), (4, 3)])
def test_an_idle_lstm_has_a_memory_of_the_right_shape(batch_first, shape):
    net, x = nn.LSTM(3, 5, 2, batch_first=batch_first), torch.randn(shape)
    wanted, (hidden, cell) = net(x)
    with idling(net):
        answer, memory = net(x)
    assert (answer.shape, memory[0].shape, memory[1].shape) == (wanted.shape, hidden.shape, cell.shape)


@pytest.mark.parametrize("context", [1, 3])
def test_a_part_is_counted_as_when_it_computes(context):
    part = TinyVo(context=context)
    figures = model_figures({"frontend": object(), "vo": part}, size_px=(64, 48))
    with counting(part.net) as work:
        part.net(torch.zeros(1, 2 * context, 48, 64))
    assert figures["vo.gmac"] == figures["gmac"] == work.macs / 1e9
    assert figures["vo.parameters"] == figures["parameters"] == parameters_of(part.net)


def test_what_cannot_be_counted_has_no_number():
    class Odd(TinyVo):
        def forward_batch(self, batch, upstream):
            raise ValueError("only real images will do")

    class Solver(TinyVo):
        def __init__(self):
            super().__init__()
            self.net = nn.Conv3d(1, 1, 3)

    for part in (Odd(), Solver()):
        figures = model_figures({"vo": part})
        assert set(figures) == {"vo.parameters", "parameters"}
    assert model_figures({"vo": object()}) == {}


@pytest.mark.parametrize("training", [False, True])
def test_the_net_is_left_as_it_was(training):
    part = TinyVo()
    part.net.train(training)
    before = {name: value.clone() for name, value in part.net.state_dict().items()}
    model_figures({"vo": part}, size_px=(64, 48))
    assert part.net.training is training
    assert all(torch.equal(value, before[name]) for name, value in part.net.state_dict().items())
    assert part.net(torch.rand(1, 2, 48, 64)).any()


def test_the_record_has_them_beside_the_sequences():
    rows = [{"sequence": name, "ate_se3_m": value} for name, value in (("a", 1.0), ("b", 3.0))]
    document = json.loads(json.dumps({"sequences": rows, "model": {"parameters": 10.0, "vo.gmac": 0.5}}))
    numbers = metrics_of(document)
    assert (numbers["model.parameters"], numbers["model.vo.gmac"], numbers["ate_se3_m"]) == (10.0, 0.5, 2.0)
    assert "a/model.parameters" not in numbers
