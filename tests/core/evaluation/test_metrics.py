"""Metrics against known errors, evo, the KITTI devkit's published digits, and χ² bounds."""

from dataclasses import replace

import numpy as np
import pytest
from evo.core import metrics as evo_metrics
from evo.core.trajectory import PosePath3D
from scipy import stats

from shared_data import shared_data
from synthetic_runs import drifted, moved, walk
from vioframe.errors import MetricError
from vioframe.evaluation import metrics
from vioframe.evaluation.align import MatchedPoses, Motion, align, associate
from vioframe.evaluation.states import StateColumns
from vioframe.geometry import se3, so3
from vioframe.trajectory_io import read_trajectory
from vioframe.types import Trajectory

LENGTHS = tuple(float(length) for length in range(100, 801, 100))


def noisy(seed: int = 0, duration_s: float = 60.0) -> MatchedPoses:
    truth = walk(duration_s)
    return associate(StateColumns.from_states(drifted(truth, seed)).trajectory(), truth)


def straight(length_m: float, step_m: float, scale: float = 1.0, turn_deg_per_m: float = 0.0) -> MatchedPoses:
    """Truth straight ahead; the estimate scaled, and turned more and more about z without leaving its line."""
    distance = np.arange(0.0, length_m + 1e-9, step_m)
    position = distance[:, None] * np.array([1.0, 0.0, 0.0])
    stamps = np.arange(len(distance)) * 100_000_000
    truth = Trajectory(stamps_ns=stamps, T_world_body=se3.from_parts(np.eye(3), position))
    rotation = so3.rotation_z(np.deg2rad(turn_deg_per_m) * distance)
    estimate = Trajectory(stamps_ns=stamps, T_world_body=se3.from_parts(rotation, scale * position))
    return associate(estimate, truth)


def test_short_paths_are_refused_with_their_length() -> None:
    matched = straight(92.0, 0.5)
    with pytest.raises(MetricError, match=r"no segment of 100 m fits on the 92\.0 m"):
        metrics.segment_errors(matched, LENGTHS, 10)
    with pytest.raises(MetricError, match=r"the path is 92\.0 m long"):
        metrics.relative_error_by_distance(matched, 100.0)
    with pytest.raises(MetricError, match=r"the poses span 18\.4 s"):
        metrics.relative_error_by_time(matched, 20.0)


def test_sparse_poses_are_no_short_segments() -> None:
    with pytest.raises(MetricError, match="too sparse"):
        metrics.relative_error_by_distance(straight(92.0, 5.0), 1.0)


def test_a_known_scale_is_that_percentage() -> None:
    matched = straight(300.0, 0.5, scale=1.02)
    assert metrics.relative_error_by_distance(matched, 10.0).trans_percent == pytest.approx(2.0, abs=1e-9)
    # The devkit's segments end at the first frame beyond their length, and are divided by the length.
    errors = metrics.segment_errors(matched, [100.0], 10)
    assert errors.t_rel_percent == pytest.approx(2.0 * 100.5 / 100.0, abs=1e-9)
    assert metrics.scale_error_percent(1 / 1.02) == pytest.approx(2.0)


def test_a_known_turn_is_that_many_degrees() -> None:
    matched = straight(300.0, 0.5, turn_deg_per_m=0.01)
    assert metrics.relative_error_by_distance(matched, 10.0).rot_deg == pytest.approx(0.1, abs=1e-9)
    assert metrics.segment_errors(matched, [100.0], 10).r_rel_deg_per_100m == pytest.approx(1.005, abs=1e-9)


def test_a_scale_against_the_truth_is_refused() -> None:
    with pytest.raises(MetricError, match="do not correlate"):
        metrics.scale_error_percent(-0.1)


