"""What a VO answers for the recordings of a training: asked once, as a stream would be, and learned from."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the extra learn")
pytest.importorskip("lightning", reason="needs the extra learn")

import torch

from composing import composed
from learned_parts import TinyVo, motion_of, options
from learned_scenes import SceneDataset, SceneRecording, stored
from vioframe.build import build, build_pipeline
from vioframe.data.answers import read_answers, stack_answers, write_answers
from vioframe.data.recording import Dataset
from vioframe.data.remaining import RemainingSequences
from vioframe.data.sequence_cache import SequenceCache, read_stored
from vioframe.errors import ConfigError, DataError
from vioframe.geometry import se3
from vioframe.learning.answers import LearnedAnswers
from vioframe.learning.training import Split, train_parts
from vioframe.tasks.answers import _Store, _stream, _StreamJob, read_answered_splits
from vioframe.tasks.decoding import DecodingJob
from vioframe.tasks.fitting import trainer_options
from vioframe.tasks.provision import provide_weights, untrained_slots
from vioframe.tasks.train import _learns_from_answers
from vioframe.tracking import NullTracker
from vioframe.types import RelativePose

SHORT = [
    *(f"training_data.{split}.{change}" for split in ("train", "validation") for change in ("duration_s=5", "seed=0")),
]
CHOICES = {"vo": "simulated", "trainer": "smoke", "training_data": "simulated_car", "fuser": "lstm"}


class Streaming(TinyVo):
    """Answers in a stream what it answers in a batch, unless it is told to remember."""

    def __init__(self, remembers: bool = False) -> None:
        super().__init__(context=1, dropout=0.0)
        self.remembers = remembers

    def setup(self, rig):
        self.seen = 0

    def estimate(self, previous, current):
        images = [torch.from_numpy(frame.frame.images[0]).float() / 255.0 for frame in (previous, current)]
        grey = 4.0 * (torch.stack(images)[None] - 60 / 255)
        self.seen += 1
        with torch.inference_mode():
            tangent = 0.1 * self.net.eval()(grey) + 1e-2 * self.remembers * (self.seen > 2)
        return RelativePose(T_prev_cur=motion_of(tangent)[0].double().numpy())


def longer():
    """The scene five times over, with a hole in the middle."""
    scene = stored()
    count = 5 * len(scene)
    stamps = scene.stamps_ns[0] + np.arange(count) * int(scene.stamps_ns[1] - scene.stamps_ns[0])
    stamps[40:] += 10**9
    order = np.arange(count) % len(scene)
    return replace(
        scene,
        images=scene.images[order],
        stamps_ns=stamps,
        T_world_cam=scene.T_world_cam[order],
        known=np.zeros(count, dtype=np.bool_),
        imu=None,
    )


def test_batches_answer_as_a_stream_and_nothing_is_answered_across_a_hole():
    part = Streaming()
    sequence = longer()
    asked = LearnedAnswers(None, part, batch_size=2)
    answers = asked.answer(sequence)
    assert asked.in_batches
    assert answers.valid.sum() == len(sequence) - 2
    assert not answers.valid[39]
    stream = LearnedAnswers(None, part, batch_size=2)
    stream.in_batches = False
    np.testing.assert_allclose(answers.T_prev_cur, stream.answer(sequence).T_prev_cur, atol=1e-6)


def test_a_part_that_remembers_is_asked_in_a_stream():
    asked = LearnedAnswers(None, Streaming(remembers=True), batch_size=2)
    answers = asked.answer(longer())
    assert not asked.in_batches
    assert answers.valid.sum() == len(longer()) - 2


def test_answers_are_kept_whole_and_damage_is_told(tmp_path):
    scene = stored()
    motions, stamps = scene.motions(), scene.stamps_ns.tolist()
    poses = {
        pair: RelativePose(T_prev_cur=T, covariance=np.eye(6))
        for pair, T in zip(pairwise(stamps), motions, strict=True)
    }
    lost = (stamps[3], stamps[4])
    poses[lost] = RelativePose.invalid()
    del poses[(stamps[6], stamps[7])]
    path = tmp_path / "new" / "answers.npz"
    write_answers(path, stack_answers(scene.stamps_ns, poses))
    answers = read_answers(path)
    assert np.flatnonzero(~answers.valid).tolist() == [3, 6]
    np.testing.assert_allclose(answers.T_prev_cur[answers.valid], motions[answers.valid], atol=1e-12)
    np.testing.assert_array_equal(answers.T_prev_cur[3], np.eye(4))
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(DataError, match="is damaged"):
        read_answers(path)


def test_drawn_answers_are_others_each_time_and_asked_once(tmp_path, monkeypatch):
    config = composed(
        "vo=simulated", "trainer=smoke", "training_data=simulated_car", f"trainer.cache={tmp_path}", *SHORT,
        "training_data.draws=2", "vo.rotation_noise=0.01", "fuser=vo_only", "integrator=none",
    )  # fmt: skip
    chosen = trainer_options(config, CHOICES, answers=True)
    train, validation = read_answered_splits(config, chosen, CHOICES, shown=False)
    assert [one.name for one in train.sequences] == ["car-20000.draw0", "car-20000.draw1"]
    assert len(set(train.hashes + validation.hashes)) == 4
    errors = [
        se3.log(se3.inverse(one.motions()) @ one.vo.T_prev_cur) for one in (*train.sequences, *validation.sequences)
    ]
    for one, other in pairwise(errors):
        assert abs(np.corrcoef(one[:, 0], other[:, 0])[0, 1]) < 0.5
        assert one[:, :3].std() == pytest.approx(0.01 * np.sqrt(0.1), rel=0.2)
    assert train.sequences[0].images.shape == (len(train.sequences[0]), 0, 0, 1)

    def refuse(*_):
        raise AssertionError("asked again")

    monkeypatch.setattr("vioframe.tasks.answers._draw", refuse)
    again, _ = read_answered_splits(config, chosen, CHOICES, shown=False)
    assert again.hashes == train.hashes


def test_other_parts_are_streamed_and_asked_again_only_for_other_weights(tmp_path, monkeypatch):
    monkeypatch.setattr(DecodingJob, "open", lambda job: SceneRecording())
    monkeypatch.setattr("vioframe.build.TRUSTED_LIBRARIES", ("learned_scenes",))
    data = DecodingJob(
        data={}, split="train", choice="", name="scene", source="scene",
        cache=SequenceCache(tmp_path / "recordings", size_px=(32, 24), channels=1, images=False),
    )  # fmt: skip
    weights = tmp_path / "weights"
    weights.write_bytes(b"one")
    parts = {
        "synchronizer": {"_target_": "vioframe_sync.InterpolateSynchronizer"},
        "vo": {"_target_": "learned_scenes.Truthful", "weights": str(weights)},
    }
    job = _StreamJob(decoding=data, parts=parts, choices={}, store=_Store(tmp_path / "answers", "truthful"))
    stored_in, path = _stream(job)
    sequence, _ = read_stored(stored_in)
    answers = read_answers(path)
    assert answers.valid.all()
    np.testing.assert_allclose(answers.T_prev_cur, sequence.motions(), atol=1e-9)
    # What another run has stored meanwhile is streamed all the same.
    path.unlink()
    np.testing.assert_array_equal(read_answers(_stream(job)[1]).T_prev_cur, answers.T_prev_cur)
    weights.write_bytes(b"other")
    assert _stream(job)[1] != path


class Trusting:
    """A fuser that scales what the VO answered; it learns one number."""

    learns_from = "answers"
    context_pairs = 1
    training_pairs = 4
    needs_training = True

    def __init__(self):
        self.net = torch.nn.Linear(1, 1, bias=False)
        self.windows = set()

    @property
    def architecture(self):
        return {"part": "trusting"}

    def forward_batch(self, batch, upstream):
        self.windows.add(batch.pairs)
        assert batch.images.shape[-2:] == (0, 0)
        assert upstream["valid"].shape == upstream["T_prev_cur"].shape[:2]
        T = upstream["T_prev_cur"]
        scaled = torch.cat([T[..., :3], self.net(T[..., 3:])], dim=-1)
        return {"T_prev_cur": torch.cat([scaled[..., :3, :], T[..., 3:, :]], dim=-2)}

    def loss(self, outputs, batch):
        return {"loss": 1e3 * (outputs["T_prev_cur"] - batch.T_prev_cur).square().mean()}


def test_a_fuser_learns_from_answers_and_is_held_against_the_vo_alone(tmp_path):
    scene = stored()
    scaled = scene.motions()
    scaled[:, :3, 3] *= 2.0
    pairs = zip(pairwise(scene.stamps_ns.tolist()), scaled, strict=True)
    answers = stack_answers(scene.stamps_ns, {pair: RelativePose(T_prev_cur=T) for pair, T in pairs})
    blind = replace(scene, vo=answers, images=np.zeros((len(scene), 0, 0, 1), dtype=np.uint8))
    splits = [Split(sequences=(replace(blind, name=name),), hashes=(name,)) for name in ("one", "other")]
    part = Trusting()
    trained = train_parts(
        {"fuser": part},
        *splits,
        options(tmp_path, max_epochs=20, learning_rate=0.1),
        folder=tmp_path,
        tracker=NullTracker(),
        about={},
        shown=False,
    )
    assert trained.beside == "the VO alone"
    assert trained.reference.t_rel_percent == pytest.approx(100.0, rel=0.15)
    assert part.net.weight.item() == pytest.approx(0.5, abs=0.05)
    assert trained.score.t_rel_percent < 20.0
    assert min(part.windows) == 4


def test_both_stages_are_provided_and_the_first_is_shared(tmp_path):
    small = [
        "trainer=smoke", "training_data=simulated_car", "dataset=simulated_car", "trainer.epoch_windows=4",
        "trainer.fusion.epoch_windows=4", "trainer.fusion.pairs=12", "vo.width=0.03", "vo.hidden=8", "vo.window=2",
        f"trainer.cache={tmp_path}", *SHORT,
    ]  # fmt: skip
    found = []
    for fuser in (["fuser=vo_only", "integrator=none"], ["fuser=lstm", "fuser.residual.channels=4", "fuser.frames=8"]):
        config = composed(*fuser, "vo=deepvo", *small)
        choices = {**CHOICES, "vo": "deepvo"}
        pipeline = build_pipeline(config, choices)
        provide_weights(config, choices, pipeline, build(config, "dataset", Dataset), shown=False)
        assert untrained_slots(build_pipeline(config, choices)) == []
        found.append(config)
    assert found[0].vo.weights == found[1].vo.weights
    assert "lstm-" in found[1].fuser.weights
    assert len(list((tmp_path / "answers").iterdir())) == 2


def test_training_a_fuser_alone_takes_a_vo_that_knows_its_answers(tmp_path):
    learned = ["fuser=lstm", "vo=deepvo", "trainer=smoke", "training_data=simulated_car"]
    choices = {**CHOICES, "vo": "deepvo"}
    with pytest.raises(ConfigError, match=r"fuser=lstm learns from what vo=deepvo answers, .*trainer.train=\[vo\]"):
        _learns_from_answers(composed(*learned), choices)
    assert not _learns_from_answers(composed(*learned, "trainer.train=[vo]"), choices)
    assert _learns_from_answers(composed(*learned[:1], "vo=simulated", *learned[2:]), CHOICES)


def test_what_is_tested_is_not_learned_from():
    source = SceneDataset([SceneRecording(name) for name in ("01.0-85", "07.0-85", "10.0-85")])
    assert RemainingSequences(source=source, leave_out=7).sequences == ["01.0-85", "10.0-85"]
    assert RemainingSequences(source=source, leave_out=["01", 10], skip_last=0).sequences == ["07.0-85"]
    assert RemainingSequences(source=source, skip_last=1).sequences == ["01.0-85", "07.0-85"]
    assert RemainingSequences(source=source, leave_out="10", only_last=1).sequences == ["07.0-85"]
    with pytest.raises(DataError, match="no recording remains to learn from: of 01.0-85, 07.0-85, 10.0-85"):
        RemainingSequences(source=source, leave_out=[1, 7], skip_last=1)
