"""The networks: the printed tables, any image size, and a net that learns."""

import pytest

pytest.importorskip("torch", reason="needs torch: pip install 'vioframe[learn]'")

import torch

from vioframe.errors import ConfigError
from vioframe.learning.counting import size_of
from vioframe_superpoint.net.encoders.ghostnet import GhostNet
from vioframe_superpoint.net.encoders.mobilenetv2 import InvertedResidual, MobileNetV2
from vioframe_superpoint.net.superpoint import ENCODERS, make_net
from vioframe_superpoint.options import Encoder

ENCODER = pytest.mark.parametrize("encoder", ENCODERS)


def shapes_of(layers, size):
    """Channels and height after each layer of an image of 480×640."""
    found = []
    with torch.device("meta"):
        features = torch.empty(1, 1, *size)
        for layer in layers:
            features = layer.eval()(features)
            found.append((features.shape[1], features.shape[2]))
    return found


def test_mobilenetv2_is_the_printed_table():
    with torch.device("meta"):
        encoder = MobileNetV2()
    assert shapes_of(encoder.layers, (480, 640)) == [
        (32, 240),
        (16, 240),
        (24, 120),
        (24, 120),
        (32, 60),
        (32, 60),
        (32, 60),
    ]
    assert [layer.adds for layer in encoder.layers if isinstance(layer, InvertedResidual)] == [0, 0, 1, 0, 1, 1]


def test_ghostnet_is_the_printed_table():
    with torch.device("meta"):
        encoder = GhostNet()
    # 1.2 × (16, 16, 24, 24, 40, 40, 80), to multiples of four.
    assert shapes_of(encoder.layers, (480, 640)) == [
        (20, 240),
        (20, 240),
        (28, 120),
        (28, 120),
        (48, 60),
        (48, 60),
        (96, 60),
    ]


def test_vgg_is_superpoints_encoder():
    with torch.device("meta"):
        net = make_net("vgg")
        size = size_of(net, torch.empty(1, 1, 480, 640))
    # SuperPoint's published net has 1 300 865 parameters, with a bias where this one has scale and shift.
    normalised = 4 * 64 + 4 * 128 + 3 * 256
    assert size.parameters == 1_300_865 + normalised


@ENCODER
@pytest.mark.parametrize("size", [(8, 8), (32, 40), (120, 160)])
def test_heads_speak_of_cells_of_eight_pixels(encoder, size):
    torch.manual_seed(1)
    logits, descriptors = make_net(Encoder(name=encoder, width=0.25)).eval()(torch.rand(2, 1, *size))
    assert logits.shape == (2, 65, size[0] // 8, size[1] // 8)
    assert descriptors.shape == (2, 256, size[0] // 8, size[1] // 8)


@ENCODER
def test_learns_one_batch_by_heart(encoder):
    torch.manual_seed(2)
    net = make_net(Encoder(name=encoder, width=0.25)).train()
    images, cells = torch.rand(2, 1, 32, 32), torch.randint(0, 65, (2, 4, 4))
    optimiser = torch.optim.Adam(net.parameters(), 3e-3)
    losses = []
    for _ in range(40):
        loss = torch.nn.functional.cross_entropy(net(images)[0], cells)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.1 * losses[0]


@pytest.mark.parametrize(
    ("options", "message"), [({"name": "resnet", "width": 1.0}, "encoder.name must be one of vgg")]
)
def test_refuses_what_it_does_not_know(options, message):
    with pytest.raises(ConfigError, match=message):
        Encoder(**options)
