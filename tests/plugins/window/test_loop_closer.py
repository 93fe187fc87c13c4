"""Loop closure as a whole, in a world of points: what it finds, what it refuses, and what it makes of it."""

from dataclasses import replace

import numpy as np
import pytest

from loop_scenes import CAMERA, NO_IMAGE, RIG, STEP_NS, PointWorld, circle, drifted
from vioframe.errors import ConfigError, DataError, StateError
from vioframe.geometry import se3, so3
from vioframe.types import Tracks, Trajectory
from vioframe_window import BowLoop, GraphOptions, Retrieval, Verification
from vioframe_window.loop_appearance import Appearance
from vioframe_window.loop_geometry import locate
from vioframe_window.loop_interface import LoopKeyframe, LoopMatch


def walk(loop: BowLoop, world: PointWorld, truth: np.ndarray, odometry: np.ndarray, seed: int = 0) -> list[LoopMatch]:
    """Give every keyframe of a walk; the matches."""
    rng = np.random.default_rng(seed)
    matches = []
    for index, (T_true, T_odometry) in enumerate(zip(truth, odometry, strict=True)):
        match = loop.add_keyframe(world.keyframe(index, T_true, T_odometry, rng))
        matches += [] if match is None else [match]
    return matches


def trajectory(poses: np.ndarray) -> Trajectory:
    return Trajectory(stamps_ns=np.arange(len(poses), dtype=np.int64) * STEP_NS, T_world_body=poses)


def gap(poses: np.ndarray, truth: np.ndarray) -> float:
    return float(np.linalg.norm(poses[-1, :3, 3] - truth[-1, :3, 3]))


@pytest.fixture(scope="module")
def lap() -> tuple[PointWorld, np.ndarray, np.ndarray]:
    truth = circle(1.25)
    return PointWorld.around(truth, 0), truth, drifted(truth, yaw_deg=0.05, scale=1.005, climb_m=0.003)


def test_a_drifted_lap_closes(lap: tuple[PointWorld, np.ndarray, np.ndarray]) -> None:
    world, truth, odometry = lap
    loop = BowLoop()
    loop.setup(RIG)
    matches = walk(loop, world, truth, odometry)
    final = loop.correct(trajectory(odometry))
    assert loop.counters()["loop closures"] == len(matches) > 20
    assert gap(odometry, truth) > 0.8
    assert gap(final.T_world_body, truth) < 0.1 * gap(odometry, truth)
    assert not final.causal
    np.testing.assert_allclose(loop.T_map_world @ odometry[-1], final.T_world_body[-1], atol=1e-9)
    # Gravity stays where the odometry has it.
    np.testing.assert_allclose(final.T_world_body[:, 2, :3], odometry[:, 2, :3], atol=1e-12)


def test_every_match_is_where_the_old_camera_stood(lap: tuple[PointWorld, np.ndarray, np.ndarray]) -> None:
    world, truth, odometry = lap
    loop = BowLoop()
    loop.setup(RIG)
    for match in walk(loop, world, truth, odometry):
        new, old = match.stamp_ns // STEP_NS, match.loop_stamp_ns // STEP_NS
        T_new_old = se3.inverse(odometry[new]) @ match.T_world_loop
        apart = se3.inverse(se3.inverse(truth[new]) @ truth[old]) @ T_new_old
        assert np.linalg.norm(apart[:3, 3]) < 0.05
        assert so3.angle(apart[:3, :3]) < np.radians(1.0)
        assert new - old > 50
        assert len(match.landmark_ids) == len(match.pixels) == len(match.bearings) >= 25


def test_new_places_are_no_old_ones(lap: tuple[PointWorld, np.ndarray, np.ndarray]) -> None:
    _, truth, odometry = lap
    first, second = PointWorld.around(truth, 1), PointWorld.around(truth, 2)
    loop = BowLoop(retrieval=Retrieval(min_similarity=0.0))
    loop.setup(RIG)
    rng = np.random.default_rng(3)
    for index in range(len(truth)):
        world = first if index < 100 else second
        assert loop.add_keyframe(world.keyframe(index, truth[index], odometry[index], rng)) is None


def test_a_place_that_looks_the_same_but_is_built_otherwise_is_refused() -> None:
    rng = np.random.default_rng(4)
    points = rng.uniform((2.0, -3.0, -2.0), (8.0, 3.0, 2.0), (80, 3))
    descriptors = rng.integers(0, 256, (80, 32), dtype=np.uint8)
    seen = points[:, [1, 2, 0]]
    bearings = seen / np.linalg.norm(seen, axis=1, keepdims=True)
    other = Appearance(ids=np.arange(80), pixels=np.zeros((80, 2)), bearings=bearings, descriptors=descriptors)
    found = locate(seen, descriptors, other, 400.0, Verification(), seed=0)
    assert found is not None
    np.testing.assert_allclose(found.T_points_cam, np.eye(4), atol=1e-4)
    assert locate(seen[rng.permutation(80)], descriptors, other, 400.0, Verification(), seed=0) is None


