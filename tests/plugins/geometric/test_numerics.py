"""Errors, Jacobians, pose fit, landmarks and bundle against finite differences and known noise."""

import numpy as np
import pytest

from synthetic_tracks import make_rig, make_room, make_walk, see
from vioframe.geometry import camera as projection
from vioframe.geometry import se3, so3
from vioframe_geometric.bundle import BundleProblem, adjust, linearise
from vioframe_geometric.epipolar import Pairs, pair, sampson, tangents_of
from vioframe_geometric.landmarks import Landmarks
from vioframe_geometric.pose import View, fit_pose, pose_jacobian, whiten
from vioframe_geometric.rays import observe, residuals
from vioframe_geometric.stereo import stereo_inverse_depth

STEP = 1e-6
MODELS = ["pinhole", "radtan", "equidistant"]


def cloud(rng, count=60):
    depth = rng.uniform(2.0, 8.0, (count, 1))
    return np.concatenate([rng.uniform([-0.6, -0.4], [0.6, 0.4], (count, 2)) * depth, depth], axis=1)


def everywhere(count):
    return np.ones(count, dtype=bool)


@pytest.mark.parametrize("model", MODELS)
def test_the_error_is_the_reprojection_error_in_pixels(model):
    rng = np.random.default_rng(0)
    rig = make_rig(model)
    points = cloud(rng)
    T_cam0_cam1 = se3.inverse(rig.cameras[0].T_body_cam) @ rig.cameras[1].T_body_cam
    for camera, T_cam0_cam in zip(rig.cameras, (np.eye(4), T_cam0_cam1), strict=True):
        local = se3.transform(se3.inverse(T_cam0_cam), points)
        pixels, _ = projection.project(camera, local)
        off = rng.uniform(-1.0, 1.0, pixels.shape)
        rays = observe(camera, projection.bearings(camera, pixels - off), T_cam0_cam)
        error, _, ahead = residuals(rays, points)
        assert ahead.all()
        # First order: a pixel off leaves second-order terms of a few hundredths.
        assert np.abs(error - off).max() < 0.02
        exact, _, _ = residuals(observe(camera, projection.bearings(camera, pixels), T_cam0_cam), points)
        assert np.abs(exact).max() < 1e-7


def test_points_behind_the_camera_are_told():
    rays = observe(make_rig().cameras[0], np.array([[0.0, 0.0, 1.0]]))
    assert not residuals(rays, np.array([[0.0, 0.0, -2.0]]))[2][0]


def test_slopes_of_error_pose_and_landmark():
    rng = np.random.default_rng(1)
    rig = make_rig()
    points = cloud(rng)
    rays = observe(rig.cameras[0], projection.bearings(rig.cameras[0], rng.uniform(100, 400, (len(points), 2))))
    error, slope, _ = residuals(rays, points)
    for axis in range(3):
        moved, _, _ = residuals(rays, points + STEP * np.eye(3)[axis])
        assert np.abs((moved - error) / STEP - slope[..., axis]).max() < 1e-3 * np.abs(slope).max()
    T = se3.exp(rng.standard_normal(6))
    local = se3.transform(se3.inverse(T), points)
    for axis in range(6):
        shifted = se3.transform(se3.inverse(T @ se3.exp(STEP * np.eye(6)[axis])), points)
        assert np.abs((shifted - local) / STEP - pose_jacobian(local)[..., axis]).max() < 1e-4
    landmarks = Landmarks(1e-3)
    ideal = rng.uniform(-0.5, 0.5, (20, 2))
    landmarks.add(np.arange(20), T, ideal, rng.uniform(0.1, 1.0, 20), np.tile(np.eye(3), (20, 1, 1)))
    index = np.arange(20)
    before, slopes = landmarks.points(index), landmarks.slopes(index)
    for axis in range(3):
        q = landmarks.q.copy()
        landmarks.q = q + STEP * np.eye(3)[axis]
        assert np.abs((landmarks.points(index) - before) / STEP - slopes[..., axis]).max() < 1e-2
        landmarks.q = q


