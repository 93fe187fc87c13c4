"""Exact rays meet in their point; parallel ones say so; noisy ones minimise what is stated."""

import numpy as np

from geometry_tolerances import TRIANGULATED
from vioframe.geometry import se3, so3
from vioframe.geometry.triangulation import triangulate


def scene(views: int = 4, points: int = 30, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    T = se3.from_parts(so3.exp(random.normal(0, 0.1, (views, 3))), random.uniform(-0.5, 0.5, (views, 3)))
    world = random.uniform([-3, -2, 3], [3, 2, 9], (points, 3))
    local = np.stack([se3.transform(se3.inverse(pose), world) for pose in T])
    return T, world, local


def bearings(local: np.ndarray) -> np.ndarray:
    return local / np.linalg.norm(local, axis=-1, keepdims=True)


def test_exact_rays_meet() -> None:
    T, world, local = scene()
    found, depths = triangulate(T, bearings(local))
    np.testing.assert_allclose(found, world, atol=TRIANGULATED)
    np.testing.assert_allclose(depths, local[..., 2], atol=TRIANGULATED)


def test_a_view_of_weight_zero_does_not_count() -> None:
    T, world, local = scene()
    rays = bearings(local)
    rays[2] = [0.0, 0.0, 1.0]
    weights = np.ones(rays.shape[:2])
    weights[2] = 0.0
    np.testing.assert_allclose(triangulate(T, rays, weights)[0], world, atol=TRIANGULATED)


def test_parallel_rays_are_nan() -> None:
    T = np.stack([np.eye(4), np.eye(4)])
    T[1, 0, 3] = 0.3
    rays = np.tile([[0.0, 0.0, 1.0]], (2, 1, 1))
    rays = np.concatenate([rays, bearings(np.array([[[0.0, 0.0, 2.0]], [[-0.3, 0.0, 2.0]]]))], axis=1)
    found, depths = triangulate(T, rays)
    assert np.isnan(found[0]).all() and np.isnan(depths[:, 0]).all()
    np.testing.assert_allclose(found[1], [0, 0, 2], atol=TRIANGULATED)
    assert np.isnan(triangulate(np.tile(np.eye(4), (3, 1, 1)), np.tile([0.0, 0.0, 1.0], (3, 1, 1)))[0]).all()


def test_a_point_behind_has_negative_depth() -> None:
    T = np.stack([np.eye(4), np.eye(4)])
    T[1, 0, 3] = 0.5
    behind = np.array([[0.1, 0.2, -4.0]])
    rays = bearings(np.stack([behind, behind - [0.5, 0, 0]]))
    np.testing.assert_allclose(triangulate(T, rays)[1][:, 0], -4.0, atol=TRIANGULATED)


def test_noisy_rays_minimise_the_stated_cost() -> None:
    T, _, local = scene(seed=1)
    random = np.random.default_rng(2)
    rays = bearings(local + random.normal(0, 0.01, local.shape))
    weights = random.uniform(0.5, 2.0, rays.shape[:2])
    found, _ = triangulate(T, rays, weights)

    def cost(points: np.ndarray) -> np.ndarray:
        turned = np.einsum("vij,vmj->vmi", T[:, :3, :3], rays)
        to_point = points[None] - T[:, None, :3, 3]
        across = to_point - np.sum(to_point * turned, axis=-1, keepdims=True) * turned
        return np.sum(weights * np.sum(across**2, axis=-1), axis=0)

    for _ in range(20):
        assert np.all(cost(found) <= cost(found + random.normal(0, 1e-3, found.shape)))


def test_moving_everything_moves_the_points() -> None:
    T, _, local = scene(seed=3)
    rays = bearings(local + np.random.default_rng(4).normal(0, 0.005, local.shape))
    here = triangulate(T, rays)[0]
    move = se3.exp(np.array([0.3, -0.5, 1.0, 10.0, -4.0, 2.0]))
    there = triangulate(move @ T, rays)[0]
    np.testing.assert_allclose(there, se3.transform(move, here), atol=1e-8)
