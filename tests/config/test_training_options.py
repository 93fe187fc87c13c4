"""The groups of task=train: every option composes, and every constructor argument is in its YAML."""

import inspect

import pytest

from composing import composed, offered
from vioframe.build import build, resolve_class
from vioframe.data.recording import Dataset
from vioframe.data.windows import check_split
from vioframe.errors import ConfigError
from vioframe.learning.options import TrainerOptions


@pytest.mark.parametrize("name", [name for name in offered("trainer") if name != "none"])
def test_every_trainer_builds_and_shows_all_its_options(name):
    config = composed("task=train", f"trainer={name}")
    options = build(config, "trainer", TrainerOptions, name)
    assert options.settings()["size_px"] == list(config.trainer.size_px)
    for node in (config.trainer, config.trainer.augmentation):
        cls = resolve_class(node["_target_"], "trainer")
        assert set(inspect.signature(cls).parameters) == set(node) - {"_target_"}


# Those on disk have a test of their own, in test_experiments.py.
@pytest.mark.parametrize("name", [name for name in offered("training_data") if name.startswith("simulated")])
def test_every_training_set_has_two_splits_that_share_nothing_with_each_other_or_the_test(name):
    config = composed("task=train", f"training_data={name}")
    splits = [build(config, f"training_data.{split}", Dataset) for split in ("train", "validation")]
    check_split(*(dataset.sequences for dataset in splits))
    family = str(splits[0].sequences[0]).partition("-")[0]
    test = build(composed(f"dataset.sequence={family}", "dataset.seed=[0,1,2]"), "dataset", Dataset)
    for dataset in splits:
        check_split(dataset.sequences, test.sequences)


def test_other_tasks_carry_no_training_options():
    assert not composed().get("trainer")
    assert not composed().get("training_data")


def test_impossible_option_is_told_by_its_key():
    with pytest.raises(ConfigError, match=r"trainer.augmentation.mirror must lie in \[0, 1\], got 2"):
        build(composed("task=train", "trainer.augmentation.mirror=2"), "trainer", TrainerOptions)
