"""Stereo odometry: metric on synthetic tracks; the matcher on drawn and on real image pairs."""

from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from shared_data import shared_data
from synthetic_tracks import R_BODY_CAM, Scene, make_rig, make_room, make_walk, run
from vioframe.errors import ConfigError, DataError, ShapeError, StateError
from vioframe.geometry import camera as projection
from vioframe.geometry import se3, so3
from vioframe.interfaces import METRIC_SCALE, STEREO, TRACKS
from vioframe.types import Camera, Frame, SensorRig, Tracks, VisualFeatures
from vioframe_geometric import StereoVO
from vioframe_geometric.stereo import StereoMatcher
from vioframe_klt import KltFrontend

RIG = make_rig()


class KnownMatches(StereoMatcher):
    """Second views from the scene instead of from images."""

    scene: Scene

    def match(self, frame, tracks, inverse_depth):
        return self.scene.pairs[frame.stamp_ns]


def drive(monkeypatch, scene, **options):
    KnownMatches.scene = scene
    monkeypatch.setattr("vioframe_geometric.stereo.StereoMatcher", KnownMatches)
    return run(StereoVO(**options), scene)


def test_what_it_needs_and_gives():
    assert StereoVO.requires == {TRACKS, STEREO}
    assert METRIC_SCALE in StereoVO.provides


def test_a_walk_is_measured_in_metres(monkeypatch):
    result = drive(monkeypatch, Scene(RIG, make_walk(250, seed=1), make_room(1), seed=1))
    assert result.valid.all()
    assert np.linalg.norm(result.chain[-1, :3, 3] - result.truth[-1, :3, 3]) < 0.004 * result.path
    assert np.degrees(so3.angle(result.chain[-1, :3, :3].T @ result.truth[-1, :3, :3])) < 1.0
    assert result.aligned()[0] == pytest.approx(1.0, abs=0.003)
    assert 0.4 < result.nees().mean() < 1.5


def test_exact_without_noise(monkeypatch):
    result = drive(monkeypatch, Scene(RIG, make_walk(60, seed=2), make_room(2), sigma_px=0.0, seed=2))
    assert np.abs(result.chain[:, :3, 3] - result.truth[:, :3, 3]).max() < 2e-3


def test_outliers_are_survived(monkeypatch):
    result = drive(monkeypatch, Scene(RIG, make_walk(120, seed=3), make_room(3), outliers=0.1, lose=0.06, seed=3))
    assert result.valid.all()
    assert np.linalg.norm(result.chain[-1, :3, 3] - result.truth[-1, :3, 3]) < 0.01 * result.path


def test_turning_and_standing_are_no_motion(monkeypatch):
    T = np.tile(make_walk(1), (40, 1, 1))
    T[20:, :3, :3] = T[0, :3, :3] @ so3.rotation_z(0.04 * np.arange(20))
    result = drive(monkeypatch, Scene(RIG, T, make_room(4), seed=4))
    assert result.valid.all()
    assert np.linalg.norm(result.chain[:, :3, 3], axis=-1).max() < 0.03


def test_a_loss_is_told_and_counted(monkeypatch):
    scene = Scene(RIG, make_walk(60, seed=5), make_room(5), seed=5, blind=(30, 31))
    KnownMatches.scene = scene
    monkeypatch.setattr("vioframe_geometric.stereo.StereoMatcher", KnownMatches)
    vo = StereoVO()
    result = run(vo, scene)
    assert not result.valid[29:32].any()
    assert result.valid[32:].all() and result.valid[:29].all()
    assert vo.counters()["stereo restarts"] >= 1


def draw_pair(rig, seed=0):
    """A slanted textured plane seen by both cameras, and its depth in camera 0 at any ray."""
    rng = np.random.default_rng(seed)
    texture = sum(
        2.0**-k * cv2.resize(rng.standard_normal((64 * 2**k, 64 * 2**k)), (1024, 1024), interpolation=cv2.INTER_CUBIC)
        for k in range(4)
    ).astype(np.float32)
    texture = np.clip(128 + 45 * texture / texture.std(), 0, 255)
    normal, offset = np.array([0.25, 0.1, 1.0]), 2.5
    images = []
    T_cam0_cam1 = se3.inverse(rig.cameras[0].T_body_cam) @ rig.cameras[1].T_body_cam
    for camera, T in zip(rig.cameras, (np.eye(4), T_cam0_cam1), strict=True):
        columns, rows = np.meshgrid(np.arange(752.0), np.arange(480.0))
        rays = projection.bearings(camera, np.stack([columns, rows], axis=-1)) @ T[:3, :3].T
        length = (offset - normal @ T[:3, 3]) / (rays @ normal)
        hit = T[:3, 3] + length[..., None] * rays
        u, v = ((hit[..., axis] + 4.0) * 128.0 for axis in (0, 1))
        image = cv2.remap(
            texture, u.astype(np.float32), v.astype(np.float32), cv2.INTER_CUBIC, borderMode=cv2.BORDER_WRAP
        )
        images.append(np.clip(np.rint(image), 0, 255).astype(np.uint8))
    return tuple(images), lambda bearings: offset / (bearings @ normal) * bearings[:, 2]


