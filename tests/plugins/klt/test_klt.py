"""The KLT front end on images whose motion is known exactly."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from shared_data import shared_data
from vioframe.errors import ConfigError, DataError, ShapeError, StateError
from vioframe.geometry import camera as projection
from vioframe.geometry import so3
from vioframe.types import Camera, Frame, ImuNoise, SensorRig
from vioframe.vision.corners import CornerDetector
from vioframe.vision.outliers import epipolar_inliers
from vioframe_klt import KltFrontend

SIZE = (376, 240)
NOISE = ImuNoise(gyro_noise=1e-4, gyro_walk=1e-5, accel_noise=1e-3, accel_walk=1e-4, rate_hz=200.0)
# Camera x to the right is body -y, y down is body -z, z forward is body x.
R_BODY_CAM = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def make_rig(model="radtan"):
    distortion = {"pinhole": [], "radtan": [-0.28, 0.07, 2e-4, 2e-5], "equidistant": [0.01, -0.01, 0.004, -0.001]}
    T_body_cam = np.eye(4)
    T_body_cam[:3, :3] = R_BODY_CAM
    camera = Camera(
        model=model,
        intrinsics_px=np.array([229.0, 228.5, 183.0, 124.0]),
        distortion=np.array(distortion[model]),
        size_px=SIZE,
        T_body_cam=T_body_cam,
    )
    return SensorRig(cameras=(camera,), imu=NOISE)


def sky(seed=3):
    """A smooth random texture on a cylinder of directions, (H, W) float in [0, 255]."""
    rng = np.random.default_rng(seed)
    image = sum(
        2.0**-k * cv2.resize(rng.standard_normal((40 * 2**k, 80 * 2**k)), (2560, 1280), interpolation=cv2.INTER_CUBIC)
        for k in range(4)
    )
    return np.clip(128 + 45 * image / image.std(), 0, 255).astype(np.float32)


SKY = sky()


def view(camera, R_world_body, texture=SKY):
    """What a camera that only turns sees of the directions around it."""
    width, height = camera.size_px
    columns, rows = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
    rays = projection.bearings(camera, np.stack([columns, rows], axis=-1)) @ (R_world_body @ R_BODY_CAM).T
    azimuth = np.arctan2(rays[..., 1], rays[..., 0])
    elevation = np.arcsin(np.clip(rays[..., 2], -1, 1))
    u = (azimuth / (2 * np.pi) + 0.5) * texture.shape[1]
    v = (elevation / np.pi + 0.5) * texture.shape[0]
    image = cv2.remap(texture, u.astype(np.float32), v.astype(np.float32), cv2.INTER_CUBIC, borderMode=cv2.BORDER_WRAP)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def frame(image, stamp_ns=0):
    return Frame(stamp_ns=stamp_ns, images=(image,))


def run(frontend, camera, rotations, predict=True):
    """Track through views at the rotations (body in world); returns the tracks of each."""
    out = []
    previous = None
    for index, R in enumerate(rotations):
        R_prev_cur = previous.T @ R if previous is not None and predict else None
        out.append(frontend.process(frame(view(camera, R), index), R_prev_cur).tracks)
        previous = R
    return out


def rotation_errors(camera, first, last, R_first, R_last):
    """Distances in px from where the first tracks' rays must be after a pure rotation."""
    _, a, b = np.intersect1d(first.ids, last.ids, return_indices=True)
    R_first_cam, R_last_cam = R_first @ R_BODY_CAM, R_last @ R_BODY_CAM
    expected, _ = projection.project(camera, first.bearings[a] @ (R_last_cam.T @ R_first_cam).T)
    return np.linalg.norm(last.pixels[b] - expected, axis=-1)


@pytest.mark.parametrize("model", ["pinhole", "radtan", "equidistant"])
def test_points_are_followed_to_a_tenth_of_a_pixel(model):
    rig = make_rig(model)
    frontend = KltFrontend(max_points=80)
    frontend.setup(rig)
    rotations = [so3.exp(np.array([0.01, 0.02, 0.03]) * 0.2 * k) for k in range(8)]
    tracks = run(frontend, rig.cameras[0], rotations)
    errors = rotation_errors(rig.cameras[0], tracks[0], tracks[-1], rotations[0], rotations[-1])
    assert len(errors) > 0.8 * len(tracks[0]) > 40
    assert np.median(errors) < 0.1
    assert np.percentile(errors, 95) < 0.3