def test_slope_of_the_epipolar_error():
    rng = np.random.default_rng(2)
    camera = make_rig().cameras[0]
    points = cloud(rng)
    R, t = so3.exp(0.1 * rng.standard_normal(3)), np.array([0.6, 0.0, 0.8])
    seen = (points - t) @ R
    pairs = pair(camera, points / np.linalg.norm(points, axis=1)[:, None], seen / np.linalg.norm(seen, axis=1)[:, None])
    error, slope, _ = sampson(pairs, R, t)
    assert np.abs(error).max() < 1e-12
    for axis in range(3):
        turned, _, _ = sampson(pairs, R @ so3.exp(STEP * np.eye(3)[axis]), t)
        assert np.abs((turned - error) / STEP - slope[:, axis]).max() < 1e-4
        moved, _, _ = sampson(pairs, R, t + STEP * np.eye(3)[axis])
        assert np.abs((moved - error) / STEP - slope[:, 3 + axis]).max() < 1e-4
    tangents = tangents_of(t)
    assert np.allclose(tangents.T @ np.column_stack([tangents, t]), np.eye(2, 3), atol=1e-12)


def test_the_sampson_distance_is_in_pixels():
    """Its standard deviation under pixel noise of σ in both images is σ."""
    rng = np.random.default_rng(3)
    camera = make_rig().cameras[0]
    T = se3.exp(np.array([0.02, -0.05, 0.01, 0.3, 0.1, 0.2]))
    points = cloud(rng, 4000)
    seen = se3.transform(se3.inverse(T), points)
    z = [projection.project(camera, p)[0] + 0.4 * rng.standard_normal((4000, 2)) for p in (points, seen)]
    pairs = pair(camera, *(projection.bearings(camera, pixels) for pixels in z))
    error, _, length = sampson(pairs, T[:3, :3], T[:3, 3] / np.linalg.norm(T[:3, 3]))
    assert np.std(error / length) == pytest.approx(0.4, rel=0.05)
    assert isinstance(pairs, Pairs)


def views_of(rig, pixels_of, seen):
    T_cam0_cam1 = se3.inverse(rig.cameras[0].T_body_cam) @ rig.cameras[1].T_body_cam
    return [
        View(rays=observe(camera, projection.bearings(camera, pixels), T), seen=live)
        for camera, pixels, T, live in zip(rig.cameras, pixels_of, (np.eye(4), T_cam0_cam1), seen, strict=True)
    ]


def project_both(rig, T_ref_cam, points):
    T_cam0_cam1 = se3.inverse(rig.cameras[0].T_body_cam) @ rig.cameras[1].T_body_cam
    return [
        projection.project(camera, se3.transform(se3.inverse(T_ref_cam @ T), points))[0]
        for camera, T in zip(rig.cameras, (np.eye(4), T_cam0_cam1), strict=True)
    ]


def test_a_pose_is_found_exactly_without_noise():
    rng = np.random.default_rng(4)
    rig = make_rig("equidistant")
    points, T = cloud(rng), se3.exp(0.2 * rng.standard_normal(6))
    views = views_of(rig, project_both(rig, T, points), [everywhere(60), rng.random(60) < 0.5])
    fit = fit_pose(T @ se3.exp(0.05 * rng.standard_normal(6)), points, views, sigma_px=0.5, iterations=30)
    assert np.abs(se3.log(se3.inverse(fit.T_ref_cam) @ T)).max() < 1e-5


def test_a_fifth_of_outliers_moves_the_pose_little():
    rng = np.random.default_rng(5)
    rig = make_rig()
    points, T = cloud(rng, 100), se3.exp(0.1 * rng.standard_normal(6))
    pixels = project_both(rig, T, points)
    pixels[0][:20] += rng.uniform(-40, 40, (20, 2))
    views = views_of(rig, pixels, [everywhere(100), ~everywhere(100)])
    fit = fit_pose(T @ se3.exp(0.02 * rng.standard_normal(6)), points, views, sigma_px=0.5, iterations=30)
    assert np.abs(se3.log(se3.inverse(fit.T_ref_cam) @ T)).max() < 1e-3


