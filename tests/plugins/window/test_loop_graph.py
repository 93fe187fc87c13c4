"""The pose graph: its derivatives, exact answers, and what it must leave alone."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from vioframe.geometry import se3, so3
from vioframe_window import loop_graph as graph
from vioframe_window.loop_options import GraphOptions
from vioframe_window.loop_trajectory import KeyframeTrajectory


def random_poses(rng: np.random.Generator, count: int) -> np.ndarray:
    angles = np.cumsum(rng.normal(0.0, 0.3, count))
    tilt = so3.exp(np.column_stack([rng.normal(0.0, 0.2, (count, 2)), np.zeros(count)]))
    position = np.cumsum(rng.normal(0.0, 1.0, (count, 3)), axis=0)
    return se3.from_parts(so3.rotation_z(angles) @ tilt, position)


def random_edges(rng: np.random.Generator, nodes: int, count: int) -> graph.Edges:
    start = rng.integers(0, nodes, count)
    return graph.Edges(
        start=start,
        end=(start + rng.integers(1, nodes, count)) % nodes,
        displacement=rng.normal(0.0, 1.0, (count, 3)),
        turn=rng.uniform(-3.0, 3.0, count),
        root=rng.uniform(0.5, 2.0, (count, 4)),
        robust=np.zeros(count, dtype=bool),
    )


def test_jacobians_are_the_numerical_ones() -> None:
    rng = np.random.default_rng(0)
    edges = random_edges(rng, 5, 8)
    yaw, position = rng.uniform(-3.0, 3.0, 5), rng.normal(0.0, 2.0, (5, 3))
    by_start, by_end = graph.jacobians(yaw, position, edges)
    step = 1e-6
    for edge in range(8):
        for node, analytic in ((edges.start[edge], by_start[edge]), (edges.end[edge], by_end[edge])):
            for axis in range(4):
                moved_yaw, moved_position = yaw.copy(), position.copy()
                if axis == 0:
                    moved_yaw[node] += step
                else:
                    moved_position[node, axis - 1] += step
                change = graph.errors(moved_yaw, moved_position, edges) - graph.errors(yaw, position, edges)
                np.testing.assert_allclose(analytic[:, axis], change[edge] / step, atol=1e-5)


def test_the_solution_is_the_one_of_a_general_solver() -> None:
    rng = np.random.default_rng(1)
    poses = random_poses(rng, 12)
    options = GraphOptions(iterations=30)
    T_start_end = se3.inverse(poses[[0, 2]]) @ poses[[11, 9]] @ se3.exp(rng.normal(0.0, 0.03, (2, 6)))
    edges = graph.Edges.join(
        graph.odometry_edges(poses, np.arange(12), np.zeros(12, dtype=bool), options),
        graph.match_edges(np.array([0, 2]), np.array([11, 9]), T_start_end, np.full((2, 2), 0.03), poses[:, :3, :3]),
    )
    edges = replace(edges, robust=np.zeros(len(edges.start), dtype=bool))
    fixed = np.arange(12) == 0
    yaw, position = graph.solve(np.zeros(12), poses[:, :3, 3], fixed, edges, options)

    def errors(unknown: np.ndarray) -> np.ndarray:
        each = np.concatenate([np.concatenate([[0.0], poses[0, :3, 3]]), unknown]).reshape(12, 4)
        return graph.errors(each[:, 0], each[:, 1:], edges).ravel()

    first = np.column_stack([np.zeros(12), poses[:, :3, 3]])[1:].ravel()
    best = least_squares(errors, first, xtol=1e-14, ftol=1e-14, gtol=1e-12)
    np.testing.assert_allclose(np.column_stack([yaw, position])[1:].ravel(), best.x, atol=2e-5)


def test_an_exact_match_spreads_the_gap_evenly_over_equal_steps() -> None:
    count, gap = 21, np.array([0.3, -0.2, 0.1])
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = np.linspace(0.0, 10.0, count)
    options = GraphOptions(neighbours=1, step_sigma_yaw_deg=1e-5, match_sigma_m=1e-5, huber=1e9, iterations=20)
    T_start_end = se3.inverse(poses[0]) @ poses[-1]
    T_start_end[:3, 3] -= gap
    trajectory = KeyframeTrajectory(options)
    for index, pose in enumerate(poses):
        trajectory.add(index, pose, broken=False)
    trajectory.match(0, count - 1, T_start_end)
    moved = trajectory.T_map_body[:, :3, 3] - poses[:, :3, 3]
    np.testing.assert_allclose(moved, -np.linspace(0.0, 1.0, count)[:, None] * gap, atol=2e-4)


def test_true_matches_undo_a_drift_in_yaw() -> None:
    rng = np.random.default_rng(2)
    truth = random_poses(rng, 40)
    turn = so3.rotation_z(np.linspace(0.0, 0.1, 40))
    steps = (turn[:-1] @ np.diff(truth[:, :3, 3], axis=0)[..., None])[..., 0]
    odometry = se3.from_parts(
        turn @ truth[:, :3, :3], truth[0, :3, 3] + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    )
    trajectory = KeyframeTrajectory(GraphOptions(iterations=20))
    for index, pose in enumerate(odometry):
        trajectory.add(index, pose, broken=False)
    for end in (20, 30, 39):
        trajectory.match(0, end, se3.inverse(truth[0]) @ truth[end])
    before = np.linalg.norm(odometry[-1, :3, 3] - truth[-1, :3, 3])
    after = np.linalg.norm(trajectory.T_map_body[-1, :3, 3] - truth[-1, :3, 3])
    assert before > 0.2
    assert after < 0.1 * before


def test_the_correction_keeps_gravity() -> None:
    rng = np.random.default_rng(3)
    poses = random_poses(rng, 15)
    trajectory = KeyframeTrajectory(GraphOptions())
    for index, pose in enumerate(poses):
        trajectory.add(index, pose, broken=False)
    tilted = se3.inverse(poses[0]) @ poses[14] @ se3.exp(np.array([0.05, -0.04, 0.1, 0.2, 0.1, -0.1]))
    trajectory.match(0, 14, tilted)
    assert np.abs(trajectory.T_map_world - np.eye(4)).max() > 0.01
    np.testing.assert_array_equal(trajectory.T_map_world[2, :3], [0.0, 0.0, 1.0])
    np.testing.assert_allclose(trajectory.T_map_body[:, 2, :3], poses[:, 2, :3], atol=1e-12)


def test_keyframes_before_the_first_that_was_seen_again_stay() -> None:
    rng = np.random.default_rng(4)
    poses = random_poses(rng, 15)
    trajectory = KeyframeTrajectory(GraphOptions())
    for index, pose in enumerate(poses):
        trajectory.add(index, pose, broken=False)
    trajectory.match(6, 14, se3.inverse(poses[6]) @ poses[14] @ se3.exp(np.full(6, 0.1)))
    np.testing.assert_allclose(trajectory.T_map_body[:7], poses[:7], atol=1e-12)
    assert np.abs(trajectory.T_map_body[14] - poses[14]).max() > 0.01


def test_one_false_match_among_true_ones_bends_the_walk_little() -> None:
    rng = np.random.default_rng(5)
    poses = random_poses(rng, 40)
    trajectory = KeyframeTrajectory(GraphOptions(iterations=20))
    for index, pose in enumerate(poses):
        trajectory.add(index, pose, broken=False)
    for start, end in ((0, 20), (2, 25), (5, 30), (8, 39)):
        trajectory.match(start, end, se3.inverse(poses[start]) @ poses[end])
    false = se3.inverse(poses[3]) @ poses[28]
    false[:3, 3] += 5.0
    trajectory.match(3, 28, false)
    assert np.linalg.norm(trajectory.T_map_body[:, :3, 3] - poses[:, :3, 3], axis=1).max() < 0.5


def test_a_step_that_the_odometry_did_not_measure_takes_the_gap() -> None:
    count = 20
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = np.arange(count)
    trajectory = KeyframeTrajectory(GraphOptions(iterations=20))
    for index, pose in enumerate(poses):
        trajectory.add(index, pose, broken=index == 10)
    T_start_end = se3.inverse(poses[0]) @ poses[-1]
    T_start_end[1, 3] += 1.0
    trajectory.match(0, count - 1, T_start_end)
    sideways = trajectory.T_map_body[:, 1, 3]
    assert sideways[9] < 0.1
    assert sideways[10] > 0.8


@pytest.mark.parametrize("shift_s", [-100.0, 0.0, 1e9])
def test_corrections_in_between_are_in_between(shift_s: float) -> None:
    trajectory = KeyframeTrajectory(GraphOptions())
    begin = round(shift_s * 1e9)
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = (0.0, 1.0, 2.0)
    for index, pose in enumerate(poses):
        trajectory.add(begin + index * 10**9, pose, broken=False)
    T_start_end = se3.inverse(poses[0]) @ poses[2]
    T_start_end[1, 3] = 0.1
    trajectory.match(0, 2, T_start_end)
    at = np.array([-1, 0, 10**9, 15 * 10**8, 2 * 10**9, 10**10]) + begin
    corrections = trajectory.correction_at(at)
    np.testing.assert_allclose(corrections[0], np.eye(4), atol=1e-12)
    np.testing.assert_allclose(corrections[3][:3, 3], 0.5 * (corrections[2] + corrections[4])[:3, 3], atol=1e-9)
    np.testing.assert_allclose(corrections[5], corrections[4])
    np.testing.assert_allclose(corrections[4], trajectory.T_map_world)
