"""Association and alignment, against known motions and against evo."""

import numpy as np
import pytest
from evo.core import geometry, metrics, sync
from evo.tools import file_interface

from shared_data import shared_data
from synthetic_runs import SECOND, moved, walk
from vioframe.errors import ConfigError, MetricError
from vioframe.evaluation.align import (
    MatchedPoses,
    align,
    align_first,
    align_umeyama,
    align_yaw,
    associate,
)
from vioframe.evaluation.metrics import absolute_error
from vioframe.geometry import se3, so3
from vioframe.trajectory_io import read_trajectory
from vioframe.types import Trajectory

SOMEWHERE = se3.from_parts(so3.exp(np.array([0.4, -1.1, 2.0])), np.array([3.0, -40.0, 7.0]))
TURNED = se3.from_parts(so3.rotation_z(2.1), np.array([3.0, -40.0, 7.0]))


def exact(estimate: Trajectory, truth: Trajectory) -> MatchedPoses:
    return associate(estimate, truth)


def test_unknown_names_are_refused() -> None:
    truth = walk(5.0)
    with pytest.raises(ConfigError, match="interpolate or nearest"):
        associate(truth, truth, method="closest")  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="alignment must be one of"):
        align(exact(truth, truth), "se2")  # type: ignore[arg-type]


def test_no_overlap_names_both_spans() -> None:
    truth = walk(5.0)
    later = Trajectory(stamps_ns=truth.stamps_ns + 100 * SECOND, T_world_body=truth.T_world_body)
    for method in ("interpolate", "nearest"):
        with pytest.raises(MetricError, match=r"1403715373\.262 to 1403715378\.262 s"):
            associate(later, truth, method=method)  # type: ignore[arg-type]


@pytest.mark.parametrize(("alignment", "T"), [("se3", SOMEWHERE), ("yaw", TURNED), ("sim3", SOMEWHERE)])
def test_the_choice_of_world_leaves_no_error(alignment: str, T: np.ndarray) -> None:
    truth = walk()
    scale = 0.3 if alignment == "sim3" else 1.0
    error, motion = absolute_error(exact(moved(truth, T, scale), truth), alignment)  # type: ignore[arg-type]
    assert error.maximum < 1e-9
    assert motion.scale == pytest.approx(1.0 / scale, abs=1e-12)


def test_yaw_alignment_cannot_hide_a_tilt() -> None:
    truth = walk()
    tilted = moved(truth, se3.from_parts(so3.exp(np.array([0.1, 0.0, 0.0])), np.zeros(3)))
    assert absolute_error(exact(tilted, truth), "yaw")[0].rmse > 0.3
    assert absolute_error(exact(tilted, truth), "se3")[0].rmse < 1e-9


def test_alignment_is_optimal() -> None:
    """No small motion about the one found makes the squared error smaller."""
    random = np.random.default_rng(5)
    truth = random.normal(0, 3, (60, 3))
    estimate = truth @ so3.exp(np.array([0.2, 0.5, -1.0])) + random.normal(0, 0.4, (60, 3))
    for find, axes in (
        (lambda: align_umeyama(estimate, truth, with_scale=False), range(6)),
        (lambda: align_yaw(estimate, truth), (2, 3, 4, 5)),
    ):
        motion = find()
        best = ((estimate @ motion.R.T + motion.t - truth) ** 2).sum()
        for axis in axes:
            for step in (-1e-4, 1e-4):
                xi = np.zeros(6)
                xi[axis] = step
                T = se3.exp(xi) @ se3.from_parts(motion.R, motion.t)
                assert (((estimate @ T[:3, :3].T + T[:3, 3]) - truth) ** 2).sum() > best


def test_umeyama_equals_evo_also_where_the_best_fit_mirrors() -> None:
    random = np.random.default_rng(2)
    for mirror in (1.0, -1.0):
        truth = random.normal(0, 2, (40, 3))
        estimate = truth * (1.0, 1.0, mirror) + random.normal(0, 0.01, (40, 3))
        motion = align_umeyama(estimate, truth, with_scale=True)
        R, t, scale = geometry.umeyama_alignment(estimate.T, truth.T, with_scale=True)
        np.testing.assert_allclose(motion.R, R, atol=1e-12)
        np.testing.assert_allclose(motion.t, t, atol=1e-12)
        assert motion.scale == pytest.approx(scale, abs=1e-12)


@pytest.mark.parametrize(
    ("points", "reason"),
    [
        (np.zeros((2, 3)), "needs 3 poses, but 2 match"),
        (np.ones((20, 3)), "coincide"),
        (np.linspace(0, 1, 20)[:, None] * np.array([1.0, 2.0, 3.0]), "on one line"),
    ],
)
def test_degenerate_positions_are_refused(points: np.ndarray, reason: str) -> None:
    for scale in (False, True):
        with pytest.raises(MetricError, match=reason):
            align_umeyama(points, points, with_scale=scale)


