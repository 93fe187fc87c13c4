"""The ORB front end on warps that are known exactly."""

import cv2
import numpy as np
import pytest

from vioframe.errors import ConfigError, DataError, ShapeError, StateError
from vioframe.geometry import camera as projection
from vioframe.geometry import se3, so3
from vioframe.interfaces import STEREO_TRACKS, TRACKS
from vioframe.types import Camera, Frame, ImuNoise, SensorRig
from vioframe_orb import OrbFrontend
from vioframe_orb.extractor import OrbExtractor, orientations

SIZE = (400, 300)
K = np.array([[260.0, 0.0, 199.5], [0.0, 260.0, 149.5], [0.0, 0.0, 1.0]])
NOISE = ImuNoise(gyro_noise=1e-4, gyro_walk=1e-5, accel_noise=1e-3, accel_walk=1e-4, rate_hz=200.0)
BASELINE_M, DEPTH_M = 0.12, 3.0


def make_rig(count=1):
    cameras = tuple(
        Camera(
            model="pinhole",
            intrinsics_px=np.array([260.0, 260.0, 199.5, 149.5]),
            size_px=SIZE,
            T_body_cam=se3.from_parts(np.eye(3), np.array([BASELINE_M * k, 0.0, 0.0])),
        )
        for k in range(count)
    )
    return SensorRig(cameras=cameras, imu=NOISE)


def picture(seed=6):
    """Dark and bright shapes with corners, larger than a view."""
    rng = np.random.default_rng(seed)
    image = np.full((900, 1200), 120, np.uint8)
    for _ in range(900):
        centre, size = rng.uniform([0, 0], [1200, 900]), rng.uniform(8, 40, 2)
        box = cv2.boxPoints((centre, size, rng.uniform(0, 90)))
        cv2.fillConvexPoly(image, box.astype(int), int(rng.integers(20, 236)))
    return cv2.GaussianBlur(image, (0, 0), 0.8)


PICTURE = picture()
# Where the first view lies in the picture.
PLACE = np.array([[1.0, 0.0, 400.0], [0.0, 1.0, 300.0], [0.0, 0.0, 1.0]])


def view(H_first_view):
    """What a view sees whose pixels map to those of the first by a homography."""
    return cv2.warpPerspective(PICTURE, PLACE @ H_first_view, SIZE, flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP)


def homography(R, t):
    """Pixels of a view to those of the first, for the plane at DEPTH_M ahead of the first."""
    return K @ np.linalg.inv(R.T - np.outer(R.T @ t, [0.0, 0.0, 1.0 / DEPTH_M])) @ np.linalg.inv(K)


def apply(H, pixels):
    mapped = np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1) @ H.T
    return mapped[:, :2] / mapped[:, 2:]


def walk(count):
    """Rotation and place of the camera in the first view."""
    for k in range(count):
        yield so3.exp(np.array([0.004, 0.012, 0.02]) * k), np.array([0.02, 0.01, 0.03]) * k


def follow(frontend, count, images=lambda H: (view(H),)):
    out, before = [], np.eye(3)
    for k, (R, t) in enumerate(walk(count)):
        H = homography(R, t)
        out.append((frontend.process(Frame(stamp_ns=k, images=images(H)), before.T @ R), H))
        before = R
    return out


@pytest.mark.parametrize("upright", [True, False])
def test_points_keep_their_ids_and_places_under_known_homographies(upright):
    frontend = OrbFrontend(max_points=120, keypoints=250, upright=upright)
    frontend.setup(make_rig())
    seen = follow(frontend, 10)
    first_seen, errors = {}, []
    for features, H in seen:
        tracks = features.tracks
        assert len(np.unique(tracks.ids)) == len(tracks.ids) > 90
        assert tracks.descriptors.shape == (len(tracks), 32)
        assert tracks.descriptors.dtype == np.uint8
        for identity, place in zip(tracks.ids.tolist(), apply(H, tracks.pixels), strict=True):
            errors.append(np.linalg.norm(first_seen.setdefault(identity, place) - place))
    errors = np.array(errors)[np.array(errors) > 0]
    assert np.median(errors) < 0.3
    assert np.mean(errors > 3.0) < 0.03
    kept = set(seen[0][0].tracks.ids.tolist()) & set(seen[-1][0].tracks.ids.tolist())
    assert len(kept) > 30


