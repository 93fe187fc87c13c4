"""One entry of ``metrics.json``: its keys, its numbers, and honest gaps."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from synthetic_runs import make_run, moved, walk
from vioframe.errors import ClockError, ConfigError, MetricError
from vioframe.evaluation import EvaluationOptions, SequenceRun
from vioframe.evaluation.rows import compare_trajectories, evaluate_run, metrics_document
from vioframe.geometry import se3, so3
from vioframe.types import NavState

ACCURACY = [
    "path_estimated_m",
    "poses",
    "path_m",
    "ate_se3_m",
    "ate_se3_mean_m",
    "ate_se3_median_m",
    "ate_se3_max_m",
    "ate_se3_percent",
    "ate_yaw_m",
    "ate_sim3_m",
    "sim3_scale",
    "scale_error_percent",
    "rpe_trans_percent_1m",
    "rpe_rot_deg_1m",
    "rpe_trans_percent_10m",
    "rpe_rot_deg_10m",
    "rpe_trans_m_1s",
    "rpe_rot_deg_1s",
    "t_rel_percent",
    "r_rel_deg_per_100m",
    "yaw_rmse_deg",
    "gravity_rmse_deg",
    "gravity_max_deg",
]
RUNNING = ["anees_position", "anees_orientation", "anees_pose", "completion", "real_time_factor"]
REST = [
    "sequence",
    "status",
    "error",
    "segments",
    "ms_per_frame",
    "frames",
    "windows",
    "states",
    "duration_s",
    "pipeline_s",
    "wall_s",
    "initialisation",
    "calibration",
    "counters",
    "undefined",
    "protocol",
    "final",
]


def unopened() -> SequenceRun:
    return SequenceRun(
        sequence="s",
        states=[],
        frames_expected=0,
        duration_s=0.0,
        pipeline_s=0.0,
        windows=0,
        wall_s=0.0,
        error="no folder",
    )


def still_run() -> SequenceRun:
    """Truth and estimate at rest."""
    run = make_run(duration_s=5.0)
    truth = run.ground_truth
    assert truth is not None
    poses = np.tile(np.eye(4), (len(truth), 1, 1))
    states = [replace(state, T_world_body=np.eye(4), status="tracking") for state in run.states]
    return replace(
        run, states=states, smoothed=None, ground_truth=replace(truth, T_world_body=poses, v_world_body=None)
    )


RUNS = {
    "whole": make_run,
    "turned": lambda: make_run(turn=2.0, shift=(5.0, 6.0, 7.0)),
    "short": lambda: make_run(duration_s=10.0),
    "still": still_run,
    "no truth": lambda: replace(make_run(duration_s=5.0), ground_truth=None),
    "other clock": lambda: replace(make_run(duration_s=5.0), ground_truth=walk(5.0, start_ns=0)),
    "no covariance": lambda: replace(
        make_run(duration_s=5.0), states=[replace(s, covariance=None) for s in make_run(duration_s=5.0).states]
    ),
    "never started": lambda: replace(
        make_run(duration_s=5.0), states=[replace(s, status="starting") for s in make_run(duration_s=5.0).states]
    ),
    "one state": lambda: replace(make_run(duration_s=5.0), states=make_run(duration_s=5.0).states[60:61]),
    "no states": lambda: replace(make_run(duration_s=5.0), states=[], smoothed=None),
    "unopened": unopened,
    "diverged": lambda: replace(
        make_run(duration_s=5.0),
        states=[
            replace(s, T_world_body=se3.from_parts(np.eye(3), np.array([1e200, 0.0, 0.0])))
            for s in make_run(duration_s=5.0).states
        ],
    ),
}


@pytest.mark.parametrize("name", RUNS)
@pytest.mark.filterwarnings("ignore:overflow")
def test_every_row_has_the_same_keys_and_a_reason_for_each_gap(name: str) -> None:
    row = evaluate_run(RUNS[name]())
    assert sorted(row) == sorted(ACCURACY + RUNNING + REST)
    assert json.loads(json.dumps(row, allow_nan=False)) == row
    undefined = row["undefined"]
    assert isinstance(undefined, dict)
    assert {key for key in ACCURACY + RUNNING if row[key] is None} == set(undefined)
    assert all(isinstance(reason, str) and reason for reason in undefined.values())
    final = row["final"]
    if final is not None:
        assert isinstance(final, dict)
        assert sorted(final) == sorted([*ACCURACY, "segments", "undefined", "protocol"])
        assert final["protocol"]["output"] == "final"


def test_a_whole_run_lacks_nothing() -> None:
    row = evaluate_run(make_run())
    assert row["undefined"] == {}
    assert row["status"] == "finished"
    assert row["completion"] == pytest.approx((1200 - 39 - 30) / 1200)
    assert row["real_time_factor"] == pytest.approx(2.5)
    assert row["protocol"] == {
        "output": "causal",
        "rate_hz": pytest.approx(20.0),
        "truth_rate_hz": pytest.approx(20.0),
        "init": "auto",
        "uses_ground_truth": [],
        "faults": [],
        "nees_alignment": "yaw and position at the first tracking state",
        "states": "tracking and lost",
    }


def test_the_final_trajectory_is_kept_apart() -> None:
    row = evaluate_run(make_run())
    final = row["final"]
    assert isinstance(final, dict)
    assert final["ate_se3_m"] < 0.02 < row["ate_se3_m"]
    assert evaluate_run(replace(make_run(), smoothed=None))["final"] is None


def test_milliseconds_add_up() -> None:
    parts = evaluate_run(make_run())["ms_per_frame"]
    assert isinstance(parts, dict)
    assert parts["total"] == pytest.approx(20.0)
    assert sum(value for name, value in parts.items() if name != "total") == pytest.approx(parts["total"])
    assert parts["framework"] == pytest.approx(0.25)


def test_the_world_of_the_estimator_changes_no_metric() -> None:
    plain, turned = evaluate_run(make_run()), evaluate_run(make_run(turn=2.0, shift=(5.0, 6.0, 7.0)))
    for key in ACCURACY + RUNNING:
        assert turned[key] == pytest.approx(plain[key], rel=1e-6), key


def test_a_path_below_100_m_has_no_kitti_numbers() -> None:
    row = evaluate_run(make_run(duration_s=10.0))
    assert row["t_rel_percent"] is None
    assert row["r_rel_deg_per_100m"] is None
    assert "no segment of 100 m fits" in row["undefined"]["t_rel_percent"]  # type: ignore[index]


def test_standing_still_has_no_percentage_and_no_invented_zero() -> None:
    row = evaluate_run(still_run())
    assert row["path_m"] == 0.0
    for key in ("ate_se3_percent", "sim3_scale", "ate_sim3_m", "rpe_trans_percent_1m"):
        assert row[key] is None, key
    assert row["rpe_trans_m_1s"] == 0.0
    assert row["gravity_rmse_deg"] == pytest.approx(0.0, abs=1e-9)


def test_lost_states_are_compared_and_starting_ones_are_not() -> None:
    run = make_run(duration_s=10.0)
    far = se3.from_parts(np.eye(3), np.array([30.0, 0.0, 0.0]))

    def moved_away(status: str) -> SequenceRun:
        states = [
            replace(s, T_world_body=far @ s.T_world_body, status=status) if k < 20 else replace(s, status="tracking")
            for k, s in enumerate(run.states)
        ]
        return replace(run, states=states)

    assert evaluate_run(moved_away("lost"))["ate_se3_m"] > 1.0  # type: ignore[operator]
    assert evaluate_run(moved_away("starting"))["ate_se3_m"] < 0.5  # type: ignore[operator]


def test_interrupted_runs_say_so_and_keep_an_honest_real_time_factor() -> None:
    run = make_run()
    half = replace(
        run,
        states=run.states[:600],
        windows=600,
        pipeline_s=0.5 * run.pipeline_s,
        interrupted=True,
        error="stopped by the user",
    )
    row = evaluate_run(half)
    assert row["status"] == "interrupted"
    assert row["error"] == "stopped by the user"
    assert row["real_time_factor"] == pytest.approx(2.5)
    assert row["completion"] == pytest.approx((600 - 39) / 1200)
    assert evaluate_run(replace(half, interrupted=False))["status"] == "failed"


def test_covariances_claimed_half_as_large_double_the_nees() -> None:
    run = make_run(duration_s=10.0)
    bold: list[NavState] = [replace(s, covariance=0.5 * s.covariance) for s in run.states if s.covariance is not None]
    plain, doubled = evaluate_run(run), evaluate_run(replace(run, states=bold))
    for key in ("anees_position", "anees_orientation", "anees_pose"):
        assert doubled[key] == pytest.approx(2.0 * plain[key])  # type: ignore[operator]


def test_stamps_that_go_back_are_a_bug_of_the_fuser_and_are_named() -> None:
    run = make_run(duration_s=5.0)
    with pytest.raises(ClockError, match="goes back"):
        evaluate_run(replace(run, states=[run.states[50], run.states[49]]))


def test_the_document_says_how_and_what() -> None:
    options = EvaluationOptions(association="nearest", max_difference_s=0.02, rpe_distances_m=(5.0,))
    rows = [evaluate_run(make_run(duration_s=5.0), options)]
    document = metrics_document(rows, options, {"vioframe": "1.2.3"})
    assert list(document) == ["sequences", "protocol", "vioframe"]
    protocol = document["protocol"]
    assert isinstance(protocol, dict)
    assert protocol["association"] == "nearest"
    assert protocol["association_tolerance_s"] == 0.02
    assert protocol["segment_lengths_m"] == [100, 200, 300, 400, 500, 600, 700, 800]
    assert "rpe_trans_percent_5m" in rows[0]
    json.dumps(document, allow_nan=False)


@pytest.mark.parametrize(
    "wrong",
    [
        {"association": "guess"},
        {"max_gap_s": -1.0},
        {"max_difference_s": math.nan},
        {"segment_lengths_m": (100.0, 0.0)},
        {"rpe_times_s": (-1.0,)},
        {"segment_step": 0},
    ],
)
def test_wrong_options_are_refused_by_name(wrong: dict[str, object]) -> None:
    with pytest.raises(ConfigError, match=f"evaluation.{next(iter(wrong))}"):
        EvaluationOptions(**wrong)  # type: ignore[arg-type]


def test_comparison_scales_first_where_asked() -> None:
    truth = walk(60.0)
    small = moved(truth, se3.from_parts(so3.exp(np.array([0.1, 0.2, 0.3])), np.ones(3)), scale=0.1)
    options = EvaluationOptions()
    scaled = compare_trajectories(small, truth, options, alignment="sim3")
    assert scaled["ate_m"] == pytest.approx(0.0, abs=1e-9)
    assert scaled["t_rel_percent"] == pytest.approx(0.0, abs=1e-6)
    assert scaled["rpe_trans_percent_1m"] == pytest.approx(0.0, abs=1e-6)
    metric = compare_trajectories(small, truth, options, alignment="se3")
    assert metric["rpe_trans_percent_1m"] == pytest.approx(90.0, abs=0.5)
    assert metric["scale_error_percent"] == pytest.approx(-90.0)
    assert "gravity_rmse_deg" not in metric
    assert "gravity_rmse_deg" in compare_trajectories(truth, truth, options, alignment="yaw")


def test_comparison_without_overlap_is_refused() -> None:
    with pytest.raises(MetricError, match="no pose of the estimate"):
        compare_trajectories(walk(5.0), walk(5.0, start_ns=0), EvaluationOptions(), alignment="se3")
