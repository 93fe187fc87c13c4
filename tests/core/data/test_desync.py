"""Windows whose sensors are out of step: everything follows the told stamps, but for what the VO saw."""

from dataclasses import replace

import numpy as np
import pytest

from learned_scenes import stored
from vioframe.data.desync import Desynchronisation, joined_answers
from vioframe.data.windows import PairAnswers, cut_window
from vioframe.errors import ConfigError
from vioframe.geometry import se3
from vioframe.geometry.interpolation import interpolate_poses

PAIRS = 6


def answered():
    """A recording whose VO answers the truth, with variances that grow from pair to pair."""
    sequence = stored()
    count = len(sequence) - 1
    answers = PairAnswers(
        T_prev_cur=sequence.motions(),
        covariance=np.eye(6) * np.arange(1, count + 1)[:, None, None],
        valid=np.ones(count, dtype=np.bool_),
    )
    return replace(sequence, vo=answers)


def cut(seed=0, start=2, **options):
    window = Desynchronisation(**options).cut(answered(), start, PAIRS, 3, np.random.default_rng(seed))
    assert window is not None
    return window


def same(one, other):
    for name in ("stamps_ns", "T_prev_cur", "velocity_body", "gravity_body", "images"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=1e-9)
    np.testing.assert_allclose(np.concatenate(one.imu), np.concatenate(other.imu), atol=1e-9)
    np.testing.assert_array_equal(one.vo.T_prev_cur, other.vo.T_prev_cur)


def test_in_step_it_is_the_window_as_it_is():
    assert not Desynchronisation().active
    same(cut(), cut_window(answered(), 2, PAIRS, 3))
    assert cut().recording == 3


def test_truth_and_samples_follow_the_told_stamps_and_answers_do_not():
    sequence, plain = answered(), cut()
    for seed in range(4):
        window = cut(seed, time_offset_s=0.03)
        moved = window.stamps_ns - plain.stamps_ns
        assert len(set(moved.tolist())) == 1
        assert 0 < abs(int(moved[0])) <= 30_000_000
        poses, _ = interpolate_poses(sequence.truth, window.stamps_ns, max_gap_ns=10**9)
        poses = poses @ sequence.camera.T_body_cam
        np.testing.assert_allclose(window.T_prev_cur, se3.inverse(poses[:-1]) @ poses[1:], atol=1e-12)
        np.testing.assert_array_equal(window.vo.T_prev_cur, plain.vo.T_prev_cur)
        np.testing.assert_array_equal(window.images, plain.images)
        for pair, times in enumerate(window.imu_time_s):
            assert times[-1] * 1e9 == pytest.approx(window.stamps_ns[pair + 1] - window.stamps_ns[pair])


def test_jittered_stamps_stay_in_order():
    for seed in range(20):
        window = cut(seed, stamp_jitter_s=0.2)
        assert (np.diff(window.stamps_ns) > 0).all()
    assert len(set((window.stamps_ns - cut().stamps_ns).tolist())) > 1


def test_left_out_images_join_the_pairs_beside_them():
    sequence = answered()
    shorter = set()
    for seed in range(20):
        window = cut(seed, start=1, dropped_frames=0.5)
        assert len(window.images) == PAIRS + 1
        numbers = np.searchsorted(sequence.stamps_ns, window.stamps_ns)
        np.testing.assert_array_equal(sequence.stamps_ns[numbers], window.stamps_ns)
        assert numbers[0] == 1
        np.testing.assert_allclose(window.vo.T_prev_cur, window.T_prev_cur, atol=1e-9)
        shorter.add(int(numbers[-1]))
    assert len(shorter) > 2


def test_near_the_end_fewer_are_left_out():
    start = len(stored()) - PAIRS - 1
    for seed in range(5):
        np.testing.assert_array_equal(cut(seed, start=start, dropped_frames=0.5).stamps_ns, cut(start=start).stamps_ns)


def test_joined_covariance_is_that_of_chained_errors():
    sequence = answered()
    joined = joined_answers(sequence.vo, np.array([2, 5, 6]))
    rng = np.random.default_rng(0)
    draws = 1e-4 * rng.standard_normal((4000, 3, 6)) * np.sqrt([3.0, 4.0, 5.0])[:, None]
    motions = sequence.motions()[2:5] @ se3.exp(draws)
    chained = motions[:, 0] @ motions[:, 1] @ motions[:, 2]
    errors = se3.log(se3.inverse(joined.T_prev_cur[0]) @ chained)
    np.testing.assert_allclose(1e8 * np.cov(errors.T), joined.covariance[0], rtol=0.1, atol=0.8)
    np.testing.assert_array_equal(joined.covariance[1], sequence.vo.covariance[5])


def test_an_answer_that_is_not_valid_spoils_what_it_is_joined_to():
    sequence = answered()
    valid = sequence.vo.valid.copy()
    valid[3] = False
    joined = joined_answers(replace(sequence.vo, valid=valid), np.array([2, 5, 6]))
    assert joined.valid.tolist() == [False, True]


@pytest.mark.parametrize("longest", [0.1, 2.0])
def test_a_hole_takes_samples_away_and_nothing_else(longest):
    plain, fewer, empty = cut(), 0, 0
    for seed in range(20):
        window = cut(seed, imu_gap=1.0, imu_gap_s=longest)
        np.testing.assert_array_equal(window.T_prev_cur, plain.T_prev_cur)
        lengths = np.array([len(times) for times in window.imu_time_s])
        whole = np.array([len(times) for times in plain.imu_time_s])
        assert (lengths <= whole).all()
        fewer += int((lengths < whole).sum())
        empty += int((lengths == 0).sum())
        for times, before in zip(window.imu_time_s, plain.imu_time_s, strict=True):
            if len(times):
                assert times[[0, -1]] == pytest.approx(before[[0, -1]])
    assert fewer
    assert (empty > 0) == (longest > 0.5)


def test_where_the_truth_is_unknown_there_is_no_window():
    sequence = answered()
    truth = sequence.truth
    short = replace(
        truth, stamps_ns=truth.stamps_ns[:5], T_world_body=truth.T_world_body[:5], v_world_body=truth.v_world_body[:5]
    )
    cutting = Desynchronisation(time_offset_s=0.02)
    assert cutting.cut(replace(sequence, truth=short), 2, PAIRS, 0, np.random.default_rng(0)) is None


@pytest.mark.parametrize(
    "wrong", [{"time_offset_s": -1.0}, {"dropped_frames": 0.7}, {"imu_gap": 2.0}, {"stamp_jitter_s": -0.1}]
)
def test_impossible_options_are_refused_by_their_key(wrong):
    with pytest.raises(ConfigError, match=f"trainer.augmentation.sensors.{next(iter(wrong))}"):
        Desynchronisation(**wrong)
