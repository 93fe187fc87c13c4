"""What is said of a net while it learns."""

import logging

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs torch: pip install 'vioframe[learn]'")

import torch

from vioframe.pictures import LightingOptions
from vioframe_superpoint import Encoder
from vioframe_superpoint.net.superpoint import make_net
from vioframe_superpoint.training.validation import PairValidation, validation_pairs


@pytest.fixture(scope="module")
def pictures():
    rng = np.random.default_rng(4)
    return [np.kron(rng.integers(0, 256, (12, 16)), np.ones((8, 8))).astype(np.uint8) for _ in range(2)]


def test_descriptors_that_have_become_alike_are_told(pictures, caplog):
    torch.manual_seed(0)
    net = make_net(Encoder(name="ghostnet", width=0.25)).eval()
    validation = PairValidation(net, validation_pairs(pictures, LightingOptions(), 0))
    # Normalisation knows these pictures, and takes off what all descriptors have in common.
    for layer in net.modules():
        if isinstance(layer, torch.nn.BatchNorm2d):
            layer.momentum = 1.0
    with torch.no_grad():
        net.train()(torch.from_numpy(np.stack(pictures))[:, None].float() / 255.0)
    net.eval()
    with caplog.at_level(logging.WARNING):
        apart = validation.figures()
    assert apart["alike"] < 0.8 and not caplog.text
    precision = np.mean([apart[f"{split}/mean_average_precision"] for split in ("illumination", "viewpoint")])
    assert apart["rank"] == pytest.approx(0.5 * (apart["rep"] + precision)), "as many pairs of either"
    with torch.no_grad():
        net.descriptor.centre.bias[0] = 100.0
    with caplog.at_level(logging.WARNING):
        together = validation.figures()
    assert together["alike"] > 0.95
    assert "raise negatives or radius_px of descriptor_loss=sparse_triplet" in caplog.text
