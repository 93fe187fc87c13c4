"""The KLT front end in two cameras, on a scene whose depth is known."""

import cv2
import numpy as np
import pytest

from vioframe.errors import DataError, ShapeError, WiringError
from vioframe.geometry import camera as projection
from vioframe.geometry import se3, so3
from vioframe.interfaces import STEREO_TRACKS, TRACKS
from vioframe.pipeline import check_rig, check_wiring
from vioframe.types import Camera, Frame, ImuNoise, SensorRig
from vioframe_klt import KltFrontend

SIZE = (376, 240)
NOISE = ImuNoise(gyro_noise=1e-4, gyro_walk=1e-5, accel_noise=1e-3, accel_walk=1e-4, rate_hz=200.0)
R_BODY_CAM = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
WALL_M = 3.0


def make_rig(count=2):
    # Neither rectified nor of one model: the second camera is turned by some degrees.
    lenses = [("radtan", [-0.28, 0.07, 2e-4, 2e-5], [0.0, 0.0, 0.0]), ("equidistant", [0.0] * 4, [0.02, -0.03, 0.04])]
    cameras = tuple(
        Camera(
            model=model,
            intrinsics_px=np.array([229.0, 228.5, 183.0, 124.0]),
            distortion=np.array(distortion),
            size_px=SIZE,
            T_body_cam=se3.from_parts(R_BODY_CAM @ so3.exp(np.array(turn)), np.array([0.0, 0.055 - 0.11 * k, 0.0])),
        )
        for k, (model, distortion, turn) in enumerate(lenses)
    )
    return SensorRig(cameras=cameras[:count], imu=NOISE)


def texture(seed=4):
    rng = np.random.default_rng(seed)
    image = sum(
        2.0**-k * cv2.resize(rng.standard_normal((30 * 2**k, 40 * 2**k)), (2000, 1500), interpolation=cv2.INTER_CUBIC)
        for k in range(4)
    )
    return np.clip(128 + 45 * image / image.std(), 0, 255).astype(np.float32)


TEXTURE = texture()


def wall_points(camera, T_world_body, pixels):
    """Where rays meet the wall x = WALL_M of the world."""
    T_world_cam = T_world_body @ camera.T_body_cam
    rays = projection.bearings(camera, pixels) @ T_world_cam[:3, :3].T
    return T_world_cam[:3, 3] + rays * ((WALL_M - T_world_cam[0, 3]) / rays[..., 0])[..., None]


def view(camera, T_world_body):
    columns, rows = np.meshgrid(np.arange(SIZE[0], dtype=float), np.arange(SIZE[1], dtype=float))
    points = wall_points(camera, T_world_body, np.stack([columns, rows], axis=-1))
    u, v = (1000 + points[..., 1] * 180).astype(np.float32), (750 + points[..., 2] * 180).astype(np.float32)
    image = cv2.remap(TEXTURE, u, v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def frames(rig, count):
    for k in range(count):
        T_world_body = se3.from_parts(so3.exp(np.array([0.02, 0.01, 0.015]) * k), np.array([0.05, 0.04, 0.02]) * k)
        yield Frame(stamp_ns=k, images=tuple(view(camera, T_world_body) for camera in rig.cameras)), T_world_body


def test_points_are_found_where_the_other_camera_sees_them():
    rig = make_rig()
    frontend = KltFrontend(stereo=True, max_points=80)
    frontend.setup(rig)
    before = np.eye(4)
    for frame, T_world_body in frames(rig, 8):
        features = frontend.process(frame, before[:3, :3].T @ T_world_body[:3, :3])
        before = T_world_body
        tracks, stereo = features.tracks, features.stereo
        assert stereo.camera == 1
        assert set(stereo.ids) <= set(tracks.ids)
        rows = np.searchsorted(tracks.ids, stereo.ids)
        points = wall_points(rig.cameras[0], T_world_body, tracks.pixels[rows])
        T_cam1_world = se3.inverse(T_world_body @ rig.cameras[1].T_body_cam)
        expected, seen = projection.project(rig.cameras[1], se3.transform(T_cam1_world, points))
        error = np.linalg.norm(stereo.pixels - expected, axis=-1)
        assert len(stereo) > 0.75 * len(tracks) > 40
        assert seen.all()
        assert np.median(error) < 0.06
        assert error.max() < 0.6
        assert np.allclose(stereo.bearings, projection.bearings(rig.cameras[1], stereo.pixels))


def test_nothing_is_found_in_a_camera_that_sees_something_else():
    rig = make_rig()
    frontend = KltFrontend(stereo=True, max_points=80)
    frontend.setup(rig)
    frame, _ = next(frames(rig, 1))
    elsewhere = view(rig.cameras[1], se3.from_parts(np.eye(3), np.array([0.0, 3.0, 1.5])))
    features = frontend.process(Frame(stamp_ns=0, images=(frame.images[0], elsewhere)))
    assert len(features.tracks) > 40
    assert len(features.stereo) <= 4
    covered = frontend.process(Frame(stamp_ns=1, images=(frame.images[0], np.zeros(SIZE[::-1], np.uint8))))
    assert len(covered.stereo) == 0


def test_what_it_needs_and_gives_depends_on_the_option():
    assert KltFrontend().provides == {TRACKS}
    stereo = KltFrontend(stereo=True)
    assert stereo.provides == {TRACKS, STEREO_TRACKS}
    check_wiring({"frontend": stereo}, {"frontend": "klt"})
    with pytest.raises(WiringError, match="frontend=klt needs the images of 2 cameras, but the recording gives 1"):
        check_rig({"frontend": stereo}, make_rig(1), {"frontend": "klt"})


def test_a_missing_or_wrong_second_camera_is_told_in_a_sentence():
    frontend = KltFrontend(stereo=True)
    with pytest.raises(DataError, match=r"stereo=true needs two cameras, but the recording's calibration has 1"):
        frontend.setup(make_rig(1))
    rig = make_rig()
    frontend.setup(rig)
    frame, _ = next(frames(rig, 1))
    with pytest.raises(DataError, match="has 1 image, and frontend=klt needs two where stereo=true"):
        frontend.process(Frame(stamp_ns=0, images=frame.images[:1]))
    with pytest.raises(ShapeError, match="image of camera 1 at 5 ns is 300×200 px, but its calibration says 376×240"):
        frontend.process(Frame(stamp_ns=5, images=(frame.images[0], np.zeros((200, 300), np.uint8))))
    same = SensorRig(cameras=(rig.cameras[0], rig.cameras[0]), imu=NOISE)
    with pytest.raises(DataError, match="apart from each other"):
        frontend.setup(same)