def test_the_gyro_predicts_what_the_pyramid_cannot_reach():
    rig = make_rig()
    rotations = [np.eye(3), so3.exp(np.array([0.3, 0.05, 0.25]))]
    survivors = {}
    for predict in (True, False):
        frontend = KltFrontend(max_points=80, levels=1, window_px=15)
        frontend.setup(rig)
        first, last = run(frontend, rig.cameras[0], rotations, predict)
        errors = rotation_errors(rig.cameras[0], first, last, *rotations)
        survivors[predict] = int((errors < 1.0).sum())
    assert survivors[True] > 30
    assert survivors[True] > 3 * survivors[False]


def test_the_patch_a_point_began_with_keeps_it_from_drifting():
    rig = make_rig("pinhole")
    rng = np.random.default_rng(5)
    frontend = KltFrontend(max_points=80)
    frontend.setup(rig)
    # Roll and yaw there and back: what a search from image to image loses a little of every time.
    rotations = [so3.exp(np.array([0.25, 0.0, 0.15]) * np.sin(0.1 * k)) for k in range(64)]
    images = [view(rig.cameras[0], R) for R in rotations]
    noisy = [np.clip(i + 4.0 * rng.standard_normal(i.shape), 0, 255).astype(np.uint8) for i in images]
    tracks = [frontend.process(frame(i, k)).tracks for k, i in enumerate(noisy)]
    early, late = (rotation_errors(rig.cameras[0], tracks[0], tracks[k], rotations[0], rotations[k]) for k in (2, 63))
    assert len(late) > 25
    assert np.median(late) < 0.12
    assert np.median(late) < np.median(early) + 0.03


def test_a_long_gap_is_bridged_by_the_gyro():
    rig = make_rig()
    gap = [np.eye(3), so3.exp(np.array([0.7, 0.1, 0.1]))]
    frontend = KltFrontend(max_points=80)
    frontend.setup(rig)
    first, last = run(frontend, rig.cameras[0], gap)
    errors = rotation_errors(rig.cameras[0], first, last, *gap)
    assert len(errors) > 30
    assert np.percentile(errors, 90) < 0.3
    # Without the gyro, a turn of 40 degrees about the axis is beyond recognition: no wrong point may survive it.
    frontend.setup(rig)
    first, last = run(frontend, rig.cameras[0], gap, predict=False)
    assert (rotation_errors(rig.cameras[0], first, last, *gap) > 2.0).sum() <= 2


def test_ids_last_and_are_never_used_twice():
    rig = make_rig()
    frontend = KltFrontend(max_points=60)
    frontend.setup(rig)
    rotations = [so3.exp(np.array([0.0, 0.0, 0.06 * k])) for k in range(14)]
    tracks = run(frontend, rig.cameras[0], rotations)
    seen, ended = set(), set()
    for step in tracks:
        now = set(step.ids.tolist())
        assert len(now) == len(step.ids)
        assert not now & ended
        ended |= seen - now
        seen |= now
    assert len(ended) > 30
    frontend.setup(rig)
    assert frontend.process(frame(view(rig.cameras[0], np.eye(3)))).tracks.ids[0] == 0


def test_new_points_keep_their_distance_and_their_number():
    rig = make_rig()
    frontend = KltFrontend(max_points=50, min_distance_px=18.0)
    frontend.setup(rig)
    tracks = frontend.process(frame(view(rig.cameras[0], np.eye(3)))).tracks
    assert len(tracks) == 50
    distances = np.linalg.norm(tracks.pixels[:, None] - tracks.pixels[None], axis=-1)
    assert distances[~np.eye(50, dtype=bool)].min() > 16.5
    # Spread: every quarter of the image has its share.
    quarter = (tracks.pixels > np.array(SIZE) / 2) @ np.array([1, 2])
    assert np.bincount(quarter, minlength=4).min() >= 7