def test_the_covariance_of_a_pose_is_honest():
    """NEES a degree of freedom, with noise in the pixels and in points of a stated covariance, over 150 draws."""
    rng = np.random.default_rng(6)
    rig = make_rig("pinhole")
    nees = []
    for _ in range(150):
        points, T = cloud(rng), se3.exp(0.05 * rng.standard_normal(6))
        pixels = [p + 0.5 * rng.standard_normal(p.shape) for p in project_both(rig, T, points)]
        # Depth much less certain than direction, as of young landmarks.
        ray = points / np.linalg.norm(points, axis=1)[:, None]
        deviation = 0.05 * points[:, 2]
        root = deviation[:, None, None] * ray[:, :, None] * ray[:, None] + 1e-5 * np.eye(3)
        known = points + (deviation * rng.standard_normal(60))[:, None] * ray
        views = views_of(rig, pixels, [everywhere(60), everywhere(60)])
        fit = fit_pose(T, known, views, sigma_px=0.5, point_root=root, robust_scale=100.0)
        error = se3.log(se3.inverse(fit.T_ref_cam) @ T)
        nees.append(error @ fit.information @ error / 6)
    # χ² with 900 degrees of freedom: ±0.14 is three standard deviations; linearisation takes the rest.
    assert 0.82 < np.mean(nees) < 1.25


def test_whitening_is_the_root_of_the_inverse():
    rng = np.random.default_rng(7)
    slope = rng.standard_normal((5, 4, 3))
    root = rng.standard_normal((5, 3, 3))
    P = root @ np.swapaxes(root, -1, -2)
    W = whiten(slope, 0.3, root)
    total = slope @ P @ np.swapaxes(slope, -1, -2) + 0.09 * np.eye(4)
    assert np.allclose(np.swapaxes(W, -1, -2) @ W, np.linalg.inv(total))


def test_landmarks_converge_with_an_honest_covariance():
    rng = np.random.default_rng(8)
    camera = make_rig().cameras[0]
    points = cloud(rng, 300)
    landmarks = Landmarks(1e-3)
    pixels = projection.project(camera, points)[0] + 0.3 * rng.standard_normal((300, 2))
    rays = observe(camera, projection.bearings(camera, pixels))
    covariance = np.zeros((300, 3, 3))
    inverse_slope = np.linalg.inv(rays.rows[:, :, :2] * rays.axes[:, 2:, None])
    covariance[:, :2, :2] = 0.09 * inverse_slope @ np.swapaxes(inverse_slope, -1, -2)
    covariance[:, 2, 2] = 0.2**2
    landmarks.add(np.arange(300), np.eye(4), rays.axes[:, :2] / rays.axes[:, 2:], np.full(300, 0.2), covariance)
    for step in range(1, 16):
        T = se3.exp(np.array([0.0, 0.01, 0.0, 0.04, 0.01, 0.02]) * step)
        pixels = projection.project(camera, se3.transform(se3.inverse(T), points))[0]
        pixels += 0.3 * rng.standard_normal(pixels.shape)
        view = View(rays=observe(camera, projection.bearings(camera, pixels)), seen=everywhere(300))
        landmarks.update(np.arange(300), T, [view], sigma_px=0.3)
    good = landmarks.strikes == 0
    assert good.mean() > 0.95
    error = landmarks.points(np.arange(300)) - points
    assert np.median(np.linalg.norm(error, axis=1) / points[:, 2]) < 0.02
    nees = np.einsum("mi,mij,mj->m", error, np.linalg.inv(landmarks.point_covariance(np.arange(300))), error)[good] / 3
    assert 0.5 < np.median(nees) / 0.789 < 2.0


def test_rescaling_changes_no_direction():
    rng = np.random.default_rng(9)
    landmarks = Landmarks(1e-6)
    landmarks.add(
        np.arange(10),
        se3.exp(rng.standard_normal(6)),
        rng.uniform(-0.5, 0.5, (10, 2)),
        rng.uniform(0.2, 1.0, 10),
        np.tile(0.01 * np.eye(3), (10, 1, 1)),
    )
    centre = np.array([1.0, 2.0, 3.0])
    points, covariance = landmarks.points(np.arange(10)), landmarks.point_covariance(np.arange(10))
    landmarks.rescale(2.5, centre)
    assert np.allclose(landmarks.points(np.arange(10)) - centre, 2.5 * (points - centre))
    # Anisotropic q: only the depth direction scales twice through the slope, so compare the whole matrix.
    assert np.allclose(landmarks.point_covariance(np.arange(10)), 2.5**2 * covariance)


def test_stereo_depth_of_exact_rays_is_exact():
    rng = np.random.default_rng(10)
    rig = make_rig()
    points = cloud(rng)
    left, right = views_of(rig, project_both(rig, np.eye(4), points), [everywhere(60), everywhere(60)])
    assert np.allclose(stereo_inverse_depth(left.rays, right.rays), 1 / points[:, 2], rtol=1e-4)