def test_a_pose_is_as_sure_as_it_says() -> None:
    """Over many noisy pictures of one scene, the camera scatters as its sigmas say."""
    rng = np.random.default_rng(10)
    points = rng.uniform((-2.0, -1.5, 3.0), (2.0, 1.5, 8.0), (60, 3))
    descriptors = rng.integers(0, 256, (60, 32), dtype=np.uint8)
    apart, sigmas = [], []
    for _ in range(60):
        noisy = points[:, :2] / points[:, 2:] + 1.0 / 400.0 * rng.standard_normal((60, 2))
        bearings = np.column_stack([noisy, np.ones(60)])
        bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
        other = Appearance(ids=np.arange(60), pixels=np.zeros((60, 2)), bearings=bearings, descriptors=descriptors)
        found = locate(points, descriptors, other, 400.0, Verification(inlier_px=6.0), seed=0)
        assert found is not None
        apart.append([so3.angle(found.T_points_cam[:3, :3]), np.linalg.norm(found.T_points_cam[:3, 3])])
        sigmas.append([found.sigma_rad, found.sigma_m])
    scatter = np.sqrt(np.mean(np.square(apart), axis=0) / 3.0)
    np.testing.assert_allclose(scatter, np.mean(sigmas, axis=0), rtol=0.25)


def test_a_copy_of_a_room_too_far_away_is_refused() -> None:
    path = circle(0.35)
    away = path.copy()
    away[:, :3, 3] += (25.0, 0.0, 0.0)
    world = PointWorld.around(path, 5)
    truth, odometry = np.concatenate([path, path]), np.concatenate([path, away])
    loop = BowLoop(retrieval=Retrieval(exclude_s=5.0))
    loop.setup(RIG)
    rng = np.random.default_rng(6)
    for index, (T_true, T_odometry) in enumerate(zip(truth, odometry, strict=True)):
        if index == len(path):
            # The way to the copy is long, but not as long as it would have to be.
            for step in range(1, 10):
                middle = T_odometry.copy()
                middle[:3, 3] += (step - 10) * np.array([2.5, 0.0, 0.0])
                blind = LoopKeyframe(
                    stamp_ns=index * STEP_NS - 10 + step,
                    T_world_body=middle,
                    image=NO_IMAGE,
                    tracks=Tracks.none(),
                    landmark_ids=np.zeros(0, dtype=np.int64),
                    landmarks_world=np.zeros((0, 3)),
                )
                assert loop.add_keyframe(blind) is None
        assert loop.add_keyframe(world.keyframe(index, T_true, T_odometry, rng)) is None
    assert loop.counters()["loop candidates refused"] > 10


def test_a_pose_that_contradicts_gravity_is_refused(lap: tuple[PointWorld, np.ndarray, np.ndarray]) -> None:
    world, truth, odometry = lap
    tilted = odometry.copy()
    tilted[105:] = se3.from_parts(so3.exp(np.array([0.15, 0.0, 0.0])), np.zeros(3)) @ odometry[105:]
    loop = BowLoop()
    loop.setup(RIG)
    assert not walk(loop, world, truth, tilted)
    assert loop.counters()["loop candidates refused"] > 10


def test_recent_keyframes_are_no_candidates() -> None:
    path = circle(0.15)
    truth = np.concatenate([path, path[::-1][1:], path[1:]])
    world = PointWorld.around(path, 7)
    loop = BowLoop(retrieval=Retrieval(exclude_s=1000.0))
    loop.setup(RIG)
    assert not walk(loop, world, truth, truth)


def test_standing_still_adds_nothing() -> None:
    path = np.tile(circle(0.1)[:1], (30, 1, 1))
    loop = BowLoop()
    loop.setup(RIG)
    walk(loop, PointWorld.around(circle(0.1), 8), path, path)
    assert loop.counters() == {"loop keyframes": 1}


def test_forgetting_keeps_what_matters(lap: tuple[PointWorld, np.ndarray, np.ndarray]) -> None:
    world, truth, odometry = lap
    loop = BowLoop(retrieval=Retrieval(most=60))
    loop.setup(RIG)
    matches = walk(loop, world, truth, odometry)
    assert len(matches) > 5
    assert gap(loop.correct(trajectory(odometry)).T_world_body, truth) < 0.25 * gap(odometry, truth)


