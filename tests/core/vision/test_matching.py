"""Matching of descriptors among possible pairs, and ids that last."""

from functools import partial

import numpy as np
import pytest

from vioframe.errors import ShapeError
from vioframe.geometry import camera as projection
from vioframe.geometry import so3
from vioframe.types import Camera
from vioframe.vision.keeper import KeeperOptions, TrackKeeper
from vioframe.vision.keypoints import Keypoints
from vioframe.vision.matching import all_distances, descriptor_distances, match, mutual_nearest, pairs_near
from vioframe.vision.spread import choose_spread, crowded

CAMERA = Camera(
    model="pinhole", intrinsics_px=np.array([300.0, 300.0, 320.0, 240.0]), size_px=(640, 480), T_body_cam=np.eye(4)
)
OPTIONS = KeeperOptions(
    max_points=60,
    min_distance_px=10.0,
    search_px=15.0,
    blind_search_px=60.0,
    memory_images=4,
    max_distance=60.0,
    ratio=0.8,
    reject_outliers=True,
    outlier_px=1.0,
)


def test_distances_are_those_of_bits_and_of_vectors():
    bits = np.array([[0b1010, 255], [0, 0]], np.uint8)
    assert descriptor_distances(bits, bits[::-1]).tolist() == [10.0, 10.0]
    assert np.allclose(descriptor_distances(np.array([[3.0, 0.0]]), np.array([[0.0, 4.0]])), 5.0)


def test_all_distances_are_those_of_each_pair():
    rng = np.random.default_rng(5)
    for first, second in (
        (rng.integers(0, 256, (7, 32), dtype=np.uint8), rng.integers(0, 256, (9, 32), dtype=np.uint8)),
        (rng.normal(size=(7, 64)).astype(np.float32), rng.normal(size=(9, 64)).astype(np.float32)),
    ):
        expected = [[descriptor_distances(a[None], b[None])[0] for b in second] for a in first]
        assert np.allclose(all_distances(first, second), expected, atol=1e-5)
        assert np.allclose(np.diag(all_distances(first, first)), 0.0, atol=1e-6)
        assert all_distances(first[:0], second).shape == (0, 9)


def test_mutual_neighbours_prefer_each_other():
    distance = np.array([[0.1, 0.5, 0.9], [0.2, 0.6, 0.3], [0.8, 0.7, 0.75]])
    # Row 1 prefers column 0, which prefers row 0; column 1 prefers row 0; row 2 prefers column 1.
    rows, columns = mutual_nearest(distance)
    assert (rows.tolist(), columns.tolist()) == ([0], [0])
    assert len(mutual_nearest(distance, 0.05)[0]) == 0
    assert len(mutual_nearest(distance[:0])[0]) == len(mutual_nearest(distance[:, :0])[0]) == 0


def test_matches_are_mutual_and_clear():
    first = np.array([[0.0], [10.0], [20.0], [40.0]])
    second = np.array([[0.2], [10.1], [9.9], [41.0], [41.5]])
    rows, columns = (grid.ravel() for grid in np.meshgrid(range(4), range(5), indexing="ij"))
    found = match(first, second, rows, columns, max_distance=2.0, ratio=0.8)
    # 10 has two equals, 20 is nobody's nearest, 40's second nearest is a third further.
    assert [pair.tolist() for pair in found] == [[0, 3], [0, 3]]
    near = match(first, second, rows, columns, max_distance=0.5, ratio=0.8)
    assert [pair.tolist() for pair in near] == [[0], [0]]
    nothing = match(first, second, rows[:0], columns[:0], max_distance=2.0, ratio=0.8)
    assert [len(pair) for pair in nothing] == [0, 0]


def test_pairs_are_those_within_the_radius():
    rng = np.random.default_rng(0)
    a, b = rng.uniform(0, 600, (80, 2)), rng.uniform(0, 600, (90, 2))
    radius = rng.uniform(0, 100, 80)
    rows, columns = pairs_near(a, b, radius)
    near = np.linalg.norm(a[:, None] - b, axis=-1) < radius[:, None]
    assert set(zip(rows, columns, strict=True)) == set(zip(*np.nonzero(near), strict=True))


def test_new_points_spread_and_the_younger_of_two_gives_way():
    rng = np.random.default_rng(1)
    points = rng.uniform(0, [640, 480], (2000, 2))
    # All the strong ones in one corner: the rest of the image has its share even so.
    values = np.exp(-np.linalg.norm(points, axis=1) / 100)
    chosen = points[choose_spread(points, values, points[:0], size_px=(640, 480), distance=20.0, count=80)]
    apart = np.linalg.norm(chosen[:, None] - chosen, axis=-1)[~np.eye(80, dtype=bool)]
    assert apart.min() >= 20.0
    cell = (chosen / np.array([80, 96])).astype(int) @ np.array([1, 8])
    assert np.bincount(cell, minlength=40).min() >= 1
    pixels = np.array([[0.0, 0.0], [3.0, 0.0], [50.0, 0.0]])
    assert crowded(pixels, np.array([2, 9, 1]), np.array([0, 1, 2]), 5.0).tolist() == [True, False, False]


class Scene:
    """Points with descriptors of their own, seen by a moving camera."""

    def __init__(self, count=60, seed=2):
        rng = np.random.default_rng(seed)
        self.points = rng.uniform([-3, -2, 4], [3, 2, 9], (count, 3))
        self.descriptors = rng.integers(0, 256, (count, 32), dtype=np.uint8)

    def see(self, R, t, hidden=()):
        pixels, visible = projection.project(CAMERA, (self.points - t) @ R)
        visible[list(hidden)] = False
        rows = np.flatnonzero(visible)
        keypoints = Keypoints(pixels=pixels[rows], scores=np.ones(len(rows)), descriptors=self.descriptors[rows].copy())
        return keypoints, rows