def make_bundle(rng, views=7, most=80, sigma_px=0.3, noise=True):
    camera = make_rig().cameras[0]
    T = make_walk(300, seed=1)[60 : 60 + 6 * views : 6] @ camera.T_body_cam
    points = make_room(1)
    pixels, visible = (np.stack(part) for part in zip(*(see(camera, pose, points) for pose in T), strict=True))
    chosen = np.flatnonzero(visible.sum(axis=0) >= 3)[:most]
    seen, pixels, points = visible[:, chosen], pixels[:, chosen], points[chosen]
    pixels = pixels + noise * sigma_px * rng.standard_normal(pixels.shape)
    first = np.argmax(seen, axis=0)
    local = np.einsum("mji,mj->mi", T[first, :3, :3], points - T[first, :3, 3])
    q = np.concatenate([local[:, :2], np.ones((len(chosen), 1))], axis=1) / local[:, 2:]
    start = T @ se3.exp(0.01 * rng.standard_normal((views, 6)))
    start[:2] = T[:2]
    rough = q * (1 + np.array([0, 0, 0.15]) * rng.standard_normal((len(chosen), 1)))
    problem = BundleProblem(
        T_map_cam=start,
        free=np.arange(views) >= 2,
        origins=T[first, :3, 3],
        rotations=T[first, :3, :3],
        q=rough,
        prior_q=rough,
        prior_information=np.zeros((len(chosen), 3, 3)),
        rays=observe(camera, projection.bearings(camera, pixels.reshape(-1, 2))),
        seen=seen,
        sigma_px=sigma_px,
        min_inverse_depth=1e-4,
    )
    return problem, T, q


def test_slopes_of_the_bundle():
    problem, _, _ = make_bundle(np.random.default_rng(11))
    error, by_pose, by_q, _ = linearise(problem, problem.T_map_cam, problem.q)
    for axis in range(6):
        moved = linearise(problem, problem.T_map_cam @ se3.exp(STEP * np.eye(6)[axis]), problem.q)[0]
        assert np.abs((moved - error) / STEP - by_pose[..., axis]).max() < 1e-4 * np.abs(by_pose).max()
    for axis in range(3):
        moved = linearise(problem, problem.T_map_cam, problem.q + STEP * np.eye(3)[axis])[0]
        assert np.abs((moved - error) / STEP - by_q[..., axis]).max() < 1e-4 * np.abs(by_q).max()


def test_the_bundle_finds_the_truth_without_noise():
    problem, T, q = make_bundle(np.random.default_rng(12), noise=False)
    result = adjust(problem, iterations=30)
    assert np.abs(se3.log(se3.inverse(result.T_map_cam) @ T)).max() < 1e-4
    assert np.abs(result.q - q).max() < 1e-3
    assert np.array_equal(result.T_map_cam[:2], problem.T_map_cam[:2])


def test_the_covariances_of_the_bundle_are_honest():
    rng = np.random.default_rng(13)
    poses, points = [], []
    for _ in range(12):
        problem, T, q = make_bundle(rng)
        result = adjust(problem, iterations=15, robust_scale=50.0)
        assert result.cost <= result.cost_before
        error = se3.log(se3.inverse(result.T_map_cam) @ T)[2:].ravel()
        poses.append(error @ np.linalg.solve(result.pose_covariance, error) / len(error))
        off = result.q - q
        points.append(np.mean(np.einsum("mi,mij,mj->m", off, np.linalg.inv(result.q_covariance), off)) / 3)
    assert 0.8 < np.mean(poses) < 1.25
    assert 0.8 < np.mean(points) < 1.3


def test_a_prior_holds_a_point_that_is_hardly_seen():
    problem, _, q = make_bundle(np.random.default_rng(14))
    strong = np.tile(1e8 * np.eye(3), (len(q), 1, 1))
    held = BundleProblem(
        **{
            name: getattr(problem, name)
            for name in BundleProblem.__dataclass_fields__
            if name not in ("prior_q", "prior_information")
        },
        prior_q=q,
        prior_information=strong,
    )
    assert np.abs(adjust(held, iterations=20).q - q).max() < 1e-3
