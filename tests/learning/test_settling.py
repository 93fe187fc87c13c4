"""A part that is trained further by itself, on longer windows, while those before it stay as they are."""

import pytest

pytest.importorskip("torch", reason="needs the extra learn")
pytest.importorskip("lightning", reason="needs the extra learn")

import torch

from learned_parts import TinyVo, options
from learned_scenes import stored
from vioframe.data.desync import Desynchronisation
from vioframe.learning.seeding import seed_everything
from vioframe.learning.settling import settling_options
from vioframe.learning.training import Split, train_parts
from vioframe.learning.weights import load_weights
from vioframe.tracking import NullTracker

SETTLING = {"max_epochs": 2, "epoch_windows": 6, "batch_size": 3, "learning_rate": 1e-3, "warmup_steps": 0}


class SettlingVo(TinyVo):
    """Notes the length of the windows that it learns from, and what the part before it then weighs."""

    training_pairs = 3
    settling_pairs = 6

    def __init__(self, before):
        super().__init__(motion=True)
        self.seen = []
        self._before = before

    def forward_batch(self, batch, upstream):
        if self.net.training:
            self.seen.append(
                (batch.pairs, sum(float(weight.detach().sum()) for weight in self._before.net.parameters()))
            )
        return super().forward_batch(batch, upstream)


class Killed(RuntimeError):
    pass


class Killer(NullTracker):
    """Kills the run when so many epochs are done."""

    def __init__(self, epochs):
        self._left = epochs

    def log_metrics(self, metrics, step=None):
        self._left -= 1
        if self._left == 0:
            raise Killed


def run(folder, tracker=None, **changes):
    chosen = options(folder, **{"max_epochs": 2, "epoch_windows": 6, "settling": SETTLING, **changes})
    seed_everything(0)
    first = TinyVo(motion=False)
    parts = {"frontend": first, "vo": SettlingVo(first)}
    splits = [Split(sequences=(stored(name=name),), hashes=(name,)) for name in ("training", "validation")]
    trained = train_parts(
        parts, *splits, chosen, folder=folder, tracker=tracker or NullTracker(), about={}, shown=False
    )
    return parts, trained


def test_it_settles_on_longer_windows_and_leaves_the_others_alone(tmp_path):
    parts, trained = run(tmp_path)
    short = [weights for pairs, weights in parts["vo"].seen if pairs == 3]
    long = [weights for pairs, weights in parts["vo"].seen if pairs == 6]
    assert len(short) + len(long) == len(parts["vo"].seen) and len(set(short)) > 1 and len(set(long)) == 1
    assert trained.weights["frontend"].parent.parent == tmp_path
    assert trained.weights["vo"].parent.parent == tmp_path / "settled"
    assert trained.epochs == len(trained.curve) == 4


def test_a_run_that_is_killed_while_it_settles_goes_on_there(tmp_path):
    whole, _ = run(tmp_path / "whole")
    with pytest.raises(Killed):
        run(tmp_path / "cut", Killer(3))
    cut, trained = run(tmp_path / "cut", resume=str(tmp_path / "cut" / "resume.ckpt"))
    # Only what was left is done again.
    assert {pairs for pairs, _ in cut["vo"].seen} == {6}
    assert trained.epochs == 4
    for name, weight in whole["vo"].net.state_dict().items():
        torch.testing.assert_close(cut["vo"].net.state_dict()[name], weight, rtol=1e-4, atol=1e-6)


def test_it_begins_anew_where_what_it_settled_on_went_on_to_be_trained(tmp_path):
    whole, _ = run(tmp_path / "whole", max_epochs=4)
    _, before = run(tmp_path / "cut")
    (tmp_path / "cut" / "settled" / "weights" / "vo-epoch0009.safetensors").touch()
    cut, after = run(tmp_path / "cut", max_epochs=4, resume=str(tmp_path / "cut" / "resume.ckpt"))
    assert before.weights["frontend"] != after.weights["frontend"]
    assert sum(pairs == 6 for pairs, _ in cut["vo"].seen) == sum(pairs == 6 for pairs, _ in whole["vo"].seen) > 0
    assert after.epochs == 6
    # Nothing is left that settled on other weights.
    assert len(list((tmp_path / "cut" / "settled" / "weights").glob("*.safetensors"))) == 2
    for name, weight in whole["vo"].net.state_dict().items():
        torch.testing.assert_close(cut["vo"].net.state_dict()[name], weight, rtol=1e-4, atol=1e-6)


def test_it_waits_where_time_ended_the_training_before(tmp_path, caplog):
    parts, trained = run(tmp_path, max_epochs=1000, max_minutes=1e-4)
    assert set(trained.weights) == set(parts) and {pairs for pairs, _ in parts["vo"].seen} == {3}
    assert not (tmp_path / "settled").exists()
    assert "trainer.max_minutes=0.0001 ended the training after 1 of trainer.max_epochs=1000 epochs" in caplog.text


def test_what_it_began_with_is_kept_where_it_only_gets_worse(tmp_path):
    parts, trained = run(tmp_path, settling={**SETTLING, "learning_rate": 0.5, "divergence_factor": 1e9})
    assert trained.epochs == len(trained.curve) == 4
    ranks = [row["validation/relative_to_reference"] for row in trained.curve]
    assert min(ranks[2:]) > min(ranks[:2])
    assert trained.weights["vo"].parent.parent == tmp_path
    first = SettlingVo(TinyVo())
    load_weights(trained.weights["vo"], first, "vo.weights")
    for name, weight in first.net.state_dict().items():
        assert torch.equal(parts["vo"].net.state_dict()[name], weight)


def test_sensors_stay_as_far_out_of_step_and_images_are_only_mirrored(tmp_path):
    sensors = Desynchronisation(time_offset_s=0.05, stamp_jitter_s=0.01, dropped_frames=0.1, imu_gap=0.5, imu_gap_s=0.3)
    changes = {"sensors": sensors, "mirror": 0.5, "reverse": 0.5, "blur": 0.5, "salt_pepper": 0.5, "photometric": 0.5}
    chosen = options(tmp_path, settling=SETTLING, augmentation=changes)
    scene = (stored(),)
    further = settling_options({"vo": SettlingVo(TinyVo())}, ["vo"], scene, scene, chosen, pairs=3)
    assert further.augmentation.sensors == sensors
    settings = further.augmentation.settings()
    assert settings["mirror"] == 0.5
    assert all(settings[name] == 0.0 for name in ("reverse", "blur", "salt_pepper", "photometric"))


@pytest.mark.parametrize(
    ("why", "parts", "changes", "pairs"),
    [
        ("no part wishes it", {"vo": TinyVo()}, {}, 3),
        ("it is switched off", None, {"settling": {}}, 3),
        ("it is switched off", None, {"settling": None}, 3),
        ("no run of images is longer", None, {}, 11),
    ],
)
def test_there_is_no_such_stage(tmp_path, why, parts, changes, pairs):
    parts = parts or {"vo": SettlingVo(TinyVo())}
    chosen = options(tmp_path, **{"settling": SETTLING, **changes})
    scene = (stored(),)
    assert settling_options(parts, ["vo"], scene, scene, chosen, pairs=pairs) is None
