"""Triangulation, the projected constraint of a track, and points in the state, against dense forms and derivatives."""

from copy import deepcopy

import numpy as np
import pytest

from synthetic_tracks import make_rig
from vioframe.geometry import camera as projection
from vioframe.geometry import se3, so3
from vioframe.types import ImuBias, ImuNoise, NavState
from vioframe_msckf.landmarks import Sightings, add_landmarks, correct_by_sightings
from vioframe_msckf.pixel_noise import PixelNoise
from vioframe_msckf.state import CLONES, FilterState
from vioframe_msckf.track_table import TrackTable
from vioframe_msckf.track_update import chi_squares, information, linearise, point_errors
from vioframe_msckf.triangulation import in_front, triangulate, widest_parallax

CLONE_COUNT, TRACKS, CAMERAS = 6, 9, 2
WEIGHT = 600.0


class Scene:
    """Two cameras at clones that look at points, with noise; some views are missing."""

    def __init__(self, seed=0, sigma=1.0 / WEIGHT):
        rng = np.random.default_rng(seed)
        T = [se3.exp(np.concatenate([rng.normal(0, 0.05, 3), [0.2 * k, 0.05 * k, 0.0]])) for k in range(CLONE_COUNT)]
        T_other = se3.exp(np.array([0.01, 0.0, 0.02, 0.11, 0.0, 0.0]))
        T = np.array(T)
        both = np.stack([T, T @ T_other])
        self.R, self.p = both[..., :3, :3], both[..., :3, 3]
        self.f = np.column_stack([rng.uniform(-2, 2, (TRACKS, 2)), rng.uniform(3, 8, TRACKS)])
        X = ((self.f[:, None, None] - self.p)[..., None, :] @ self.R)[..., 0, :]
        self.points = X[..., :2] / X[..., 2:] + sigma * rng.normal(0, 1, (TRACKS, CAMERAS, CLONE_COUNT, 2))
        self.weights = np.where(rng.random((TRACKS, CAMERAS, CLONE_COUNT)) < 0.8, WEIGHT, 0.0)
        self.weights[:, 0, [0, -1]] = WEIGHT
        self.anchors = np.full(TRACKS, CLONE_COUNT - 1)
        self.rng = rng

    def flat(self):
        return (
            self.R.reshape(-1, 3, 3),
            self.p.reshape(-1, 3),
            self.points.reshape(TRACKS, -1, 2),
            self.weights.reshape(TRACKS, -1),
        )

    def residual(self, track, f, xi):
        """Weighted residuals of one track with its point at ``f`` and the clones moved by ξ (M, 6)."""
        out = []
        for k in range(CLONE_COUNT):
            move = se3.exp(xi[k])
            for c in range(CAMERAS):
                R, p = move[:3, :3] @ self.R[c, k], move[:3, :3] @ self.p[c, k] + move[:3, 3]
                X = R.T @ (f - p)
                out.append(self.weights[track, c, k] * (self.points[track, c, k] - X[:2] / X[2]))
        return np.concatenate(out)

    def dense(self, track, f):
        """Numerical Jacobians of the prediction by the clones (rows, 6M) and by the point (rows, 3)."""
        step, zero = 1e-6, np.zeros((CLONE_COUNT, 6))
        by_point = np.stack(
            [
                -(self.residual(track, f + e, zero) - self.residual(track, f - e, zero)) / (2 * step)
                for e in step * np.eye(3)
            ],
            axis=1,
        )
        by_clones = []
        for e in step * np.eye(6 * CLONE_COUNT):
            xi = e.reshape(-1, 6)
            by_clones.append(-(self.residual(track, f, xi) - self.residual(track, f, -xi)) / (2 * step))
        return np.stack(by_clones, axis=1), by_point, self.residual(track, f, zero)


