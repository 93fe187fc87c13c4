"""The backbones are torchvision's, parameter by parameter, and take its files and nothing else."""

import importlib.util
import pickle
import sys
import types

import pytest

pytest.importorskip("torch", reason="needs torch: pip install 'vioframe[learn]'")

import torch

from vioframe.errors import ConfigError, DataError
from vioframe.learning.counting import size_of
from vioframe_tsvo.net.backbones import BACKBONES, load_imagenet, make_backbone, widen

# torchvision's documentation of its IMAGENET1K weights: parameters, 1e9 multiply-accumulates, size of the crop.
# Inception's file has 27 161 264 with the auxiliary classifier's 3 326 696, which GoogLeNet's figure leaves out.
PUBLISHED = {
    "googlenet": (6_624_904, 1.498, 224),
    "resnet50": (25_557_032, 4.089, 224),
    "inceptionv3": (27_161_264 - 3_326_696, 5.713, 299),
}
TORCHVISION = {"googlenet": "googlenet", "resnet50": "resnet50", "inceptionv3": "inception_v3"}


@pytest.fixture(scope="module")
def torchvision_models():
    """torchvision's models, which are plain Python: its compiled part, often built for another torch, is left out."""
    if importlib.util.find_spec("torchvision") is None:
        pytest.skip("needs torchvision, which the project does not install")
    with pytest.MonkeyPatch.context() as patch:
        name = "torchvision._meta_registrations"
        patch.setitem(sys.modules, name, types.ModuleType(name))
        yield importlib.import_module("torchvision.models")


@pytest.mark.parametrize("name", BACKBONES)
def test_size_and_cost_are_the_published_ones(name):
    parameters, giga_macs, side = PUBLISHED[name]
    with torch.device("meta"):
        size = size_of(BACKBONES[name](3, 1000), torch.empty(1, 3, side, side))
    assert size.parameters == parameters
    assert size.macs == pytest.approx(1e9 * giga_macs, abs=0.6e6)


@pytest.mark.parametrize("name", BACKBONES)
def test_agrees_with_torchvision(name, torchvision_models, tmp_path):
    auxiliary = {} if name == "resnet50" else {"aux_logits": True, "init_weights": False}
    torch.manual_seed(3)
    theirs = getattr(torchvision_models, TORCHVISION[name])(weights=None, **auxiliary).eval()
    for module in theirs.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            torch.nn.init.uniform_(module.weight, 0.5, 1.5)
            torch.nn.init.uniform_(module.running_mean, -0.1, 0.1)
            torch.nn.init.uniform_(module.running_var, 0.5, 1.5)
    ours = BACKBONES[name](3, 1000).eval()
    expected = {key: value.shape for key, value in theirs.state_dict().items() if not key.lower().startswith("aux")}
    assert {key: value.shape for key, value in ours.state_dict().items()} == expected

    path = tmp_path / "imagenet.pth"
    torch.save(theirs.state_dict(), path)
    load_imagenet(ours, name, path)
    images = torch.rand(2, 3, 139, 171)
    with torch.no_grad():
        torch.testing.assert_close(ours(images), theirs(images), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", BACKBONES)
def test_every_channel_of_a_widened_file_sees_what_gray_saw(name, tmp_path):
    """With the mean repeated, flow channels that each hold a third of a gray image's sum give its features."""
    torch.manual_seed(5)
    rgb = BACKBONES[name](3, 10).eval()
    path = tmp_path / "imagenet.pth"
    torch.save(rgb.state_dict(), path)
    wide = make_backbone(name, 6, path).eval()
    assert wide.get_submodule(wide.first_convolution).in_channels == 6
    rgb.fc = None
    gray = torch.randn(2, 1, 96, 80)
    with torch.no_grad():
        torch.testing.assert_close(
            wide(gray.expand(-1, 6, -1, -1) / 2), rgb(gray.expand(-1, 3, -1, -1)), rtol=1e-4, atol=1e-5
        )


def test_widening_repeats_the_mean():
    weight = torch.arange(2 * 3 * 4.0).reshape(2, 3, 2, 2)
    wide = widen(weight, 20)
    assert wide.shape == (2, 20, 2, 2)
    assert torch.equal(wide[:, 7], weight.mean(1))


def test_safetensors_and_files_without_batch_counts_are_taken(tmp_path):
    safetensors = pytest.importorskip("safetensors.torch", reason="needs safetensors: pip install 'vioframe[learn]'")
    state = BACKBONES["googlenet"](3, 7).state_dict()
    old = {key: value for key, value in state.items() if not key.endswith("num_batches_tracked")}
    safetensors.save_file(old, tmp_path / "old.safetensors")
    net = make_backbone("googlenet", 3, tmp_path / "old.safetensors")
    assert torch.equal(net.state_dict()["inception5b.branch4.1.conv.weight"], old["inception5b.branch4.1.conv.weight"])


class Hostile:
    """Unpickled, it would leave a file behind."""

    def __init__(self, trace):
        self.trace = trace

    def __reduce__(self):
        return (open, (str(self.trace), "w"))


def spoilt_files(folder):
    state = BACKBONES["googlenet"](3, 7).state_dict()
    whole = folder / "whole.pth"
    torch.save(state, whole)
    (folder / "truncated.pth").write_bytes(whole.read_bytes()[:-4000])
    (folder / "truncated.safetensors").write_bytes(b"\x40\x00\x00\x00\x00\x00\x00\x00{")
    (folder / "empty.pth").write_bytes(b"")
    (folder / "text.pth").write_text("not weights")
    (folder / "hostile.pth").write_bytes(pickle.dumps(Hostile(folder / "trace"), protocol=2))
    torch.save({"state_dict": 3}, folder / "something.pth")
    torch.save({**state, "conv1.conv.weight": torch.zeros(64, 4, 7, 7)}, folder / "stem.pth")
    torch.save({**state, "conv1.conv.weight": torch.full((64, 3, 7, 7), float("nan"))}, folder / "nan.pth")
    torch.save({**state, "extra.weight": torch.zeros(1)}, folder / "extra.pth")
    return {
        "missing.pth": "no file",
        "truncated.pth": "not a readable file of weights",
        "truncated.safetensors": "not a readable file of weights",
        "empty.pth": "not a readable file of weights",
        "text.pth": "not a readable file of weights",
        "hostile.pth": "not a readable file of weights",
        "something.pth": "something else than named tensors",
        "stem.pth": r"conv1.conv.weight has shape \(64, 4, 7, 7\)",
        "nan.pth": "not finite",
        "extra.pth": "extra.weight",
    }


def test_bad_files_are_refused_with_a_sentence_and_change_nothing(tmp_path):
    net = make_backbone("googlenet", 10)
    before = {key: value.clone() for key, value in net.state_dict().items()}
    for name, sentence in spoilt_files(tmp_path).items():
        with pytest.raises(DataError, match=sentence) as caught:
            load_imagenet(net, "googlenet", tmp_path / name)
        assert "\n" not in str(caught.value)
    assert not (tmp_path / "trace").exists(), "a weights file ran code"
    assert all(torch.equal(value, before[key]) for key, value in net.state_dict().items())


def test_a_file_of_another_architecture_is_refused_by_name(tmp_path):
    torch.save(BACKBONES["resnet50"](3, 5).state_dict(), tmp_path / "resnet50.pth")
    with pytest.raises(DataError, match="not a file for googlenet: it lacks"):
        make_backbone("googlenet", 10, tmp_path / "resnet50.pth")


def test_unknown_backbone_is_refused():
    with pytest.raises(ConfigError, match="googlenet, resnet50, inceptionv3"):
        make_backbone("vgg", 10)
