"""The group experiment=: KITTI as in the papers, without the leak of one, and what is tested left out of training."""

import pytest

from composing import composed, offered
from shared_data import shared_data
from vioframe.build import build
from vioframe.data.recording import Dataset
from vioframe.data.windows import check_split
from vioframe.errors import DataError

SPLITS = {
    "tsvo_kitti": ("00 01 02 04 06 08", "05 07 09 10"),
    "tsvo_kitti_community": ("00 01 02 04 06 08 09", "05 07 10"),
}


@pytest.fixture
def root(tmp_path):
    """Folders of the benchmark, colour images alone, which is as far as a data set looks before it opens one."""
    for number in range(22):
        (tmp_path / "sequences" / f"{number:02d}" / "image_2").mkdir(parents=True)
    return tmp_path


def numbers(dataset):
    return [name.partition(".")[0] for name in dataset.sequences]


LEFT_OUT = {
    "fusion_kitti": ("kitti", "dataset.root", "dataset.sequence", ("01", "02", "04", "06", "07", "08")),
    "fusion_euroc": (
        "euroc_imu_gt",
        "dataset.source.root",
        "dataset.source.sequence",
        ("MH_01_easy", "MH_04_difficult", "V1_01_easy", "V1_02_medium", "V2_01_easy"),
    ),
}


def test_every_experiment_is_known_here():
    assert set(offered("experiment")) == {*SPLITS, *LEFT_OUT}


@pytest.mark.parametrize("name", LEFT_OUT)
def test_what_is_tested_is_neither_learned_from_nor_validated_with(name):
    folder, root, key, sequences = LEFT_OUT[name]
    place = shared_data(folder)
    for tested in sequences:
        config = composed(f"experiment={name}", f"{root}={place}", f"{key}=['{tested}']")
        parts = {split: build(config, f"training_data.{split}", Dataset) for split in ("train", "validation")}
        seen = {each.partition(".")[0] for part in parts.values() for each in part.sequences}
        (own,) = build(config, "dataset", Dataset).sequences
        assert own.partition(".")[0] not in seen
        assert len(seen) == len(sequences) - 1
        check_split(parts["train"].sequences, parts["validation"].sequences)


@pytest.mark.parametrize("name", SPLITS)
def test_split_is_the_one_that_was_published_and_leaks_nothing(name, root):
    config = composed(f"experiment={name}", f"dataset.root={root}")
    trained, tested = (each.split() for each in SPLITS[name])
    parts = {split: build(config, f"training_data.{split}", Dataset) for split in ("train", "validation")}
    assert numbers(parts["train"]) == numbers(parts["validation"]) == trained
    check_split(parts["train"].sequences, parts["validation"].sequences)
    assert config.training_data.train.stretch == [0.0, 0.9] and config.training_data.validation.stretch == [0.9, 1.0]
    test = build(config, "dataset", Dataset)
    assert list(test.sequences) == tested
    assert not set(tested) & set(trained)
    assert sorted({*tested, *trained}) == [f"{number:02d}" for number in range(11) if number != 3]


@pytest.mark.parametrize("name", SPLITS)
def test_parts_are_those_of_the_paper(name, root):
    config = composed(f"experiment={name}", f"dataset.root={root}")
    assert (config.vo.backbone.name, config.vo.stack, config.vo.rotation) == ("resnet50", 10, "euler")
    assert list(config.trainer.size_px) == list(config.vo.size_px) == list(config.frontend.size_px) == [512, 256]
    assert (config.vo.log_variance_translation, config.vo.log_variance_rotation) == (0.0, -3.0)
    assert (config.trainer.optimizer, config.trainer.batch_size, config.trainer.weight_decay) == ("adam", 16, 0.005)
    assert "Tvnet" in config.frontend._target_ and "VoOnly" in config.fuser._target_ and not config.integrator
    for node in (config.dataset, config.training_data.train, config.training_data.validation):
        assert (node.root, node.color, node.imu, node.cameras) == (str(root), True, "none", 1)


def test_one_option_reaches_test_and_training(root):
    config = composed(
        "experiment=tsvo_kitti",
        f"dataset.root={root}",
        "dataset.color=false",
        "training_data.sequence=6",
        "training_data.split_at=0.7",
        "trainer=smoke",
    )
    assert not config.training_data.train.color and not config.training_data.validation.color
    assert config.training_data.train.sequence == config.training_data.validation.sequence == 6
    assert config.training_data.train.stretch[1] == config.training_data.validation.stretch[0] == 0.7
    assert config.trainer.max_epochs == 2
    with pytest.raises(DataError, match=r"lacks sequences/06/image_0, .*dataset.color=true dataset.sequence=\[6\]"):
        build(config, "training_data.train", Dataset)


def test_all_that_is_missing_is_named_at_once(root):
    for number in ("01", "04"):
        (root / "sequences" / number / "image_2").rmdir()
    config = composed("experiment=tsvo_kitti", f"dataset.root={root}")
    with pytest.raises(DataError, match=r"lacks sequences/01/image_2, sequences/04/image_2, .*=\[0,2,6,8\]") as told:
        build(config, "training_data.train", Dataset)
    assert "\n" not in str(told.value)
