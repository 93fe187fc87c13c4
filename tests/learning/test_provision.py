"""An experiment whose part has no weights trains it first, once."""

import csv
import json

import pytest

pytest.importorskip("torch", reason="needs the extra learn")
pytest.importorskip("lightning", reason="needs the extra learn")

from composing import composed
from vioframe.build import build, build_pipeline
from vioframe.data.recording import Dataset
from vioframe.errors import ConfigError
from vioframe.learning.training import train_parts
from vioframe.tasks.bearing import bearing
from vioframe.tasks.provision import provide_weights, untrained_slots
from vioframe.tracking import NullTracker

SMALL = [
    "system=deepvo",
    "trainer=smoke",
    "trainer.epoch_windows=4",
    "vo.width=0.03",
    "vo.hidden=8",
    "vo.window=2",
    *(f"training_data.{split}.{change}" for split in ("train", "validation") for change in ("seed=0", "duration_s=5")),
]
CHOICES = {"vo": "deepvo", "trainer": "smoke", "training_data": "simulated_car"}


@pytest.fixture
def trainings(monkeypatch):
    """Epochs of the training runs that were started, each with the resume file it began from."""
    started = []

    def counted(parts, training, validation, options, **more):
        started.append(options.resume)
        return train_parts(parts, training, validation, options, **more)

    monkeypatch.setattr("vioframe.learning.training.train_parts", counted)
    return started


def provided(tmp_path, *overrides):
    config = composed(*SMALL, f"trainer.cache={tmp_path}", *overrides)
    pipeline = build_pipeline(config, CHOICES)
    assert untrained_slots(pipeline) == ["vo"]
    provide_weights(config, CHOICES, pipeline, build(config, "dataset", Dataset), shown=False)
    return config


def test_weights_are_trained_once_and_found_again_by_what_they_came_from(tmp_path, trainings):
    first = provided(tmp_path)
    assert untrained_slots(build_pipeline(first, CHOICES)) == []
    assert provided(tmp_path, "vo.device=cpu", "dataset.seed=7", "synchronizer=nearest").vo.weights == first.vo.weights
    assert len(trainings) == 1
    # All of these have a bearing on the weights.
    others = [["trainer.seed=1"], ["vo.loss=fixed"], ["training_data.train.seed=1"]]
    found = {first.vo.weights, *(provided(tmp_path, *other).vo.weights for other in others)}
    assert len(found) == len(trainings) == 4
    # One more recording was decoded, and no recording twice.
    assert len(list((tmp_path / "recordings").iterdir())) == 3


def test_an_interrupted_training_goes_on_with_the_same_command(tmp_path, trainings, monkeypatch):
    longer = ["trainer.max_epochs=3"]
    whole = provided(tmp_path / "whole", *longer)

    class Interrupting(NullTracker):
        def log_metrics(self, metrics, step=None):
            if step == 1:
                raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("vioframe.tasks.provision.build", lambda *_: Interrupting())
        with pytest.raises(KeyboardInterrupt):
            provided(tmp_path / "cut", *longer)
    again = provided(tmp_path / "cut", *longer)
    assert trainings[:2] == [None, None]
    assert trainings[2].endswith("resume.ckpt")
    curves = []
    for config in (whole, again):
        folder = config.vo.weights.rpartition("/weights/")[0]
        with open(f"{folder}/curve.csv") as file:
            curves.append([float(row["train/loss"]) for row in csv.DictReader(file)])
    assert len(curves[0]) == 3
    assert curves[1] == pytest.approx(curves[0], rel=1e-5)


@pytest.mark.parametrize(
    ("overrides", "sentence"),
    [
        (
            ["trainer=none", "vo.size_px=[64,32]", "vo.width=0.03"],
            r"vo=deepvo has no weights: give vo.weights=FILE, .* trainer=cpu",
        ),
        ([*SMALL, "trainer.devices=2"], "trainer.devices=2: an experiment trains vo=deepvo in one process"),
        ([*SMALL, "trainer.resume=x"], "trainer.resume=x: an experiment goes on by itself"),
        ([*SMALL, "trainer.train=[frontend]"], r"trainer.train=\['frontend'\] leaves vo without weights"),
        ([*SMALL, "trainer.train=vo"], r"trainer.train must be a list of slots, such as \[vo\]"),
    ],
)
def test_what_cannot_be_trained_is_told(overrides, sentence):
    config = composed("system=deepvo", *overrides)
    pipeline = build_pipeline(config, {"vo": "deepvo"})
    with pytest.raises(ConfigError, match=sentence):
        provide_weights(config, {"vo": "deepvo"}, pipeline, build(config, "dataset", Dataset), shown=False)


def test_weights_to_start_from_count_by_their_content(tmp_path):
    file = tmp_path / "start.safetensors"
    keys = []
    for content in (b"one", b"two", b"one"):
        file.write_bytes(content)
        keys.append(bearing({"weights": None, "backbone": {"weights": str(file)}, "device": "cpu"}))
    assert keys[0] == keys[2] != keys[1]
    assert "device" not in keys[0]


def test_recordings_that_are_learned_from_and_tested_on_are_told(tmp_path, caplog):
    provided(tmp_path)
    assert "tested on" not in caplog.text
    provided(tmp_path, "dataset.split=train", "dataset.seed=[0,1]")
    assert "car-20000 is learned from and tested on" in caplog.text


def test_an_experiment_trains_evaluates_and_tells_what_its_net_weighs(tmp_path, cli):
    command = [*SMALL, f"trainer.cache={tmp_path}/cache", "dataset.duration_s=5", "dataset.seed=0", "tracker=none"]
    first = cli(*command, "hydra.run.dir=one")
    assert first.returncode == 0, first.stdout + first.stderr
    assert "training vo" in first.stdout + first.stderr
    again = cli(*command, "hydra.run.dir=two")
    assert again.returncode == 0, again.stdout + again.stderr
    assert "was trained before" in again.stdout + again.stderr
    one, two = (json.loads((tmp_path / name / "metrics.json").read_text()) for name in ("one", "two"))
    assert one["model"]["parameters"] > 0
    assert one["sequences"][0]["ate_yaw_m"] == pytest.approx(two["sequences"][0]["ate_yaw_m"], rel=1e-6)