def test_the_choice_of_world_changes_nothing_relative() -> None:
    matched = noisy()
    T = se3.from_parts(so3.exp(np.array([0.3, -0.8, 1.9])), np.array([100.0, 20.0, -3.0]))
    elsewhere = replace(matched, T_estimate=T @ matched.T_estimate)
    for alignment in ("se3", "sim3"):
        ours = metrics.absolute_error(matched, alignment)[0].rmse  # type: ignore[arg-type]
        assert metrics.absolute_error(elsewhere, alignment)[0].rmse == pytest.approx(ours, rel=1e-9)  # type: ignore[arg-type]
    pairs = (
        (metrics.relative_error_by_distance(matched, 10.0), metrics.relative_error_by_distance(elsewhere, 10.0)),
        (metrics.relative_error_by_time(matched, 1.0), metrics.relative_error_by_time(elsewhere, 1.0)),
    )
    for first, second in pairs:
        assert first.trans_m == pytest.approx(second.trans_m, rel=1e-9)
        assert first.rot_deg == pytest.approx(second.rot_deg, rel=1e-9)
    a, b = (metrics.segment_errors(m, [100.0], 10) for m in (matched, elsewhere))
    np.testing.assert_allclose(a.trans, b.trans, rtol=1e-6)
    np.testing.assert_allclose(a.rot, b.rot, rtol=1e-6)


def test_the_yaw_of_the_world_changes_neither_yaw_nor_gravity_error() -> None:
    matched = noisy()
    turned = replace(matched, T_estimate=moved_by_yaw(matched.T_estimate, 2.9))
    np.testing.assert_allclose(metrics.yaw_errors(turned), metrics.yaw_errors(matched), atol=1e-9)
    np.testing.assert_allclose(metrics.gravity_errors(turned), metrics.gravity_errors(matched), atol=1e-9)


def moved_by_yaw(T: np.ndarray, yaw: float) -> np.ndarray:
    return se3.from_parts(so3.rotation_z(yaw), np.array([1.0, 2.0, 3.0])) @ T


def test_gravity_error_is_the_tilt() -> None:
    truth = walk(10.0)
    matched = associate(moved(truth, se3.from_parts(so3.exp(np.array([0.03, 0.0, 0.0])), np.zeros(3))), truth)
    np.testing.assert_allclose(metrics.gravity_errors(matched), 0.03, atol=1e-9)
    assert np.abs(metrics.yaw_errors(matched)).max() < 1e-3


def test_rpe_by_time_equals_evo() -> None:
    matched = noisy(3)
    ours = metrics.relative_error_by_time(matched, 1.0)
    pair = (PosePath3D(poses_se3=list(matched.T_truth)), PosePath3D(poses_se3=list(matched.T_estimate)))
    for relation, value in (
        (evo_metrics.PoseRelation.translation_part, ours.trans_m),
        (evo_metrics.PoseRelation.rotation_angle_deg, ours.rot_deg),
    ):
        rpe = evo_metrics.RPE(relation, delta=20, delta_unit=evo_metrics.Unit.frames, all_pairs=True)
        rpe.process_data(pair)
        assert value == pytest.approx(rpe.get_statistic(evo_metrics.StatisticsType.rmse), rel=1e-9)
        assert ours.pairs == len(rpe.error)


def test_kitti_devkit_digits_of_a_real_estimate() -> None:
    truth = read_trajectory(shared_data("kitti", "poses", "10.txt"))
    estimate = read_trajectory(shared_data("trajectories", "kitti_odom_eval", "10.txt"))
    matched = associate(estimate, truth)
    errors = metrics.segment_errors(matched, LENGTHS, 10, align(matched, "sim3"))
    assert f"{errors.t_rel_percent:.3f}" == "3.298"
    assert f"{errors.r_rel_deg_per_100m:.3f}" == "0.305"
    assert f"{metrics.absolute_error(matched, 'sim3')[0].rmse:.3f}" == "6.630"
    table = errors.by_length()
    assert list(table) == ["100", "200", "300", "400", "500", "600", "700", "800"]
    assert sum(int(entry["segments"]) for entry in table.values()) == len(errors.start)


def test_nees_of_errors_drawn_from_their_covariance_lies_in_its_bounds() -> None:
    random = np.random.default_rng(11)
    count = 3000
    for degrees in (3, 6):
        # Units apart by a million must not matter.
        root = random.normal(size=(degrees, degrees)) * np.logspace(-4, 2, degrees)[:, None]
        covariance = np.repeat((root @ root.T)[None], count, axis=0)
        errors = random.normal(size=(count, degrees)) @ root.T
        nees = metrics.normalised_errors(errors, covariance)
        low, high = stats.chi2.ppf([0.001, 0.999], degrees * count) / (degrees * count)
        assert low < metrics.average_nees(nees, degrees) < high
        assert metrics.average_nees(metrics.normalised_errors(errors, 0.25 * covariance), degrees) == pytest.approx(
            4.0 * metrics.average_nees(nees, degrees)
        )