def test_yaw_needs_horizontal_motion_only() -> None:
    line = np.linspace(0, 10, 50)[:, None]
    straight, turned = line * np.array([1.0, 0.0, 0.0]), line * np.array([0.0, 1.0, 0.0])
    assert np.allclose(align_yaw(straight, turned).R, so3.rotation_z(np.pi / 2))
    with pytest.raises(MetricError, match="does not move horizontally"):
        align_yaw(line * np.array([0.0, 0.0, 1.0]), straight)
    with pytest.raises(MetricError, match="2 poses"):
        align_yaw(straight[:1], straight[:1])


def test_first_pose_alignment_keeps_the_tilt() -> None:
    T_truth = se3.from_parts(so3.exp(np.array([0.1, 0.2, 0.7])), np.array([1.0, 2.0, 3.0]))
    tilt = so3.exp(np.array([0.0, 0.05, 0.0]))
    T_estimate = se3.from_parts(so3.rotation_z(-1.3) @ tilt @ T_truth[:3, :3], np.array([9.0, 9.0, 9.0]))
    aligned = align_first(T_estimate, T_truth).apply(T_estimate)
    np.testing.assert_allclose(aligned[:3, 3], T_truth[:3, 3], atol=1e-12)
    np.testing.assert_allclose(aligned[:3, :3] @ T_truth[:3, :3].T, tilt, atol=1e-6)


def test_interpolation_bridges_small_gaps_only() -> None:
    truth = walk(10.0, rate_hz=100.0)
    kept = np.ones(len(truth), dtype=bool)
    kept[300:305] = False
    kept[500:530] = False
    holed = Trajectory(stamps_ns=truth.stamps_ns[kept], T_world_body=truth.T_world_body[kept])
    matched = associate(truth, holed, max_gap_s=0.11)
    found = np.isin(truth.stamps_ns, matched.stamps_ns)
    assert found[300:305].all()
    assert not found[500:530].any()
    assert np.abs(matched.T_estimate - matched.T_truth).max() < 2e-3


def test_stamps_of_the_truth_need_no_interpolation() -> None:
    """KITTI's poses are 0.104 s apart, but they are there."""
    truth = walk(60.0, rate_hz=2.0)
    assert len(associate(truth, truth, max_gap_s=0.11)) == len(truth)


def test_offset_moves_the_stamps_of_the_estimate() -> None:
    truth = walk(10.0)
    late = Trajectory(stamps_ns=truth.stamps_ns + SECOND // 4, T_world_body=truth.T_world_body)
    assert absolute_error(associate(late, truth, offset_s=-0.25), "none")[0].maximum < 1e-12
    assert absolute_error(associate(late, truth), "none")[0].rmse > 0.1


def test_shared_frames_keep_their_numbers() -> None:
    truth = walk(20.0)
    part = Trajectory(stamps_ns=truth.stamps_ns[40:], T_world_body=truth.T_world_body[40:])
    matched = associate(part, truth)
    assert matched.frames[0] == 40
    assert len(matched.T_truth_frames) == len(truth)
    faster = walk(20.0, rate_hz=40.0)
    assert len(associate(part, faster).T_truth_frames) == len(part)


def test_nearest_pairs_as_evo_does() -> None:
    random = np.random.default_rng(8)
    truth, estimate = walk(30.0, rate_hz=33.0), walk(30.0, rate_hz=20.0)
    stamps = estimate.stamps_ns + random.integers(-8_000_000, 8_000_000, len(estimate))
    estimate = Trajectory(stamps_ns=stamps, T_world_body=estimate.T_world_body)
    for first, second in ((estimate, truth), (truth, estimate)):
        matched = associate(first, second, method="nearest", max_difference_s=0.006)
        zero = int(truth.stamps_ns[0])
        theirs = sync.matching_time_indices((stamps - zero) / 1e9, (truth.stamps_ns - zero) / 1e9, 0.006)
        pairs = np.array(theirs)[0 if first is estimate else 1]
        assert matched.estimate_index.tolist() == pairs.tolist()


def test_ape_of_a_real_estimate_equals_evo() -> None:
    truth_path = shared_data("trajectories", "evo", "KITTI_00_gt.txt")
    estimate_path = shared_data("trajectories", "evo", "KITTI_00_ORB.txt")
    matched = associate(read_trajectory(estimate_path), read_trajectory(truth_path))
    error, _ = absolute_error(matched, "se3")
    assert error.rmse == pytest.approx(1.3034497, abs=1e-6)
    theirs, reference = (file_interface.read_kitti_poses_file(path) for path in (estimate_path, truth_path))
    theirs.align(reference)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, theirs))
    for ours, name in ((error.rmse, "rmse"), (error.mean, "mean"), (error.median, "median"), (error.maximum, "max")):
        assert ours == pytest.approx(ape.get_all_statistics()[name], abs=1e-9)


@pytest.mark.parametrize(("alignment", "published"), [("se3", 0.092), ("sim3", 0.085)])
def test_interpolated_ape_of_v102(alignment: str, published: float) -> None:
    truth = read_trajectory(shared_data("trajectories", "evo", "V102_groundtruth.csv"))
    estimate = read_trajectory(shared_data("trajectories", "evo", "V102.txt"))
    error, motion = absolute_error(associate(estimate, truth), alignment)  # type: ignore[arg-type]
    assert error.rmse == pytest.approx(published, abs=2e-3)
    assert motion.scale == pytest.approx(0.980 if alignment == "sim3" else 1.0, abs=5e-4)
