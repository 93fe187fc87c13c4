"""The local map on synthetic tracks with known noise, and on real images."""

from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from shared_data import shared_data
from synthetic_tracks import Run, Scene, make_rig, make_room, make_walk, run
from vioframe.errors import ConfigError, StateError
from vioframe.geometry import so3
from vioframe.types import Camera, Frame, ImuNoise, SensorRig, Tracks, VisualFeatures
from vioframe_geometric import LocalMapVO
from vioframe_klt import KltFrontend

RIG = make_rig(cameras=1)


@pytest.fixture(scope="module")
def walked():
    return run(LocalMapVO(), Scene(RIG, make_walk(300, seed=1), make_room(1), seed=1))


def local_scales(result, parts=6):
    """Metres a unit in parts of the run, over its mean."""
    lengths = [np.linalg.norm(np.diff(poses[::5, :3, 3], axis=0), axis=-1) for poses in (result.truth, result.chain)]
    told_in, true_in = (np.array_split(x, parts) for x in reversed(lengths))
    ratios = np.array([true.sum() / told.sum() for true, told in zip(true_in, told_in, strict=True)])
    return ratios / ratios.mean()


def test_a_walk_is_followed_to_a_part_in_three_hundred(walked):
    assert walked.valid[10:].all()
    _, rmse = walked.aligned()
    assert rmse < 0.003 * walked.path
    assert np.degrees(so3.angle(walked.chain[-1, :3, :3].T @ walked.truth[-1, :3, :3])) < 2.0


def test_the_scale_is_kept(walked):
    assert np.abs(local_scales(walked) - 1.0).max() < 0.04


def test_the_unit_is_the_median_depth_of_the_first_map(walked):
    scale, _ = walked.aligned()
    assert 1.5 < scale < 6.0


def test_the_covariance_of_a_step_is_honest(walked):
    scale, _ = walked.aligned()
    assert 0.4 < walked.nees(scale).mean() < 2.0


def test_exact_without_noise():
    result = run(LocalMapVO(), Scene(RIG, make_walk(100, seed=3), make_room(3), sigma_px=0.0, seed=3))
    _, rmse = result.aligned()
    assert rmse < 2e-4 * result.path


def test_outliers_and_short_tracks_are_survived():
    result = run(LocalMapVO(), Scene(RIG, make_walk(250, seed=4), make_room(4), outliers=0.08, lose=0.06, seed=4))
    assert result.valid[15:].mean() > 0.98
    assert result.aligned()[1] < 0.008 * result.path


@pytest.mark.parametrize("model", ["pinhole", "equidistant"])
def test_other_lenses(model):
    result = run(LocalMapVO(), Scene(make_rig(model, cameras=1), make_walk(120, seed=5), make_room(5), seed=5))
    assert result.aligned()[1] < 0.004 * result.path


def test_setup_forgets_everything():
    vo = LocalMapVO()
    first, second = (run(vo, Scene(RIG, make_walk(60, seed=6), make_room(6), seed=6)) for _ in range(2))
    assert np.array_equal(first.chain, second.chain)


def turn_on_the_spot(T, count, rate=0.05):
    turned = np.tile(T, (count, 1, 1))
    turned[:, :3, :3] = T[:3, :3] @ so3.rotation_z(rate * np.arange(count))
    return turned


def test_nothing_is_invented_before_there_is_parallax():
    still = np.tile(make_walk(1), (30, 1, 1))
    assert not run(LocalMapVO(), Scene(RIG, still, make_room(7))).valid.any()
    assert not run(LocalMapVO(), Scene(RIG, turn_on_the_spot(make_walk(1)[0], 60), make_room(7))).valid.any()


def test_standing_still_in_a_map_is_standing_still():
    walk = make_walk(60, seed=8)
    result = run(LocalMapVO(), Scene(RIG, np.concatenate([walk, np.tile(walk[-1], (60, 1, 1))]), make_room(8), seed=8))
    scale, _ = result.aligned()
    assert result.valid[-60:].all()
    moved = scale * np.linalg.norm(result.chain[-1, :3, 3] - result.chain[-55, :3, 3])
    assert moved < 0.02


def test_a_turn_on_the_spot_does_not_break_the_map():
    walk = make_walk(80, seed=9)
    turn = turn_on_the_spot(walk[-1], 25, 0.04)
    # Walk on along the first way back, seen from the new heading.
    back = walk[::-1].copy()
    back[:, :3, :3] = back[:, :3, :3] @ so3.rotation_z(0.04 * 24)
    result = run(LocalMapVO(), Scene(RIG, np.concatenate([walk, turn[1:], back]), make_room(9), seed=9))
    scale, rmse = result.aligned()
    assert result.valid[15:].mean() > 0.98
    assert rmse < 0.02 * result.path
    turning = slice(len(result.chain) - 80 - 24, len(result.chain) - 80)
    assert (
        scale * np.linalg.norm(result.chain[turning, :3, 3] - result.chain[turning.start, :3, 3], axis=-1).max() < 0.06
    )


