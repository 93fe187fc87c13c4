"""Both parts of VINet trained together by the loop of the core, and what comes out used."""

import dataclasses

import cv2
import numpy as np
import pytest

pytest.importorskip("torch", reason="needs torch: pip install 'vioframe[learn]'")
pytest.importorskip("lightning", reason="needs lightning: pip install 'vioframe[learn]'")

from learned_parts import options
from learned_scenes import stored
from vioframe.learning.seeding import seed_everything
from vioframe.learning.training import Split, train_parts
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


def test_both_parts_are_trained_together_and_keep_their_weights(tmp_path):
    chosen = options(
        tmp_path,
        max_epochs=2,
        epoch_windows=8,
        size_px=list(SIZE),
        augmentation={"reverse": 0.5, "mirror": 0.5},
    )
    seed_everything(0)
    splits = (Split(sequences=(small(name),), hashes=(name,)) for name in ("training", "validation"))
    trained = train_parts(parts(), *splits, chosen, folder=tmp_path, tracker=NullTracker(), about={}, shown=False)
    assert set(trained.weights) == {"frontend", "fuser"}
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