def test_detector_places_corners_where_they_are():
    image = np.full((240, 376), 60, np.uint8)
    corners = np.array([[100, 80], [200, 80], [100, 160], [280, 150]])
    for x, y in corners:
        image[y - 12 : y, x - 12 : x] = 200
        image[y : y + 12, x : x + 12] = 200
    image = cv2.GaussianBlur(image, (0, 0), 1.0)
    for scale in (1, 2):
        detector = CornerDetector(
            min_distance_px=30.0, quality=0.5, min_gradient=1.0, scale=scale, allowed=np.full((240, 376), 255, np.uint8)
        )
        found, _ = detector.detect(image, np.zeros((0, 2)), 10)
        distance = np.linalg.norm(found[:, None] - (corners - 0.5)[None], axis=-1)
        assert distance.min(axis=0).max() < 1.0


@pytest.mark.parametrize("image", [np.zeros, lambda s, d: np.full(s, 200, d)])
def test_no_texture_gives_no_tracks_and_no_crash(image):
    rig = make_rig()
    frontend = KltFrontend()
    frontend.setup(rig)
    blank = image(SIZE[::-1], np.uint8)
    assert len(frontend.process(frame(blank)).tracks) == 0
    assert len(frontend.process(frame(view(rig.cameras[0], np.eye(3)), 1)).tracks) > 50
    assert len(frontend.process(frame(blank, 2)).tracks) == 0
    assert frontend.counters() == {"lost all tracks": 1}


def test_sensor_noise_is_not_texture():
    rig = make_rig()
    frontend = KltFrontend(normalise_exposure=False)
    frontend.setup(rig)
    noise = np.random.default_rng(1).normal(100, 2.0, SIZE[::-1])
    assert len(frontend.process(frame(np.clip(noise, 0, 255).astype(np.uint8))).tracks) == 0


def test_a_jump_of_exposure_loses_nothing():
    rig = make_rig()
    image = view(rig.cameras[0], np.eye(3))
    brighter = np.clip(0.6 * image.astype(float) + 10, 0, 255).astype(np.uint8)
    frontend = KltFrontend()
    frontend.setup(rig)
    first = frontend.process(frame(image)).tracks
    second = frontend.process(frame(brighter, 1)).tracks
    common, a, b = np.intersect1d(first.ids, second.ids, return_indices=True)
    assert len(common) > 0.95 * len(first)
    assert np.abs(first.pixels[a] - second.pixels[b]).max() < 0.3


def test_colour_is_followed_like_gray():
    rig = make_rig()
    gray = view(rig.cameras[0], np.eye(3))
    tracks = []
    for image in (gray, np.repeat(gray[..., None], 3, axis=-1)):
        frontend = KltFrontend()
        frontend.setup(rig)
        tracks.append(frontend.process(frame(image)).tracks)
    assert np.abs(tracks[0].pixels - tracks[1].pixels).max() < 1e-9


def test_rays_beyond_the_angle_are_left_alone():
    rig = make_rig("equidistant")
    frontend = KltFrontend(max_angle_deg=25.0)
    frontend.setup(rig)
    tracks = frontend.process(frame(view(rig.cameras[0], np.eye(3)))).tracks
    assert 20 < len(tracks)
    assert np.degrees(np.arccos(tracks.bearings[:, 2])).max() < 26.5


def two_views(rng, count, R_prev_cur, t):
    points = rng.uniform([-3, -2, 3], [3, 2, 9], (count, 3))
    seen_later = (points - t) @ R_prev_cur
    return points / np.linalg.norm(points, axis=1)[:, None], seen_later / np.linalg.norm(seen_later, axis=1)[:, None]


@pytest.mark.parametrize("known", [True, False, "wrong"])
def test_moving_points_are_rejected(known):
    rng = np.random.default_rng(7)
    R, t = so3.exp(np.array([0.02, -0.05, 0.01])), np.array([0.25, 0.05, 0.1])
    a, b = two_views(rng, 120, R, t)
    b += 0.3 / 450 * rng.standard_normal(b.shape)
    b[:24] += np.array([0.01, 0.05, 0.0]) * rng.choice([-1, 1], (24, 1))
    b /= np.linalg.norm(b, axis=1)[:, None]
    # A gyro without its bias known is wrong by some milliradian; the five-point solution must step in.
    given = {True: R, False: None, "wrong": R @ so3.exp(np.array([0.0, 0.012, 0.008]))}[known]
    inliers = epipolar_inliers(a, b, given, 1.5 / 450, seed=1)
    assert inliers[24:].mean() > 0.95
    assert inliers[:24].mean() < 0.3