def test_after_a_loss_a_new_map_takes_over_the_scale():
    vo = LocalMapVO()
    result = run(vo, Scene(RIG, make_walk(260, seed=1), make_room(1), seed=1, blind=tuple(range(120, 124))))
    assert vo.counters() == {"maps lost": 1}
    assert not result.valid[119:124].any()
    assert result.valid[150:].all()
    steps = [(np.linalg.norm(m.T_prev_cur[:3, 3]), np.linalg.norm(t[:3, 3]), k) for m, t, k in result.steps]
    before, after = (
        sum(true for _, true, k in steps if which(k)) / sum(told for told, _, k in steps if which(k))
        for which in (lambda k: k < 120, lambda k: k >= 124)
    )
    # A guess by the median depth, but of the right size.
    assert 0.5 < after / before < 2.0


def test_a_hole_in_the_stream_is_bridged():
    """A pair whose first frame is not the last one seen, as after dropped frames."""
    vo = LocalMapVO()
    frames = list(Scene(RIG, make_walk(120, seed=1), make_room(1), seed=1))
    vo.setup(RIG)
    valid = [vo.estimate(a[0], b[0]).valid for a, b in pairwise(frames[:61])]
    assert valid[-1]
    assert vo.estimate(frames[63][0], frames[64][0]).valid


def test_no_tracks_is_no_motion():
    vo = LocalMapVO()
    vo.setup(RIG)
    nothing = Tracks(
        ids=np.zeros(0, dtype=np.int64), pixels=np.zeros((0, 2)), bearings=np.zeros((0, 3)), scores=np.zeros(0)
    )
    frames = [VisualFeatures(frame=Frame(stamp_ns=k), tracks=nothing) for k in range(5)]
    assert not any(vo.estimate(a, b).valid for a, b in pairwise(frames))


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("sigma_px", 0.0),
        ("min_points", 3),
        ("start_points", 5),
        ("start_parallax_px", -1.0),
        ("keyframe_parallax_px", 0.0),
        ("keyframe_share", 1.0),
        ("window", 2),
        ("fixed", 8),
        ("drift_px", -0.1),
        ("covariance_scale", 0.0),
    ],
)
def test_an_option_out_of_range_is_named(option, value):
    with pytest.raises(ConfigError, match=rf"vo\.{option} must .* got {value}"):
        LocalMapVO(**{option: value})


def test_a_call_before_setup_is_refused():
    features = next(iter(Scene(RIG, make_walk(1), make_room(1))))[0]
    with pytest.raises(StateError, match="setup"):
        LocalMapVO().estimate(features, features)


def see_with_klt(folder, camera):
    rig = SensorRig(
        cameras=(camera,),
        imu=ImuNoise(gyro_noise=1e-4, gyro_walk=1e-5, accel_noise=1e-3, accel_walk=1e-4, rate_hz=200.0),
    )
    frontend, vo = KltFrontend(), LocalMapVO()
    frontend.setup(rig)
    vo.setup(rig)
    images = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in sorted(Path(folder).glob("*.png"))]
    seen = [frontend.process(Frame(stamp_ns=k, images=(image,))) for k, image in enumerate(images)]
    return [vo.estimate(a, b) for a, b in pairwise(seen)]


def test_no_motion_is_invented_while_a_real_vehicle_stands():
    camera = Camera(
        model="radtan",
        intrinsics_px=np.array([458.654, 457.296, 367.215, 248.375]),
        distortion=np.array([-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]),
        size_px=(752, 480),
        T_body_cam=np.eye(4),
    )
    motions = see_with_klt(shared_data("euroc_V1_01_micro", "mav0", "cam0", "data"), camera)
    assert len(motions) == 19
    assert not any(motion.valid for motion in motions)


@pytest.mark.parametrize(("sequence", "share"), [("06", 0.005), ("01", 0.015)])
def test_a_real_car_is_followed(sequence, share):
    folder = shared_data("kitti", "sequences", sequence)
    fx, _, cx, _, _, fy, cy = (float(x) for x in (folder / "calib.txt").read_text().split()[1:8])
    first = cv2.imread(str(folder / "image_0" / "000000.png"), cv2.IMREAD_GRAYSCALE)
    camera = Camera(
        model="pinhole",
        intrinsics_px=np.array([fx, fy, cx, cy]),
        size_px=first.shape[::-1],
        T_body_cam=np.eye(4),
    )
    motions = see_with_klt(folder / "image_0", camera)
    start = next(k for k, motion in enumerate(motions) if motion.valid)
    assert start <= 15
    assert all(motion.valid for motion in motions[start:])
    truth = np.tile(np.eye(4), (51, 1, 1))
    truth[:, :3] = np.loadtxt(shared_data("kitti", "poses", f"{sequence}.txt"))[:51].reshape(-1, 3, 4)
    chain = [np.eye(4)]
    for motion in motions[start:]:
        chain.append(chain[-1] @ motion.T_prev_cur)
    result = Run(np.array(chain), np.linalg.inv(truth[start]) @ truth[start:51], [], np.ones(1, dtype=bool))
    assert result.aligned()[1] < share * result.path
    assert np.degrees(so3.angle(result.chain[-1, :3, :3].T @ result.truth[-1, :3, :3])) < 1.5