def matcher(rig, **options):
    settings = {"min_depth": 0.4, "window_px": 15, "levels": 3, "epipolar_px": 1.5, "forward_backward_px": 0.7}
    return StereoMatcher(rig.cameras[0], rig.cameras[1], **(settings | options))


def test_matches_of_an_unrectified_pair_have_the_right_depth():
    images, depth_at = draw_pair(RIG)
    # The second camera exposes for itself.
    images = images[0], np.clip(0.6 * images[1].astype(float) + 20, 0, 255).astype(np.uint8)
    frontend = KltFrontend(normalise_exposure=False)
    frontend.setup(RIG)
    tracks = frontend.process(Frame(stamp_ns=0, images=images)).tracks
    matching = matcher(RIG)
    bearings, found = matching.match(Frame(stamp_ns=0, images=images), tracks, np.full(len(tracks), np.nan))
    assert found.mean() > 0.8
    T = matching.T_left_right
    across = np.cross(bearings @ T[:3, :3].T, T[:3, 3])
    ray = tracks.bearings / tracks.bearings[:, 2:]
    inverse_depth = np.sum(np.cross(bearings @ T[:3, :3].T, ray) * across, axis=-1) / np.sum(across**2, axis=-1)
    # 0.1 px of disparity over f·b = 50 px·m.
    error = np.abs(inverse_depth - 1 / depth_at(tracks.bearings))[found]
    assert np.median(error) < 0.002
    assert np.percentile(error, 95) < 0.02


def real_pair(index):
    folder = Path(shared_data("euroc_V1_01_micro", "mav0"))
    images = []
    for camera in ("cam0", "cam1"):
        path = sorted((folder / camera / "data").glob("*.png"))[index]
        images.append(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
    return tuple(images)


EUROC = SensorRig(
    cameras=tuple(
        Camera(
            model="radtan",
            intrinsics_px=np.array(intrinsics),
            distortion=np.array(distortion),
            size_px=(752, 480),
            T_body_cam=np.array(T),
        )
        for intrinsics, distortion, T in (
            (
                [458.654, 457.296, 367.215, 248.375],
                [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05],
                [
                    [0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975],
                    [0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768],
                    [-0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949],
                    [0.0, 0.0, 0.0, 1.0],
                ],
            ),
            (
                [457.587, 456.134, 379.999, 255.238],
                [-0.28368365, 0.07451284, -0.00010473, -3.55590700e-05],
                [
                    [0.0125552670891, -0.999755099723, 0.0182237714554, -0.0198435579556],
                    [0.999598781151, 0.0130119051815, 0.0251588363115, 0.0453689425024],
                    [-0.0253898008918, 0.0179005838253, 0.999517347078, 0.00786212447038],
                    [0.0, 0.0, 0.0, 1.0],
                ],
            ),
        )
    ),
    imu=RIG.imu,
)


def test_a_real_vehicle_that_stands_does_not_move():
    frontend, vo = KltFrontend(), StereoVO()
    frontend.setup(EUROC)
    vo.setup(EUROC)
    seen = [frontend.process(Frame(stamp_ns=k, images=real_pair(k))) for k in range(20)]
    motions = [vo.estimate(a, b) for a, b in pairwise(seen)]
    assert all(motion.valid for motion in motions)
    T = np.eye(4)
    for motion in motions:
        T = T @ motion.T_prev_cur
        assert np.linalg.norm(T[:3, 3]) < 0.02


def features(images):
    nothing = Tracks(
        ids=np.zeros(0, dtype=np.int64), pixels=np.zeros((0, 2)), bearings=np.zeros((0, 3)), scores=np.zeros(0)
    )
    return VisualFeatures(frame=Frame(stamp_ns=5, images=images), tracks=nothing)


def test_wrong_use_is_named():
    blank = np.zeros((480, 752), np.uint8)
    vo = StereoVO()
    with pytest.raises(StateError, match="setup"):
        vo.estimate(features((blank, blank)), features((blank, blank)))
    with pytest.raises(DataError, match="needs two cameras"):
        vo.setup(make_rig(cameras=1))
    vo.setup(RIG)
    with pytest.raises(DataError, match=r"1 image\(s\), and vo=stereo needs two"):
        vo.estimate(features((blank,)), features((blank,)))
    with pytest.raises(ShapeError, match="camera 1 .* is 100×90 px"):
        vo.estimate(features((blank, np.zeros((90, 100), np.uint8))), features((blank, blank)))
    assert not vo.estimate(features((blank, blank)), features((blank, blank))).valid
    same = SensorRig(cameras=(RIG.cameras[0], RIG.cameras[0]), imu=RIG.imu)
    with pytest.raises(DataError, match="apart"):
        vo.setup(same)


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("sigma_px", 0.0),
        ("min_points", 2),
        ("min_depth", 0.0),
        ("window_px", 8),
        ("levels", 9),
        ("epipolar_px", 0.0),
        ("forward_backward_px", 0.0),
        ("drift_px", -1.0),
        ("covariance_scale", 0.0),
    ],
)
def test_an_option_out_of_range_is_named(option, value):
    with pytest.raises(ConfigError, match=rf"vo\.{option} must .* got {value}"):
        StereoVO(**{option: value})


def test_axes_of_the_rig_are_those_of_the_conventions():
    assert np.allclose(R_BODY_CAM @ [0, 0, 1], [1, 0, 0])