def test_triangulation_finds_exact_points_and_minimises_the_reprojection_error_of_noisy_ones():
    exact = Scene(sigma=0.0)
    found, _ = triangulate(*exact.flat(), exact.anchors)
    np.testing.assert_allclose(found, exact.f, atol=1e-6)
    assert in_front(*exact.flat()[:2], found, exact.flat()[3], 0.1, 60.0).all()
    assert not in_front(*exact.flat()[:2], found, exact.flat()[3], 0.1, 2.0).any()
    noisy = Scene(seed=1)
    found, _ = triangulate(*noisy.flat(), noisy.anchors)
    tracks = linearise(noisy.R, noisy.p, found, noisy.points, noisy.weights)
    # At the minimum the gradient FᵀR vanishes: a further step is far smaller than the point's own uncertainty.
    total = tracks.b.sum(axis=1)
    step = np.linalg.norm((tracks.G @ total[..., None])[..., 0], axis=1)
    assert (step < 0.02 * np.sqrt(np.trace(tracks.G, axis1=1, axis2=2))).all()


def test_rays_without_parallax_or_behind_give_no_point():
    scene = Scene(sigma=0.0)
    R, p, points, weights = scene.flat()
    still = np.broadcast_to(p[:1], p.shape)
    turned = np.broadcast_to(R[:1], R.shape)
    same = np.broadcast_to(points[:, :1], points.shape)
    found, _ = triangulate(turned, still, same, weights, scene.anchors)
    tracks = linearise(
        turned.reshape(scene.R.shape),
        still.reshape(scene.p.shape),
        found,
        same.reshape(scene.points.shape),
        scene.weights,
    )
    ray = found - still[0]
    spread = np.sqrt(np.einsum("ni,nij,nj->n", ray, tracks.G, ray)) / (ray**2).sum(axis=1)
    assert (~in_front(turned, still, found, weights, 0.1, 60.0) | (spread > 1.0)).all()
    assert widest_parallax(turned, same, weights, scene.anchors).max() < 1e-6
    # Rays that meet behind the cameras: swap their ends.
    mirrored = 2.0 * p.mean(axis=0) - p
    found, depth = triangulate(R, mirrored, points, weights, scene.anchors)
    assert np.isfinite(found).all() and np.isfinite(depth).all()


def test_projected_information_is_that_of_the_left_null_space():
    scene = Scene()
    found, _ = triangulate(*scene.flat(), scene.anchors)
    tracks = linearise(scene.R, scene.p, found, scene.points, scene.weights)
    wanted, right, squares, chi = 0.0, 0.0, [], []
    root = scene.rng.normal(0, 1e-3, (6 * CLONE_COUNT, 6 * CLONE_COUNT))
    P = root @ root.T
    for track in range(TRACKS):
        Hx, Hf, r = scene.dense(track, found[track])
        basis = np.linalg.svd(Hf)[0][:, 3:]
        A, b = basis.T @ Hx, basis.T @ r
        wanted, right = wanted + A.T @ A, right + A.T @ b
        squares.append(b @ b)
        chi.append(b @ np.linalg.solve(A @ P @ A.T + np.eye(len(b)), b))
    Lambda, eta = information(tracks)
    np.testing.assert_allclose(Lambda, wanted, atol=1e-4 * np.abs(wanted).max())
    np.testing.assert_allclose(eta, right, atol=1e-4 * np.abs(right).max())
    np.testing.assert_allclose(tracks.squares, squares, rtol=1e-4)
    np.testing.assert_allclose(chi_squares(tracks, P), chi, rtol=1e-3)
    assert (tracks.rows == 2 * (scene.weights > 0).sum(axis=(1, 2))).all()


def test_a_track_says_nothing_of_a_turn_or_shift_of_the_world():
    scene = Scene()
    found, _ = triangulate(*scene.flat(), scene.anchors)
    Lambda, eta = information(linearise(scene.R, scene.p, found, scene.points, scene.weights))
    scale = np.abs(Lambda).max()
    for axis in range(6):
        direction = np.tile(np.eye(6)[axis], CLONE_COUNT)
        assert np.abs(Lambda @ direction).max() < 1e-9 * scale
        assert abs(eta @ direction) < 1e-6 * np.abs(eta).max()