def track(scene, steps, hidden=lambda k: (), gyro=True, disturb=None, follow=None):
    """The point of each id, image by image; a point that was followed is that of its descriptor."""
    keeper = TrackKeeper(CAMERA, OPTIONS)
    out = []
    turn, step = so3.exp(np.array([0.01, 0.03, 0.05])), np.array([0.06, 0.02, 0.03])
    R = np.eye(3)
    for k in range(steps):
        keypoints, rows = scene.see(R, k * step, hidden(k))
        if disturb is not None:
            keypoints = disturb(k, keypoints)
        bound = None if follow is None else partial(follow, scene, R, k * step)
        kept = keeper.keep(keypoints, turn if gyro and k else None, bound)
        assert len(kept.ids) == len(kept.points) == len(kept.index) == len(kept.ages)
        assert np.all(np.diff(kept.ids) > 0)
        matched = kept.index >= 0
        assert np.array_equal(kept.points.pixels[matched], keypoints.pixels[kept.index[matched]])
        owners = [int(np.flatnonzero((scene.descriptors == each).all(axis=1))[0]) for each in kept.points.descriptors]
        assert np.array_equal(rows[kept.index[matched]], np.array(owners, int)[matched])
        out.append(dict(zip(kept.ids.tolist(), owners, strict=True)))
        R = R @ turn
    return out


@pytest.mark.parametrize("gyro", [True, False])
def test_ids_belong_to_one_point_for_ever(gyro):
    seen = track(Scene(), 10, gyro=gyro)
    owner = {}
    for step in seen:
        for identity, point in step.items():
            assert owner.setdefault(identity, point) == point
    assert len(set(seen[0]) & set(seen[-1])) > 0.6 * len(seen[0])


def test_an_absent_point_comes_back_with_its_id_but_not_for_ever():
    away = list(range(12))
    soon = track(Scene(), 8, lambda k: away if 3 <= k < 6 else ())
    before = {point: identity for identity, point in soon[2].items() if point in away}
    after = {point: identity for identity, point in soon[6].items() if point in away}
    again = before.keys() & after.keys()
    assert len(again) >= 6
    assert sum(before[point] == after[point] for point in again) >= 0.8 * len(again)
    late = track(Scene(), 10, lambda k: away if 3 <= k < 9 else ())
    assert not {i for i, p in late[2].items() if p in away} & set(late[9])


def true_places(scene, R, t, ids, expected):
    """Stands in for patches: the true place nearest to where a point should be."""
    pixels, visible = projection.project(CAMERA, (scene.points - t) @ R)
    apart = np.linalg.norm(expected[:, None] - pixels, axis=-1)
    nearest = apart.argmin(axis=1)
    return pixels[nearest], (apart.min(axis=1) < 4.0) & visible[nearest]


def test_what_no_keypoint_matches_is_followed_as_long_as_it_can_be_found():
    away = list(range(12))
    seen = track(Scene(), 12, lambda k: away if k >= 3 else (), follow=true_places)
    lost = track(Scene(), 12, lambda k: away if k >= 3 else ())
    before = {identity for identity, point in seen[2].items() if point in away}
    assert len(before) >= 8
    # Five images are all that an absent point is remembered for.
    assert len(before & set(seen[9])) >= 0.6 * len(before) and not before & set(lost[9])
    assert all(seen[k][i] == seen[2][i] for k in range(3, 12) for i in before & set(seen[k]))


def test_what_is_followed_against_the_motion_or_onto_another_point_is_lost():
    def off_the_line(scene, R, t, ids, expected):
        pixels, found = true_places(scene, R, t, ids, expected)
        return pixels + np.array([0.0, 9.0]), found

    def onto_another(scene, R, t, ids, expected):
        pixels, visible = projection.project(CAMERA, (scene.points[40:] - t) @ R)
        return np.repeat(pixels[visible][:1] + 1.0, len(ids), axis=0), np.ones(len(ids), dtype=bool)

    away = list(range(12))
    for wrong in (off_the_line, onto_another):
        seen = track(Scene(), 5, lambda k: away if k >= 3 else (), follow=wrong)
        before = {identity for identity, point in seen[2].items() if point in away}
        assert len(before & set(seen[4])) <= 1, wrong.__name__


def test_what_contradicts_the_motion_loses_its_id():
    scene = Scene()

    def disturb(k, keypoints):
        pixels = keypoints.pixels.copy()
        # Off the epipolar line, yet within reach of the search.
        pixels[:8] += np.array([0.0, 9.0]) * (k == 4)
        return Keypoints(pixels=pixels, scores=keypoints.scores, descriptors=keypoints.descriptors)

    seen = track(scene, 5, disturb=disturb)
    moved = set(range(8))
    same = {p for i, p in seen[4].items() if seen[3].get(i) == p}
    assert len(same & moved) <= 2
    assert len(same - moved) > 25


def test_keypoints_of_unequal_lengths_are_refused():
    with pytest.raises(ShapeError, match=r"Keypoints.descriptors must have shape \(3, any\)"):
        Keypoints(pixels=np.zeros((3, 2)), scores=np.zeros(3), descriptors=np.zeros((2, 32), np.uint8))
