"""A part that is trained further by itself, on longer windows, while those before it stay as they are."""

import pytest

pytest.importorskip("torch", reason="needs the extra learn")
pytest.importorskip("lightning", reason="needs the extra learn")

import torch

from learned_parts import TinyVo, options
from learned_scenes import stored
from vioframe.learning.seeding import seed_everything
from vioframe.learning.settling import settling_options
from vioframe.learning.training import Split, train_parts
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
    chosen = options(folder, max_epochs=2, epoch_windows=6, settling=SETTLING, **changes)
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


@pytest.mark.parametrize(
    ("why", "parts", "changes", "pairs"),
    [
        ("no part wishes it", {"vo": TinyVo()}, {}, 3),
        ("it is switched off", None, {"settling": {}}, 3),
        ("no run of images is longer", None, {}, 11),
    ],
)
def test_there_is_no_such_stage(tmp_path, why, parts, changes, pairs):
    parts = parts or {"vo": SettlingVo(TinyVo())}
    chosen = options(tmp_path, **{"settling": SETTLING, **changes})
    scene = (stored(),)
    assert settling_options(parts, ["vo"], scene, scene, chosen, pairs=pairs, folder=tmp_path) is None
