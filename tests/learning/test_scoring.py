"""Scores of predicted motions against what is known of them exactly."""

from dataclasses import replace

import numpy as np
import pytest

from learned_scenes import stored
from vioframe.errors import DataError
from vioframe.geometry import se3
from vioframe.learning.scoring import Score, chain, mean_motion, score_motions


def score(sequence, motions, answered=None, lengths=(0.2,)):
    answered = np.ones(len(sequence) - 1, dtype=bool) if answered is None else answered
    return score_motions([sequence], [motions], [answered], lengths_m=lengths, step=1)


def test_truth_scores_nothing():
    sequence = stored()
    exact = score(sequence, sequence.motions())
    assert exact.t_rel_percent < 1e-9
    assert exact.r_rel_deg_per_100m < 1e-4
    assert exact.segments > 3


def straight(step_m, frames=60):
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 2, 3] = step_m * np.arange(frames)
    base = stored()
    return replace(
        base,
        images=np.zeros((frames, 8, 8, 1), dtype=np.uint8),
        stamps_ns=np.arange(frames, dtype=np.int64) * 100_000_000,
        T_world_cam=poses,
        known=np.ones(frames, dtype=bool),
    )


def test_a_scale_error_is_t_rel():
    sequence = straight(1.0)
    motions = sequence.motions()
    motions[:, :3, 3] *= 1.05
    found = score(sequence, motions, lengths=(10.0,))
    # The devkit ends a segment at the first frame that is further, here 11 m, and divides by the nominal length.
    assert found.t_rel_percent == pytest.approx(100 * 0.05 * 11 / 10)
    assert found.r_rel_deg_per_100m == pytest.approx(0.0, abs=1e-6)


def test_missing_answers_break_the_chain_instead_of_the_score():
    sequence = straight(1.0)
    motions = sequence.motions()
    answered = np.ones(len(motions), dtype=bool)
    answered[30] = False
    motions[30] = se3.exp(np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]))
    assert score(sequence, motions, answered, (10.0,)).t_rel_percent == pytest.approx(0.0, abs=1e-9)


def test_predictions_that_are_not_finite_score_worst():
    sequence = straight(1.0)
    motions = sequence.motions()
    motions[5] = np.nan
    assert score(sequence, motions, lengths=(10.0,)).t_rel_percent == np.inf


def test_mean_motion_of_a_steady_drive_is_the_motion():
    np.testing.assert_allclose(mean_motion([straight(0.7)]), straight(0.7).motions()[0], atol=1e-12)


def test_chain_of_true_motions_is_the_trajectory():
    sequence = stored()
    np.testing.assert_allclose(chain(sequence.motions(), sequence.T_world_cam[0]), sequence.T_world_cam, atol=1e-9)


def test_ranking_is_relative_to_constant_motion():
    constant = Score(t_rel_percent=20.0, r_rel_deg_per_100m=5.0, segments=3)
    assert constant.relative_to(constant) == 1.0
    assert Score(t_rel_percent=10.0, r_rel_deg_per_100m=5.0, segments=3).relative_to(constant) == 0.75


def test_on_a_straight_road_a_small_rotation_does_not_decide():
    constant = Score(t_rel_percent=20.0, r_rel_deg_per_100m=0.0, segments=3)
    good = Score(t_rel_percent=2.0, r_rel_deg_per_100m=0.1, segments=3)
    bad = Score(t_rel_percent=19.0, r_rel_deg_per_100m=0.0, segments=3)
    assert good.relative_to(constant) < bad.relative_to(constant)


def test_no_segment_is_told():
    sequence = straight(1.0)
    with pytest.raises(DataError, match=r"too short to be scored .*59.0 m"):
        score(sequence, sequence.motions(), lengths=(100.0,))