def state_of(scene, landmarks=5):
    state = FilterState(
        ImuNoise(gyro_noise=1e-3, gyro_walk=1e-4, accel_noise=1e-2, accel_walk=1e-3, rate_hz=200.0), 9.81
    )
    state.start(NavState(stamp_ns=0, T_world_body=np.eye(4), bias=ImuBias()), 1e-4 * np.eye(15), np.eye(4), np.eye(7))
    for R, p in zip(scene.R[0], scene.p[0], strict=True):
        state.add_clone(0.0, np.zeros(3))
        state.R_clones[-1], state.p_clones[-1] = R, p
    root = scene.rng.normal(0, 1e-2, state.covariance.shape)
    state.covariance = root @ root.T
    found, _ = triangulate(*scene.flat(), scene.anchors)
    tracks = linearise(scene.R, scene.p, found, scene.points, scene.weights).pick(np.arange(TRACKS) < landmarks)
    before = state.covariance.copy()
    by_clones = point_errors(tracks)
    add_landmarks(state, np.arange(landmarks), tracks.found, by_clones, tracks.G)
    return state, before, tracks, by_clones


def test_a_new_point_errs_as_its_observations_and_clones_do():
    scene = Scene()
    state, before, tracks, by_clones = state_of(scene)
    J = np.zeros((15, len(before)))
    J[:, CLONES:] = by_clones.reshape(15, -1)
    J[:, :3] = so3.hat(tracks.found).reshape(15, 3)
    noise = np.zeros((15, 15))
    for n in range(5):
        noise[3 * n : 3 * n + 3, 3 * n : 3 * n + 3] = tracks.G[n]
    np.testing.assert_allclose(state.covariance[-15:, -15:], J @ before @ J.T + noise, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(state.covariance[-15:, :-15], J @ before, rtol=1e-9, atol=1e-12)
    # Moving the clones moves the least-squares point as the Jacobian says.
    xi = scene.rng.normal(0, 1e-5, (CLONE_COUNT, 6))
    move = se3.exp(xi)
    R, p = move[:, :3, :3] @ scene.R, (move[:, :3, :3] @ scene.p[..., None])[..., 0] + move[:, :3, 3]
    again, _ = triangulate(
        R.reshape(-1, 3, 3), p.reshape(-1, 3), scene.flat()[2][:5], scene.flat()[3][:5], scene.anchors[:5]
    )
    np.testing.assert_allclose(
        (again - tracks.found).reshape(-1), by_clones.reshape(15, -1) @ xi.reshape(-1), atol=1e-5
    )


def moved(state, error):
    twin = deepcopy(state)
    twin.apply(error)
    return twin


def test_sightings_correct_as_the_dense_filter_does():
    scene = Scene()
    state, *_ = state_of(scene)
    R, p = scene.R[0, -1], scene.p[0, -1]

    def predict(s):
        X = (s.points - s.p_clones[-1]) @ s.R_clones[-1]
        return (X[:, :2] / X[:, 2:]).reshape(-1)

    H = np.zeros((10, len(state.covariance)))
    for column in range(len(state.covariance)):
        e = np.zeros(len(state.covariance))
        e[column] = 1e-6
        H[:, column] = WEIGHT * (predict(moved(state, e)) - predict(moved(state, -e))) / 2e-6
    measured = predict(state).reshape(-1, 2) + scene.rng.normal(0, 1.0 / WEIGHT, (5, 2))
    residual = WEIGHT * (measured.reshape(-1) - predict(state))
    P = state.covariance.copy()
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + np.eye(10))
    wanted = moved(state, K @ residual)
    sightings = Sightings(
        index=np.arange(5),
        R=np.broadcast_to(R, (5, 3, 3)),
        p=np.broadcast_to(p, (5, 3)),
        measured=measured,
        weights=np.full(5, WEIGHT),
    )
    assert correct_by_sightings(state, sightings, 1e9, 0.1).all()
    np.testing.assert_allclose(state.covariance, P - K @ H @ P, atol=1e-6)
    np.testing.assert_allclose(state.points, wanted.points, atol=1e-6)
    np.testing.assert_allclose(state.body.p, wanted.body.p, atol=1e-6)


