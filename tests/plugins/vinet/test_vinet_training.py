"""Both parts of VINet trained together by the loop of the core, and what comes out used."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip("torch", reason="needs torch: pip install 'vioframe[learn]'")
pytest.importorskip("lightning", reason="needs lightning: pip install 'vioframe[learn]'")

import torch

from composing import composed
from learned_parts import options
from learned_scenes import stored
from vioframe.build import build, build_pipeline
from vioframe.data.recording import Dataset
from vioframe.data.windows import cut_window
from vioframe.learning.batch import collate
from vioframe.learning.seeding import seed_everything
from vioframe.learning.training import Split, train_parts
from vioframe.tasks.provision import provide_weights
from vioframe.testing import make_scene
from vioframe.tracking import NullTracker
from vioframe.types import Measurement
from vioframe_vinet import PairEncoder, VinetFuser

SIZE = (96, 64)


def parts(**weights):
    front = {"size_px": SIZE, "features": 8, "width": 0.1, "device": "cpu", "weights": weights.get("frontend")}
    fuser = {"embedding": 8, "window": 3, "imu_hidden": 6, "hidden": 16, "joined": 8, "device": "cpu"}
    return {"frontend": PairEncoder(**front), "fuser": VinetFuser(**fuser, weights=weights.get("fuser"))}


def small(name):
    whole = stored(make_scene(), name)
    images = np.stack([cv2.resize(image, SIZE, interpolation=cv2.INTER_AREA) for image in whole.images])
    return dataclasses.replace(whole, images=images[..., None])


def test_both_parts_are_trained_together_then_the_fuser_alone_and_keep_their_weights(tmp_path):
    chosen = options(
        tmp_path,
        max_epochs=2,
        epoch_windows=8,
        size_px=list(SIZE),
        augmentation={"reverse": 0.5, "mirror": 0.5},
        settling={"max_epochs": 3, "epoch_windows": 12, "batch_size": 2, "learning_rate": 1e-4},
    )
    seed_everything(0)
    splits = (Split(sequences=(small(name),), hashes=(name,)) for name in ("training", "validation"))
    trained = train_parts(parts(), *splits, chosen, folder=tmp_path, tracker=NullTracker(), about={}, shown=False)
    assert {slot: path.parent.parent.name for slot, path in trained.weights.items()} == {
        "frontend": tmp_path.name,
        "fuser": "settled",
    }
    assert trained.epochs == len(trained.curve) == 5
    assert trained.score is not None and np.isfinite(trained.score.t_rel_percent)
    used = parts(**{slot: str(path) for slot, path in trained.weights.items()})
    scene = make_scene()
    for part in used.values():
        assert not part.needs_training
        part.setup(scene.rig)
    states = []
    used["frontend"].process(scene.windows[0].previous)
    for window in scene.windows:
        states += used["fuser"].update(Measurement(window=window, features=used["frontend"].process(window.current)))
    assert len(states) == len(scene.frames)
    assert all(np.linalg.eigvalsh(state.covariance).min() > 0.0 for state in states)


def test_an_experiment_trains_without_settling_where_it_is_left_out(tmp_path):
    small = [
        "frontend.features=8",
        "frontend.width=0.05",
        "fuser.window=3",
        "fuser.hidden=8",
        "trainer.epoch_windows=4",
    ]
    splits = ("train", "validation")
    recordings = [f"training_data.{split}.{change}" for split in splits for change in ("seed=0", "duration_s=5")]
    cache = f"trainer.cache={tmp_path}"
    config = composed("system=vinet", "trainer=smoke", "trainer.settling=null", *small, *recordings, cache)
    choices = {"frontend": "pair_encoder", "fuser": "vinet"}
    provide_weights(config, choices, build_pipeline(config, choices), build(config, "dataset", Dataset), shown=False)
    assert Path(config.fuser.weights).is_file()
    assert Path(config.fuser.weights).parent == Path(config.frontend.weights).parent


def test_a_frozen_encoder_encodes_a_pair_once(tmp_path):
    front = parts()["frontend"]
    front.net.eval().requires_grad_(False)
    batch = collate([cut_window(small("some"), start, 4) for start in (0, 2)]).as_float()
    expected = PairEncoder.forward_batch(front, batch, {})["embedding"]
    asked = []
    encoder = front.net.get_submodule("encoder")
    encoder.register_forward_hook(lambda module, args, output: asked.append(len(args[0])))
    assert torch.equal(front.forward_batch(batch, {})["embedding"], expected) and not asked
    one = front.forward_batch(collate([cut_window(small("some"), 1, 6)]).as_float(), {})["embedding"]
    assert torch.equal(one[0, 1:5], expected[1]) and asked == [1]
    front.net.requires_grad_(True)
    torch.testing.assert_close(front.forward_batch(batch, {})["embedding"], expected)
    # Other weights, other answers.
    front.net.requires_grad_(False)
    encoder.join.bias.add_(0.5)
    assert not torch.allclose(front.forward_batch(batch, {})["embedding"], expected, atol=1e-2)
