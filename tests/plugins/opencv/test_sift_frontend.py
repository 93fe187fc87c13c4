"""The SIFT front end on warps that are known exactly."""

import cv2
import numpy as np
import pytest

from vioframe.errors import ConfigError, StateError
from vioframe.geometry import se3, so3
from vioframe.interfaces import STEREO_TRACKS, TRACKS
from vioframe.types import Camera, Frame, ImuNoise, SensorRig
from vioframe_opencv import SiftFrontend

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
    """Dark and bright shapes, larger than a view."""
    rng = np.random.default_rng(seed)
    image = np.full((900, 1200), 120, np.uint8)
    for _ in range(900):
        box = cv2.boxPoints((rng.uniform([0, 0], [1200, 900]), rng.uniform(8, 40, 2), rng.uniform(0, 90)))
        cv2.fillConvexPoly(image, box.astype(int), int(rng.integers(20, 236)))
    return cv2.GaussianBlur(image, (0, 0), 0.8)


PICTURE = picture()
PLACE = np.array([[1.0, 0.0, 400.0], [0.0, 1.0, 300.0], [0.0, 0.0, 1.0]])


def view(H_first_view):
    return cv2.warpPerspective(PICTURE, PLACE @ H_first_view, SIZE, flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP)


def homography(R, t):
    """Pixels of a view to those of the first, for the plane at DEPTH_M ahead of the first."""
    return K @ np.linalg.inv(R.T - np.outer(R.T @ t, [0.0, 0.0, 1.0 / DEPTH_M])) @ np.linalg.inv(K)


def apply(H, pixels):
    mapped = np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1) @ H.T
    return mapped[:, :2] / mapped[:, 2:]


def test_points_keep_their_ids_and_places_under_known_homographies():
    frontend = SiftFrontend(max_points=120, keypoints=250)
    assert frontend.provides == {TRACKS}
    frontend.setup(make_rig())
    before, seen, places, errors = np.eye(3), [], {}, []
    for k in range(8):
        R, t = so3.exp(np.array([0.004, 0.012, 0.02]) * k), np.array([0.02, 0.01, 0.03]) * k
        H = homography(R, t)
        tracks = frontend.process(Frame(stamp_ns=k, images=(view(H),)), before.T @ R).tracks
        before = R
        assert len(np.unique(tracks.ids)) == len(tracks.ids) > 80
        assert tracks.descriptors.shape == (len(tracks), 128) and tracks.descriptors.dtype == np.float32
        seen.append(set(tracks.ids.tolist()))
        for identity, place in zip(tracks.ids.tolist(), apply(H, tracks.pixels), strict=True):
            errors.append(np.linalg.norm(places.setdefault(identity, place) - place))
    errors = np.array(errors)[np.array(errors) > 0]
    assert np.median(errors) < 0.4
    assert np.mean(errors > 3.0) < 0.03
    assert len(seen[0] & seen[-1]) > 30


def test_stereo_lies_on_the_epipolar_line_at_the_depth_of_the_scene():
    shift = np.array([[1.0, 0.0, 260.0 * BASELINE_M / DEPTH_M], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    frontend = SiftFrontend(stereo=True, max_points=120, keypoints=250)
    assert frontend.provides == {TRACKS, STEREO_TRACKS}
    frontend.setup(make_rig(2))
    features = frontend.process(Frame(stamp_ns=0, images=(view(np.eye(3)), view(shift))))
    stereo, tracks = features.stereo, features.tracks
    assert len(stereo) > 0.5 * len(tracks)
    off = tracks.pixels[np.searchsorted(tracks.ids, stereo.ids)] - stereo.pixels - shift[:2, 2]
    assert np.median(np.linalg.norm(off, axis=1)) < 0.3
    assert np.mean(np.linalg.norm(off, axis=1) > 2.0) < 0.05


def test_no_texture_gives_no_tracks():
    frontend = SiftFrontend()
    frontend.setup(make_rig())
    blank = Frame(stamp_ns=0, images=(np.full(SIZE[::-1], 90, np.uint8),))
    assert len(frontend.process(blank).tracks) == 0
    assert len(frontend.process(Frame(stamp_ns=1, images=(view(np.eye(3)),))).tracks) > 80
    assert len(frontend.process(blank).tracks) == 0
    assert frontend.counters() == {"lost all tracks": 1}


def test_setup_comes_first():
    with pytest.raises(StateError, match="SiftFrontend"):
        SiftFrontend().process(Frame(stamp_ns=0, images=(view(np.eye(3)),)))


@pytest.mark.parametrize(
    ("option", "value"),
    [("keypoints", 50), ("max_distance", 3.0), ("ratio", 0.0), ("edge", 1.0), ("contrast", 0.0), ("spacing_px", 0)],
)
def test_wrong_options_are_named_with_their_values(option, value):
    with pytest.raises(ConfigError, match=rf"frontend\.{option} must be .*{value}"):
        SiftFrontend(**{option: value})
