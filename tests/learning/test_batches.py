"""Batches and their order: shapes, padding, and that every window is seen equally often."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the extra learn")
pytest.importorskip("lightning", reason="needs the extra learn")

import torch

from learned_parts import TinyVo, options
from learned_scenes import stored
from vioframe.data.windows import PairAnswers, WindowIndex, cut_window
from vioframe.errors import ConfigError, ShapeError
from vioframe.interfaces import Trainable
from vioframe.learning.batch import collate
from vioframe.learning.datamodule import EpochSampler
from vioframe.learning.schedule import rate_factor


def test_shapes_that_do_not_fit_are_named():
    batch = collate([cut_window(stored(), 0, 2)])
    with pytest.raises(ShapeError, match=r"WindowBatch.T_prev_cur must have shape \(1, 2, 4, 4\), got \(1, 1, 4, 4\)"):
        replace(batch, T_prev_cur=batch.T_prev_cur[:, :1])
    with pytest.raises(ShapeError, match=r"WindowBatch.images"):
        replace(batch, images=batch.images[0])
    with pytest.raises(ShapeError, match=r"uint8 or floating point"):
        replace(batch, images=batch.images.to(torch.int32))


def test_windows_of_different_sizes_make_no_batch():
    small = replace(stored(), images=stored().images[:, ::2, ::2])
    with pytest.raises(ShapeError, match="one shape"):
        collate([cut_window(stored(), 0, 2), cut_window(small, 0, 2)])


def test_batch_holds_what_the_windows_held():
    sequence = stored()
    windows = [cut_window(sequence, start, 2, recording=3) for start in (0, 5)]
    batch = collate(windows).as_float()
    assert batch.images.shape == (2, 3, 1, 240, 320)
    assert batch.images.dtype == torch.float32
    np.testing.assert_allclose(batch.images[1, 2, 0].numpy() * 255.0, sequence.images[7, ..., 0], atol=1e-4)
    np.testing.assert_allclose(batch.T_prev_cur[1].numpy(), sequence.motions()[5:7], atol=1e-6)
    assert batch.stamps_ns[1].tolist() == sequence.stamps_ns[5:8].tolist()
    assert batch.recording.tolist() == [3, 3]
    assert batch.start.tolist() == [0, 5]
    assert batch.to("cpu").as_float().images is batch.images or torch.equal(batch.to("cpu").images, batch.images)


def test_missing_samples_are_masked():
    sequence = stored()
    whole, without = cut_window(sequence, 0, 1), cut_window(replace(sequence, imu=None), 0, 1)
    batch = collate([whole, without])
    assert batch.imu_mask[0].all()
    assert not batch.imu_mask[1].any()
    assert torch.equal(batch.imu[1], torch.zeros_like(batch.imu[1]))
    assert collate([without]).imu.shape == (1, 1, 0, 6)


def test_answers_of_a_vo_travel_with_the_batch():
    sequence = stored()
    answers = PairAnswers(
        T_prev_cur=sequence.motions(),
        covariance=np.tile(np.eye(6), (len(sequence) - 1, 1, 1)),
        valid=np.arange(len(sequence) - 1) % 2 == 0,
    )
    blind = replace(sequence, vo=answers, images=np.zeros((len(sequence), 0, 0, 1), dtype=np.uint8))
    batch = collate([cut_window(blind, start, 3) for start in (0, 2)]).as_float().to("cpu")
    assert batch.images.shape == (2, 4, 1, 0, 0)
    assert batch.vo.valid.tolist() == [[True, False, True]] * 2
    torch.testing.assert_close(batch.vo.T_prev_cur, batch.T_prev_cur)
    assert batch.first().vo.covariance.shape == (1, 3, 6, 6)
    assert batch.velocity_body.shape == batch.gravity_body.shape == (2, 4, 3)
    with pytest.raises(ShapeError, match=r"WindowBatch.vo.valid must have shape \(2, 3\)"):
        replace(batch, vo=replace(batch.vo, valid=batch.vo.valid[:, :1]))
    with pytest.raises(ShapeError, match="answers of a VO, or none"):
        collate([cut_window(blind, 0, 3), cut_window(replace(blind, vo=None), 0, 3)])


def test_a_part_with_a_net_is_trainable_and_another_is_not():
    assert isinstance(TinyVo(), Trainable)
    assert not isinstance(WindowIndex, Trainable)


@pytest.mark.parametrize(("windows", "drawn"), [(10, None), (10, 4), (10, 25), (7, 7)])
def test_every_window_is_drawn_equally_often(windows, drawn):
    sampler = EpochSampler(windows, drawn=drawn, seed=3, shuffle=True)
    seen = Counter()
    epochs = 20
    for epoch in range(epochs):
        sampler.set_epoch(epoch)
        keys = list(sampler)
        assert len(keys) == len(sampler)
        assert {key[0] for key in keys} == {epoch}
        seen.update(key[1] for key in keys)
    assert set(seen) == set(range(windows))
    assert max(seen.values()) - min(seen.values()) <= 1


def test_processes_share_an_epoch():
    whole = EpochSampler(11, drawn=None, seed=3, shuffle=True)
    shares = [EpochSampler(11, drawn=None, seed=3, shuffle=True, rank=rank, world=3) for rank in range(3)]
    for sampler in (whole, *shares):
        sampler.set_epoch(2)
    assert {len(list(share)) for share in shares} == {4}
    assert set().union(*map(list, shares)) == set(whole)


def test_epochs_differ_and_repeat():
    sampler = EpochSampler(50, drawn=None, seed=1, shuffle=True)
    orders = []
    for epoch in (0, 1, 0):
        sampler.set_epoch(epoch)
        orders.append([number for _, number in sampler])
    assert orders[0] != orders[1]
    assert orders[0] == orders[2]


def test_learning_rate_halves_as_in_the_paper(tmp_path):
    factor = rate_factor(
        options(tmp_path, schedule="halving", halve_every=25, max_epochs=100), total_steps=1000, epoch_steps=10
    )
    assert [factor(step) for step in (0, 249, 250, 499, 500, 999)] == [1.0, 1.0, 0.5, 0.5, 0.25, 0.125]


def test_cosine_rises_then_falls_to_zero(tmp_path):
    factor = rate_factor(options(tmp_path, schedule="cosine", warmup_steps=50), total_steps=1000, epoch_steps=10)
    values = [factor(step) for step in range(1001)]
    assert (np.diff(values[:51]) > 0).all()
    assert (np.diff(values[50:]) <= 0).all()
    assert values[50] == 1.0
    assert values[1000] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("batch_size", 0),
        ("learning_rate", -1.0),
        ("schedule", "sometimes"),
        ("seed", -1),
        ("segment_lengths_m", []),
        ("gradient_clip", -1.0),
        ("max_epochs", 1.5),
        ("precision", "8"),
        ("workers", -1),
        ("max_minutes", 0.0),
    ],
)
def test_impossible_options_are_told_by_their_key(tmp_path, key, value):
    with pytest.raises(ConfigError, match=f"trainer.{key}"):
        options(tmp_path, **{key: value})