def test_pure_rotation_rejects_nothing():
    rng = np.random.default_rng(8)
    R = so3.exp(np.array([0.1, 0.02, 0.0]))
    a, b = two_views(rng, 100, R, np.zeros(3))
    assert epipolar_inliers(a, b, R, 1.0 / 450, seed=0).all()


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("max_points", 0),
        ("min_distance_px", 0.0),
        ("quality", 1.5),
        ("min_gradient", -1.0),
        ("detection_scale", 3),
        ("window_px", 20),
        ("levels", -1),
        ("max_steps", 0),
        ("step_px", 0.0),
        ("anchor_window_px", 12),
        ("anchor_steps", 0),
        ("anchor_reach_px", 0.0),
        ("min_correlation", 1.0),
        ("min_depth", 0.0),
        ("outlier_px", 0.0),
        ("clahe_clip", 0.0),
        ("clahe_tiles", 0),
        ("border_px", 0),
        ("max_angle_deg", 95.0),
    ],
)
def test_an_option_out_of_range_is_named(option, value):
    with pytest.raises(ConfigError, match=rf"frontend\.{option} must be .* got {value}"):
        KltFrontend(**{option: value})


def test_wrong_images_are_refused_in_a_sentence():
    rig = make_rig()
    frontend = KltFrontend()
    with pytest.raises(StateError, match="setup"):
        frontend.process(frame(np.zeros(SIZE[::-1], np.uint8)))
    frontend.setup(rig)
    with pytest.raises(ShapeError, match="is 300×200 px, but its calibration says 376×240"):
        frontend.process(frame(np.zeros((200, 300), np.uint8), 17))
    with pytest.raises(DataError, match="has no image"):
        frontend.process(Frame(stamp_ns=1))
    with pytest.raises(DataError, match="needs a camera"):
        frontend.setup(SensorRig(cameras=(), imu=NOISE))


def test_nothing_moves_while_the_vehicle_stands():
    folder = Path(shared_data("euroc_V1_01_micro", "mav0", "cam0", "data"))
    images = [cv2.imread(str(p), cv2.IMREAD_GRAYSCALE) for p in sorted(folder.glob("*.png"))]
    camera = Camera(
        model="radtan",
        intrinsics_px=np.array([458.654, 457.296, 367.215, 248.375]),
        distortion=np.array([-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]),
        size_px=(752, 480),
        T_body_cam=np.eye(4),
    )
    frontend = KltFrontend()
    frontend.setup(SensorRig(cameras=(camera,), imu=NOISE))
    tracks = [frontend.process(frame(image, k)).tracks for k, image in enumerate(images)]
    _, a, b = np.intersect1d(tracks[0].ids, tracks[-1].ids, return_indices=True)
    assert len(a) > 80
    moved = tracks[-1].pixels[b] - tracks[0].pixels[a]
    # All points share half a pixel: the vehicle turns by a milliradian; what they do not share is noise.
    assert np.linalg.norm(np.median(moved, axis=0)) < 0.8
    assert np.median(np.linalg.norm(moved - np.median(moved, axis=0), axis=-1)) < 0.25


def test_losing_everything_image_after_image_is_said_once(caplog):
    """Images that have nothing in common, as noise in the dark: all points are lost in each of them."""
    frontend = KltFrontend()
    frontend.setup(make_rig())
    rng = np.random.default_rng(0)
    for index in range(6):
        noise = rng.integers(0, 256, SIZE[::-1]).astype(np.uint8)
        frontend.process(frame(cv2.GaussianBlur(noise, (0, 0), 1.5), index))
    assert frontend.counters()["lost all tracks"] >= 3
    assert len([record for record in caplog.records if "all points were lost" in record.message]) == 1