def test_corners_and_descriptors_are_found_again_in_a_shifted_image():
    extractor = OrbExtractor(count=200, spacing_px=10.0, quality=0.003, min_gradient=1.0, subpixel_px=4, upright=True)
    allowed = np.full(SIZE[::-1], 255, np.uint8)
    shift = np.array([[1.0, 0.0, 7.3], [0.0, 1.0, -4.6], [0.0, 0.0, 1.0]])
    a, b = extractor.extract(view(np.eye(3)), allowed), extractor.extract(view(shift), allowed)
    apart = np.linalg.norm(a.pixels[:, None] - apply(shift, b.pixels), axis=-1)
    assert (apart.min(axis=1) < 0.3).mean() > 0.6
    nearest = apart.argmin(axis=1)
    bits = np.unpackbits(a.descriptors ^ b.descriptors[nearest], axis=1).sum(axis=1)
    assert np.median(bits[apart.min(axis=1) < 0.3]) < 25


def test_orientation_turns_with_the_image():
    image = view(np.eye(3))
    middle = np.array([[199.5, 149.5]])
    turn = cv2.getRotationMatrix2D((199.5, 149.5), 30.0, 1.0)
    before, after = orientations(image, middle), orientations(cv2.warpAffine(image, turn, SIZE), middle)
    # A positive angle of OpenCV turns counter-clockwise, where y points down.
    assert abs((before - after - 30.0 + 180.0) % 360.0 - 180.0)[0] < 5.0


def test_stereo_lies_on_the_epipolar_line_at_the_depth_of_the_scene():
    shift = np.array([[1.0, 0.0, 260.0 * BASELINE_M / DEPTH_M], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    frontend = OrbFrontend(stereo=True, max_points=120, keypoints=250)
    assert frontend.provides == {TRACKS, STEREO_TRACKS}
    rig = make_rig(2)
    frontend.setup(rig)
    features = frontend.process(Frame(stamp_ns=0, images=(view(np.eye(3)), view(shift))))
    stereo, tracks = features.stereo, features.tracks
    assert stereo.camera == 1
    rows = np.searchsorted(tracks.ids, stereo.ids)
    assert np.array_equal(tracks.ids[rows], stereo.ids)
    assert len(stereo) > 0.6 * len(tracks)
    off = tracks.pixels[rows] - stereo.pixels - shift[:2, 2]
    assert np.median(np.linalg.norm(off, axis=1)) < 0.2
    assert np.mean(np.linalg.norm(off, axis=1) > 2.0) < 0.05
    assert np.allclose(stereo.bearings, projection.bearings(rig.cameras[1], stereo.pixels))


def test_no_texture_gives_no_tracks():
    frontend = OrbFrontend()
    frontend.setup(make_rig())
    blank = Frame(stamp_ns=0, images=(np.full(SIZE[::-1], 90, np.uint8),))
    assert len(frontend.process(blank).tracks) == 0
    assert len(frontend.process(Frame(stamp_ns=1, images=(view(np.eye(3)),))).tracks) > 100
    assert len(frontend.process(blank).tracks) == 0
    assert frontend.counters() == {"lost all tracks": 1}


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("max_points", 0),
        ("keypoints", 10),
        ("quality", 0.0),
        ("subpixel_px", 30),
        ("search_px", 0.0),
        ("memory_images", 0),
        ("max_distance_bits", 300),
        ("ratio", 1.5),
        ("border_px", 0),
    ],
)
def test_an_option_out_of_range_is_named(option, value):
    with pytest.raises(ConfigError, match=rf"frontend\.{option} must be .* got {value}"):
        OrbFrontend(**{option: value})


def test_wrong_images_are_refused_in_a_sentence():
    frontend = OrbFrontend(stereo=True)
    image = view(np.eye(3))
    with pytest.raises(StateError, match="setup"):
        frontend.process(Frame(stamp_ns=0, images=(image,)))
    with pytest.raises(DataError, match="frontend=orb with stereo=true needs 2 cameras, but .* has 1"):
        frontend.setup(make_rig(1))
    frontend.setup(make_rig(2))
    with pytest.raises(DataError, match="has 1 image, and frontend=orb needs two"):
        frontend.process(Frame(stamp_ns=0, images=(image,)))
    with pytest.raises(ShapeError, match="is 200×100 px, but its calibration says 400×300"):
        frontend.process(Frame(stamp_ns=0, images=(np.zeros((100, 200), np.uint8), image)))