def test_a_better_pose_of_a_match_is_taken(lap: tuple[PointWorld, np.ndarray, np.ndarray]) -> None:
    world, truth, odometry = lap
    loop = BowLoop(retrieval=Retrieval(exclude_s=40.0))
    loop.setup(RIG)
    matches = walk(loop, world, truth, odometry)
    before = loop.correct(trajectory(odometry)).T_world_body[-1, 2, 3]
    for match in matches:
        lower = match.T_world_loop.copy()
        lower[2, 3] -= 0.5
        loop.refine(match.match_id, lower, odometry[match.stamp_ns // STEP_NS])
    after = loop.correct(trajectory(odometry)).T_world_body[-1, 2, 3]
    assert after - before == pytest.approx(0.5, abs=0.1)
    loop.refine(12_345, np.eye(4), np.eye(4))


def test_odometry_that_was_estimated_again_is_taken(lap: tuple[PointWorld, np.ndarray, np.ndarray]) -> None:
    world, truth, odometry = lap
    loop = BowLoop()
    loop.setup(RIG)
    walk(loop, world, truth[:80], odometry[:80])
    loop.settle(np.arange(90, dtype=np.int64) * STEP_NS, truth[:90])
    walked = loop._ready().T_world_body
    np.testing.assert_array_equal(walked, truth[:80])


def test_an_interrupted_odometry_is_bridged_by_matches(lap: tuple[PointWorld, np.ndarray, np.ndarray]) -> None:
    world, truth, _ = lap
    jumped = truth.copy()
    jumped[60:, :3, 3] += (0.8, -0.5, 0.3)
    loop = BowLoop()
    loop.setup(RIG)
    rng = np.random.default_rng(9)
    for index in range(len(truth)):
        if index == 60:
            loop.interrupt()
        loop.add_keyframe(world.keyframe(index, truth[index], jumped[index], rng))
    final = loop.correct(trajectory(jumped)).T_world_body
    assert np.linalg.norm(final[:, :3, 3] - truth[:, :3, 3], axis=1).max() < 0.15


def test_keyframes_without_anything_to_see_do_no_harm() -> None:
    loop = BowLoop()
    loop.setup(RIG)
    poses = circle(0.3)
    for index, pose in enumerate(poses):
        blind = LoopKeyframe(
            stamp_ns=index * STEP_NS,
            T_world_body=pose,
            image=NO_IMAGE,
            tracks=Tracks.none(),
            landmark_ids=np.zeros(0, dtype=np.int64),
            landmarks_world=np.zeros((0, 3)),
        )
        assert loop.add_keyframe(blind) is None
    np.testing.assert_array_equal(loop.T_map_world, np.eye(4))
    np.testing.assert_array_equal(loop.correct(trajectory(poses)).T_world_body, poses)


def test_before_setup_it_says_so() -> None:
    with pytest.raises(StateError, match="setup"):
        BowLoop().correct(trajectory(circle(0.1)))


def test_a_rig_without_cameras_is_refused() -> None:
    with pytest.raises(DataError, match="camera"):
        BowLoop().setup(replace(RIG, cameras=()))


@pytest.mark.parametrize(
    ("make", "key"),
    [
        (lambda: Retrieval(spacing_m=0.0), "loop.retrieval.spacing_m"),
        (lambda: Retrieval(corners=-1), "loop.retrieval.corners"),
        (lambda: Retrieval(branching=1), "branching"),
        (lambda: Retrieval(min_similarity=1.0), "loop.retrieval.min_similarity"),
        (lambda: Retrieval(most=3), "loop.retrieval.most"),
        (lambda: Verification(min_matches=3), "loop.verification.min_matches"),
        (lambda: Verification(max_drift=-1.0), "loop.verification.max_drift"),
        (lambda: Verification(sure_share=2.0), "loop.verification.sure_share"),
        (lambda: GraphOptions(huber=0.0), "loop.graph.huber"),
        (lambda: GraphOptions(step_sigma_share=-0.1), "loop.graph.step_sigma_share"),
        (lambda: BowLoop(save_map="/no/such/folder/map.npz"), "loop.save_map"),
    ],
)
def test_options_that_cannot_work_are_named(make: object, key: str) -> None:
    assert callable(make)
    with pytest.raises(ConfigError, match=key):
        make()


def test_the_scene_looks_along_the_walk() -> None:
    np.testing.assert_allclose(CAMERA.T_body_cam[:3, 2], [1.0, 0.0, 0.0])