def test_covariances_that_are_none_count_for_nothing() -> None:
    covariance = np.stack([np.eye(3), np.zeros((3, 3)), np.full((3, 3), np.nan), np.ones((3, 3)), -np.eye(3)])
    nees = metrics.normalised_errors(np.ones((5, 3)), covariance)
    assert nees[0] == pytest.approx(3.0)
    assert np.isnan(nees[1:]).all()
    with pytest.raises(MetricError, match="positive definite"):
        metrics.average_nees(nees[1:], 3)
    with pytest.raises(MetricError, match="positive definite"):
        metrics.average_nees(np.zeros(0), 3)


def test_states_that_drift_as_they_say_are_consistent() -> None:
    """Drift begins at the first state, where worlds are made to meet: sixty seeds, whatever the world."""
    truth = walk(5.0)
    averages: dict[str, list[float]] = {"position": [], "orientation": [], "pose": []}
    for seed in range(60):
        states = StateColumns.from_states(drifted(truth, seed))
        matched = associate(states.trajectory(), truth)
        errors = metrics.state_errors(matched, states, metrics.initial_alignment(matched, states, "rest"))
        for name, (nees, degrees) in errors.nees().items():
            averages[name].append(metrics.average_nees(nees[1:], degrees))
    for name, values in averages.items():
        assert 0.8 < np.mean(values) < 1.25, name


def test_nees_knows_the_world_of_its_covariance() -> None:
    """An elongated covariance turns with the world it is given in."""
    truth = walk(5.0)
    states = StateColumns.from_states(drifted(truth, 4))
    covariance = np.tile(np.diag([1e-4, 1e-4, 1e-4, 4.0, 0.01, 0.01]), (len(states), 1, 1))
    states = replace(states, covariance=covariance)
    T = se3.from_parts(so3.rotation_z(1.1), np.array([5.0, 6.0, 7.0]))
    block = np.eye(6)
    block[3:, 3:] = T[:3, :3]
    turned = replace(states, T_world_body=T @ states.T_world_body, covariance=block @ covariance @ block.T)
    found = []
    for these in (states, turned):
        matched = associate(these.trajectory(), truth)
        motion = metrics.initial_alignment(matched, these, "rest")
        found.append(metrics.state_errors(matched, these, motion).nees()["pose"][0])
    np.testing.assert_allclose(found[0], found[1], rtol=1e-6, atol=1e-9)


def test_a_run_started_from_the_truth_is_not_aligned() -> None:
    truth = walk(5.0)
    states = StateColumns.from_states(drifted(truth, 4))
    shifted = replace(states, T_world_body=se3.from_parts(np.eye(3), np.array([1.0, 0.0, 0.0])) @ states.T_world_body)
    matched = associate(shifted.trajectory(), truth)
    motion = metrics.initial_alignment(matched, shifted, "groundtruth")
    assert np.array_equal(motion.t, Motion.identity().t)
    assert metrics.state_errors(matched, shifted, motion).position[0] == pytest.approx([-1.0, 0.0, 0.0], abs=1e-9)


def test_alignment_waits_for_tracking() -> None:
    truth = walk(5.0)
    states = StateColumns.from_states(drifted(truth, 4))
    states = replace(states, status=np.where(np.arange(len(states)) < 30, "lost", "tracking"))
    matched = associate(states.trajectory(), truth)
    errors = metrics.state_errors(matched, states, metrics.initial_alignment(matched, states, "rest"))
    assert np.linalg.norm(errors.position[30]) < 1e-9 < np.linalg.norm(errors.position[0])
    nowhere = replace(states, status=np.full(len(states), "lost"))
    with pytest.raises(MetricError, match="no state with status tracking"):
        metrics.initial_alignment(matched, nowhere, "rest")