def test_a_wrong_sighting_or_one_behind_is_refused_alone():
    scene = Scene()
    state, *_ = state_of(scene)
    X = (state.points - scene.p[0, -1]) @ scene.R[0, -1]
    measured = X[:, :2] / X[:, 2:]
    state.covariance *= 1e-6
    measured[1] += 0.5
    R = np.broadcast_to(scene.R[0, -1], (5, 3, 3)).copy()
    R[2] = R[2] @ np.diag([1.0, -1.0, -1.0])
    sightings = Sightings(
        index=np.arange(5),
        R=R,
        p=np.broadcast_to(scene.p[0, -1], (5, 3)),
        measured=measured,
        weights=np.full(5, WEIGHT),
    )
    np.testing.assert_array_equal(correct_by_sightings(state, sightings, 6.0, 0.1), [True, False, False, True, True])


@pytest.mark.parametrize("model", ["pinhole", "radtan", "equidistant"])
def test_pixel_noise_is_what_the_undistortion_makes_of_a_pixel(model):
    camera = make_rig(model).cameras[0]
    pixels = np.array([[376.0, 240.0], [60.0, 60.0], [700.0, 420.0], [200.0, 400.0]])
    bearings = projection.bearings(camera, pixels)
    points, weights = PixelNoise(camera, 0.5).measure(pixels, bearings)
    np.testing.assert_allclose(points, bearings[:, :2] / bearings[:, 2:])
    rng = np.random.default_rng(0)
    for pixel, weight in zip(pixels, weights, strict=True):
        noisy = projection.normalised(camera, pixel + 0.5 * rng.standard_normal((4000, 2)))
        assert 1.0 / weight == pytest.approx(np.sqrt(noisy.var(axis=0).mean()), rel=0.15)


def test_rays_far_off_the_axis_weigh_nothing():
    camera = make_rig().cameras[0]
    bearings = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.05], [0.0, 0.6, -0.8]])
    bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
    _, weights = PixelNoise(camera, 0.5).measure(np.full((3, 2), 300.0), bearings)
    np.testing.assert_array_equal(weights > 0.0, [True, False, False])


def test_table_keeps_observations_by_clone_and_forgets_what_was_dropped():
    table = TrackTable(2, 4)
    rng = np.random.default_rng(0)
    kept = {}
    for column, ids in enumerate(([7, 3, 5], [5, 9, 3], [9, 3])):
        ids = np.array(ids)
        points = rng.normal(size=(len(ids), 2))
        table.begin_image()
        table.add(0, column, ids, points, np.ones(len(ids)))
        table.add(1, column, np.array([3, 1000]), points[:2] + 1.0, np.ones(2))
        kept.update({(i, column): point for i, point in zip(ids.tolist(), points, strict=True)})
    np.testing.assert_array_equal(table.ids, [3, 5, 7, 9])
    np.testing.assert_array_equal(table.seen, [True, False, False, True])
    for (i, column), point in kept.items():
        row = int(np.flatnonzero(table.ids == i)[0])
        np.testing.assert_array_equal(table.points[row, 0, column], point)
    assert (table.weights[0, 1, :3] == 1.0).all()
    table.drop_column(0)
    np.testing.assert_array_equal(table.ids, [3, 5, 9])
    np.testing.assert_array_equal(table.points[1, 0, 0], kept[5, 1])
    table.drop_rows(table.ids == 5)
    np.testing.assert_array_equal(table.ids, [3, 9])
