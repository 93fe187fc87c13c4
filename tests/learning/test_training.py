"""The loop: it learns, it repeats itself, it goes on after a kill, and it stops when it should."""

import csv
import json
import signal
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the extra learn")
pytest.importorskip("lightning", reason="needs the extra learn")

import torch

from learned_parts import TinyVo, motion_of, options
from learned_scenes import stored
from vioframe.errors import ConfigError, DataError
from vioframe.learning.seeding import seed_everything
from vioframe.learning.training import Split, train_parts
from vioframe.learning.weights import load_weights
from vioframe.tracking import NullTracker


class Recorder(NullTracker):
    def __init__(self, at=lambda step: None):
        self.rows = []
        self._at = at

    def log_metrics(self, metrics, step=None):
        self.rows.append(dict(metrics))
        self._at(step)


def run(folder, part=None, tracker=None, **changes):
    chosen = options(folder, **changes)
    seed_everything(chosen.seed)
    parts = part if isinstance(part, dict) else {"vo": part or TinyVo()}
    split = Split(sequences=(stored(),), hashes=("a",))
    other = Split(sequences=(stored(name="validation"),), hashes=("b",))
    return train_parts(
        parts, split, other, chosen, folder=folder, tracker=tracker or NullTracker(), about={}, shown=False
    )


def curve_of(folder):
    with (folder / "curve.csv").open() as file:
        rows = [{name: value for name, value in row.items() if name != "images_per_s"} for row in csv.DictReader(file)]
    return [{name: float(value) for name, value in row.items()} for row in rows]


def test_one_batch_is_overfitted(tmp_path):
    seed_everything(0)
    # All twelve windows of the scene are in every batch, two hundred times.
    changes = {"epoch_windows": 240, "batch_size": 12, "schedule": "cosine", "weight_decay": 0.0, "validate_every": 10}
    untrained = run(tmp_path / "before", TinyVo(dropout=0.0), max_epochs=1, epoch_windows=12, batch_size=12)
    trained = run(tmp_path, TinyVo(dropout=0.0), max_epochs=10, **changes)
    assert trained.curve[-1]["train/loss"] < 0.01 * untrained.curve[0]["train/loss"]
    assert trained.score.t_rel_percent < 0.2 * trained.reference.t_rel_percent


def test_the_same_seed_gives_the_same_curve_with_and_without_workers(tmp_path):
    changes = {"augmentation": {"reverse": 0.5, "salt_pepper": 0.5, "photometric": 0.5}}
    run(tmp_path / "a", **changes)
    run(tmp_path / "b", workers=2, **changes)
    run(tmp_path / "c", seed=1, **changes)
    assert curve_of(tmp_path / "a") == curve_of(tmp_path / "b")
    assert curve_of(tmp_path / "a") != curve_of(tmp_path / "c")


@pytest.mark.parametrize("stop", ["between", "within"])
def test_a_killed_run_that_is_resumed_has_the_same_curve(tmp_path, stop):
    changes = {"max_epochs": 5, "epoch_windows": 7, "schedule": "cosine", "augmentation": {"reverse": 0.5, "blur": 0.5}}
    run(tmp_path / "whole", **changes)

    class Killed(RuntimeError):
        pass

    def kill(step):
        if step == 2 and stop == "between":
            raise Killed

    seed_everything(0)
    part = TinyVo()
    if stop == "within":
        steps = []

        def count(*_):
            steps.append(1)
            if len(steps) == 8:
                raise Killed

        part.net.register_forward_pre_hook(lambda module, inputs: count() if module.training else None)
    with pytest.raises(Killed):
        run(tmp_path / "cut", part, tracker=Recorder(kill), **changes)
    resume = str(tmp_path / "cut" / "resume.ckpt")
    run(tmp_path / "cut", seed=0, resume=resume, **changes)
    whole, cut = curve_of(tmp_path / "whole"), curve_of(tmp_path / "cut")
    assert [row["epoch"] for row in cut] == [0, 1, 2, 3, 4]
    for one, two in zip(whole, cut, strict=True):
        assert one == pytest.approx(two, rel=1e-3)


def test_ctrl_c_is_handed_on_and_the_handler_restored(tmp_path):
    before = signal.getsignal(signal.SIGINT)

    def interrupt(step):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, tracker=Recorder(interrupt))
    assert signal.getsignal(signal.SIGINT) is before
    assert list((tmp_path / "weights").glob("*.safetensors"))


def test_best_weights_are_kept_loaded_and_described(tmp_path):
    part = TinyVo()
    trained = run(tmp_path, part, max_epochs=4, top_k=2)
    files = sorted((tmp_path / "weights").glob("*.safetensors"))
    assert len(files) == 2
    ranks = {row["epoch"]: row["validation/relative_to_reference"] for row in trained.curve}
    kept = {int(path.stem[-4:]) for path in files}
    assert kept == set(sorted(ranks, key=ranks.get)[:2])
    card = json.loads(trained.weights["vo"].with_suffix(".json").read_text())
    assert card["architecture"] == dict(part.architecture)
    assert card["data"]["training"] == [{"name": "scene", "images": len(stored()), "sha256": "a"}]
    assert card["validation"]["t_rel_percent"] == trained.score.t_rel_percent
    assert {"split_sha256", "code", "licence", "trainer", "reference"} <= set(card)
    assert card["validation"]["protocol"]
    twin = TinyVo()
    load_weights(trained.weights["vo"], twin, "vo.weights")
    for one, two in zip(part.net.parameters(), twin.net.parameters(), strict=True):
        assert torch.equal(one, two)


