"""Weights are data: what was written comes back, and whatever does not fit is refused in one sentence, unopened."""

import json
import pickle

import pytest

pytest.importorskip("torch", reason="needs the extra learn")
pytest.importorskip("safetensors", reason="needs the extra learn")
pytest.importorskip("lightning", reason="needs the extra learn")

import torch
from safetensors.torch import load_file, save_file

from learned_parts import TinyVo
from vioframe.errors import ConfigError, DataError
from vioframe.learning.weights import load_weights, locate_weights, read_card, save_weights


@pytest.fixture
def saved(tmp_path):
    part = TinyVo()
    path = tmp_path / "tiny.safetensors"
    save_weights(path, part, {"licence": "Apache-2.0"})
    return part, path


def refused(path, part, match):
    before = [parameter.clone() for parameter in part.net.parameters()]
    with pytest.raises(DataError, match=match) as told:
        load_weights(path, part, "vo.weights")
    assert "\n" not in str(told.value)
    assert f"vo.weights={path}" in str(told.value)
    assert all(torch.equal(a, b) for a, b in zip(before, part.net.parameters(), strict=True))


def test_missing_file_is_told_by_its_key():
    with pytest.raises(ConfigError, match=r"vo.weights=nowhere.safetensors: there is no such file"):
        locate_weights("nowhere.safetensors", "vo.weights")


def test_round_trip_is_exact(saved):
    part, path = saved
    twin = TinyVo()
    load_weights(locate_weights(str(path), "vo.weights"), twin, "vo.weights")
    for one, two in zip(part.net.state_dict().values(), twin.net.state_dict().values(), strict=True):
        assert torch.equal(one, two)
    card = read_card(path)
    assert card["architecture"] == dict(part.architecture)
    assert card["parameters"] == sum(each.numel() for each in part.net.parameters())
    assert card["licence"] == "Apache-2.0"
    assert sorted(each.name for each in path.parent.iterdir()) == ["tiny.json", "tiny.safetensors"]


def test_another_width_and_stack_are_named(saved):
    _, path = saved
    refused(path, TinyVo(width=4), r"width=8 where 4 is needed")
    refused(path, TinyVo(context=3), r"context=1 where 3 is needed")


def test_another_part_is_told_without_its_details(saved, monkeypatch):
    part, path = saved
    other = {"part": "flow", "warps": 5}
    monkeypatch.setattr(TinyVo, "architecture", property(lambda self: other))
    refused(path, part, r"holds weights of 'tiny', not of 'flow'")


def test_a_folder_is_no_file(tmp_path):
    with pytest.raises(ConfigError, match=r"is a folder: name one of its .safetensors files"):
        locate_weights(str(tmp_path), "vo.weights")


@pytest.mark.parametrize("keep", [0, 4, 200, 2000])
def test_truncated_file(saved, keep):
    part, path = saved
    path.write_bytes(path.read_bytes()[:keep])
    refused(path, part, "not a whole safetensors file")


def test_pickle_is_never_opened(saved, tmp_path):
    class Hostile:
        def __reduce__(self):
            return ((tmp_path / "executed").write_text, ("",))

    part, path = saved
    path.write_bytes(pickle.dumps(Hostile()))
    refused(path, part, "can run code")
    torch.save({"net": Hostile()}, path)
    refused(path, part, "can run code")
    assert not (tmp_path / "executed").exists()


def test_header_that_claims_more_than_there_is(saved):
    part, path = saved
    path.write_bytes((2**62).to_bytes(8, "little") + path.read_bytes()[8:])
    refused(path, part, "not a whole safetensors file")


def test_file_of_another_program(saved):
    part, path = saved
    save_file({name: tensor.contiguous() for name, tensor in part.net.state_dict().items()}, path)
    refused(path, part, "was not written by vioframe")


@pytest.mark.parametrize("change", ["missing", "more", "shape", "nan"])
def test_tensors_that_do_not_fit(saved, change):
    part, path = saved
    state = load_file(path)
    name = "0.weight"
    if change == "missing":
        del state[name]
    elif change == "more":
        state["extra"] = torch.zeros(1)
    elif change == "shape":
        state[name] = state[name][:4].contiguous()
    else:
        state[name][0] = float("nan")
    header = {"format": "vioframe-weights-1", "architecture": json.dumps(dict(part.architecture))}
    save_file(state, path, metadata=header)
    refused(path, part, "not finite" if change == "nan" else "does not fit the net")


@pytest.mark.parametrize("architecture", ["", "[]", "{", "null"])
def test_header_without_an_architecture(saved, architecture):
    part, path = saved
    save_file(load_file(path), path, metadata={"format": "vioframe-weights-1", "architecture": architecture})
    refused(path, part, "does not say of which architecture")


@pytest.mark.parametrize("text", ["{", "[1]"])
def test_damaged_card(saved, text):
    _, path = saved
    path.with_suffix(".json").write_text(text)
    with pytest.raises(DataError, match="is not a card of weights"):
        read_card(path)


def test_weights_come_out_of_mlflow(saved, monkeypatch):
    import mlflow.artifacts
    from mlflow.exceptions import MlflowException

    _, path = saved
    monkeypatch.setattr(mlflow.artifacts, "download_artifacts", lambda uri: str(path.parent))
    assert locate_weights("models:/tiny/3", "vo.weights") == path
    (path.parent / "second.safetensors").write_bytes(b"")
    with pytest.raises(ConfigError, match="vo.weights=runs:/abc/weights holds 2 safetensors files"):
        locate_weights("runs:/abc/weights", "vo.weights")

    def missing(uri):
        raise MlflowException("Run 'abc' not found")

    monkeypatch.setattr(mlflow.artifacts, "download_artifacts", missing)
    with pytest.raises(ConfigError, match="vo.weights=runs:/abc/weights cannot be fetched from MLflow: Run 'abc'"):
        locate_weights("runs:/abc/weights", "vo.weights")