def test_divergence_stops_with_a_sentence_and_keeps_what_was_good(tmp_path):
    class Exploding(TinyVo):
        steps = 0

        def loss(self, outputs, batch):
            terms = super().loss(outputs, batch)
            self.steps += torch.is_grad_enabled()
            return {"loss": terms["loss"] * (float("nan") if self.steps > 7 else 1.0)}

    with pytest.raises(ConfigError, match=r"trainer.learning_rate=0.003 makes the training diverge.*weights .*kept"):
        run(tmp_path, Exploding(), max_epochs=10)
    weights = list((tmp_path / "weights").glob("*.safetensors"))
    assert weights
    load_weights(weights[0], TinyVo(), "vo.weights")


def test_a_wild_learning_rate_is_told_by_its_key(tmp_path):
    with pytest.raises(ConfigError, match=r"trainer.learning_rate=1000 makes the training diverge"):
        run(tmp_path, max_epochs=30, learning_rate=1000.0, gradient_clip=0.0)


def test_a_frozen_part_stays_as_it_was_and_feeds_the_next(tmp_path):
    class Last(TinyVo):
        def forward_batch(self, batch, upstream):
            assert "tangent" in upstream
            return super().forward_batch(batch, upstream)

    first, last = TinyVo(motion=False), Last()
    before = [parameter.clone() for parameter in first.net.parameters()]
    run(tmp_path, {"frontend": first, "vo": last}, train=["vo"], max_epochs=1)
    assert all(torch.equal(a, b) for a, b in zip(before, first.net.parameters(), strict=True))
    assert not first.net.training
    assert not list((tmp_path / "weights").glob("frontend*"))


def test_a_part_without_weights_takes_part_and_leaves_no_file(tmp_path):
    class Doubled(TinyVo):
        def __init__(self):
            super().__init__()
            self.net = torch.nn.Identity()

        def forward_batch(self, batch, upstream):
            return {"doubled": self.net(2.0 * batch.images)}

        def loss(self, outputs, batch):
            return {}

    with pytest.raises(ConfigError, match=r"trainer.train=\['frontend'\]: these parts have no weights"):
        run(tmp_path, {"frontend": Doubled(), "vo": TinyVo()}, train=["frontend"])
    trained = run(tmp_path, {"frontend": Doubled(), "vo": TinyVo()}, max_epochs=1)
    assert (tmp_path / "validation.png").stat().st_size > 1000
    assert set(trained.weights) == {"vo"}
    assert not list((tmp_path / "weights").glob("frontend*"))


def test_several_pairs_are_answered_by_one_window(tmp_path):
    trained = run(tmp_path, TinyVo(context=3), pairs=5, max_epochs=1)
    assert np.isfinite(trained.score.t_rel_percent)


@pytest.mark.parametrize("train", [["fuser"], []])
def test_a_slot_without_a_net_cannot_be_trained(tmp_path, train):
    with pytest.raises(ConfigError, match=r"trainer.train=.* vo"):
        run(tmp_path, train=train)


def test_a_part_that_predicts_no_motion_cannot_be_validated(tmp_path):
    with pytest.raises(ConfigError, match="nothing to validate"):
        run(tmp_path, TinyVo(motion=False), max_epochs=1)


def test_motions_of_half_a_precision_are_refused(tmp_path):
    with pytest.raises(DataError, match=r"T_prev_cur comes as torch.bfloat16.*float32"):
        run(tmp_path, max_epochs=1, precision="bf16")


def test_mixed_precision_trains_where_motions_are_whole(tmp_path):
    class Whole(TinyVo):
        def forward_batch(self, batch, upstream):
            self.net_dtype = self.net[0](torch.zeros(1, 2, 8, 8)).dtype
            outputs = super().forward_batch(batch, upstream)
            with torch.autocast("cpu", enabled=False):
                return {"T_prev_cur": motion_of(outputs["tangent"].float()), "tangent": outputs["tangent"].float()}

    part = Whole()
    assert np.isfinite(run(tmp_path, part, max_epochs=1, precision="bf16").score.t_rel_percent)
    assert part.net_dtype == torch.bfloat16


def test_too_short_validation_is_told_before_the_first_step(tmp_path):
    with pytest.raises(DataError, match=r"too short to be scored .*trainer.segment_lengths_m"):
        run(tmp_path, segment_lengths_m=[100.0])


def test_one_image_is_told(tmp_path):
    short = stored()
    short = replace(
        short,
        images=short.images[:1],
        stamps_ns=short.stamps_ns[:1],
        T_world_cam=short.T_world_cam[:1],
        known=short.known[:1],
    )
    chosen = options(tmp_path)
    one = Split(sequences=(short,), hashes=("a",))
    with pytest.raises(DataError, match="scene has 1 images"):
        train_parts({"vo": TinyVo()}, one, one, chosen, folder=tmp_path, tracker=NullTracker(), about={}, shown=False)


@pytest.mark.parametrize("kind", ["missing", "truncated", "hostile", "other"])
def test_a_resume_file_that_does_not_fit_is_refused_in_a_sentence(tmp_path, kind):
    path = tmp_path / "resume.ckpt"
    if kind == "truncated":
        run(tmp_path, max_epochs=1)
        path.write_bytes(path.read_bytes()[:-2000])
    elif kind == "hostile":
        torch.save({"state_dict": Hostile()}, path)
    elif kind == "other":
        run(tmp_path, TinyVo(width=4), max_epochs=1)
    with pytest.raises(DataError, match="trainer.resume="):
        run(tmp_path / "again", resume=str(path), max_epochs=2)


class Hostile:
    def __reduce__(self):
        return (print, ("executed",))
