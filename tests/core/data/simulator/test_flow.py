"""The exact flow of the simulated camera against what geometry and the drawn images say."""

import cv2
import numpy as np
import pytest

from vioframe.data.simulator import CameraSettings, Degradations, SimulatedDataset, SimulatedRecording
from vioframe.data.simulator.world import World
from vioframe.geometry import so3


def recording(family: str = "walk", degradations: Degradations | None = None, **camera) -> SimulatedRecording:
    settings = CameraSettings(**{"size_px": (256, 128), **camera})
    dataset = SimulatedDataset(sequence=family, duration_s=9.0, camera=settings, degradations=degradations)
    return dataset.open(dataset.sequences[0])


def there(flow: np.ndarray) -> np.ndarray:
    height, width = flow.shape[:2]
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)
    return (grid + flow).astype(np.float32)


def look_up(image: np.ndarray, places: np.ndarray) -> np.ndarray:
    return cv2.remap(image.astype(np.float32), places[..., 0], places[..., 1], cv2.INTER_LINEAR)


CASES = {
    "pinhole car": ("car", {}, None),
    "radtan": ("walk", {"kit": "euroc"}, None),
    "fisheye": ("walk", {"kit": "tumvi", "size_px": (160, 160)}, None),
    "rolling shutter": ("walk", {"rolling_shutter_s": 0.04}, None),
    "moving objects": ("walk", {}, Degradations(moving_objects=12)),
}


@pytest.mark.parametrize("case", list(CASES))
def test_there_and_back_is_no_way_at_all(case: str) -> None:
    family, camera, degradations = CASES[case]
    made = recording(family, degradations, **camera)
    first, second = (int(made.frame_stamps_ns[len(made.frame_stamps_ns) * 3 // 4 + k]) for k in (0, 2))
    forth, seen = made.exact_flow(first, second)
    back, seen_back = made.exact_flow(second, first)
    places = there(forth)
    whole = seen & (look_up(seen_back, places) > 0.999)
    assert whole.mean() > 0.5
    assert np.median(np.linalg.norm(forth[whole], axis=1)) > 0.5
    error = np.linalg.norm(look_up(back, places) + forth, axis=-1)[whole]
    # Bilinear look-up of the way back errs where two surfaces meet.
    assert np.median(error) < 0.005
    assert np.percentile(error, 97.0) < 0.05


@pytest.mark.parametrize("case", list(CASES))
def test_what_is_seen_twice_looks_the_same(case: str) -> None:
    family, camera, degradations = CASES[case]
    made = recording(family, degradations, **camera)
    first, second = (int(made.frame_stamps_ns[len(made.frame_stamps_ns) * 3 // 4 + k]) for k in (0, 2))
    flow, seen = made.exact_flow(first, second)
    grey = [made.imager.view(float(made.elapsed_s(stamp))).grey for stamp in (first, second)]
    followed = np.abs(look_up(grey[1], there(flow)) - grey[0])[seen]
    stayed = np.abs(grey[1] - grey[0])[seen]
    assert np.median(followed) < 0.7 * np.median(stayed)


def test_moving_objects_carry_their_pixels_along() -> None:
    """Two seconds of rest at the start: only what moves by itself has flow, and its look goes with it."""
    made = recording("standing", Degradations(moving_objects=12))
    flow, seen = made.imager.flow(0.5, 0.7)
    moves = np.linalg.norm(flow, axis=-1) > 0.5
    assert 0.001 < moves.mean() < 0.9
    assert np.abs(flow[~moves]).max() < 0.05
    grey = [made.imager.view(t).grey for t in (0.5, 0.7)]
    chosen = moves & seen
    followed = np.abs(look_up(grey[1], there(flow)) - grey[0])[chosen]
    stayed = np.abs(grey[1] - grey[0])[chosen]
    assert followed.mean() < 0.5 * stayed.mean()


def test_a_turn_on_the_spot_moves_pixels_whatever_their_depth() -> None:
    """With the camera at the body's origin, flow of a pure rotation is the homography K R K⁻¹."""
    forward = [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    made = recording("rotation", model="pinhole", T_body_cam=forward)
    camera = made.rig.cameras[0]
    times = (4.0, 4.05)
    poses = [made.motion.evaluate(t).T_world_body @ camera.T_body_cam for t in times]
    np.testing.assert_allclose(poses[0][:3, 3], poses[1][:3, 3], atol=1e-9)
    fx, fy, cx, cy = camera.intrinsics_px
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    turn = poses[1][:3, :3].T @ poses[0][:3, :3]
    assert np.linalg.norm(so3.log(turn)) > 0.01
    grid = np.stack(np.meshgrid(np.arange(256.0), np.arange(128.0)), axis=-1)
    rays = np.concatenate([grid, np.ones((128, 256, 1))], axis=-1) @ (matrix @ turn @ np.linalg.inv(matrix)).T
    wanted = rays[..., :2] / rays[..., 2:] - grid
    flow, seen = made.imager.flow(*times)
    # Depth is kept in single precision, which a long lever of pixels would show.
    np.testing.assert_allclose(flow[seen], wanted[seen], atol=1e-3)
    inside = ((grid + wanted >= 0.5) & (grid + wanted <= (254.5, 126.5))).all(axis=-1)
    # Nothing hides anything from a camera that only turns, but at the half pixel beside an edge.
    assert seen[inside].mean() > 0.97


def test_no_time_no_flow() -> None:
    made = recording("walk", kit="tumvi", size_px=(160, 160))
    flow, seen = made.imager.flow(3.0, 3.0)
    depth = made.imager.depth(3.0)
    np.testing.assert_array_equal(seen, depth > 0.0)
    assert 0.5 < seen.mean() < 1.0
    np.testing.assert_allclose(flow[seen], 0.0, atol=1e-6)


def test_rolling_rows_have_instants_of_their_own() -> None:
    """At rest but for the shutter, nothing moves; in motion the shutter changes the flow by its share of a frame."""
    still = recording("standing", rolling_shutter_s=0.04)
    flow, seen = still.imager.flow(0.5, 0.6)
    np.testing.assert_allclose(flow[seen], 0.0, atol=1e-3)
    rolling, whole = recording(rolling_shutter_s=0.04), recording()
    row, readout_s = 64, 0.04 * 64 / 127
    flow, seen = rolling.imager.flow(4.0, 4.1)
    # A global shutter at the time of that row sees the same first ray; the second is late by the rows it moved.
    other, other_seen = whole.imager.flow(4.0 + readout_s, 4.1 + readout_s)
    both = (seen & other_seen)[row]
    late = np.abs(other[row, both, 1]) * 0.04 / 127
    speed = np.linalg.norm(other[row, both], axis=1) / 0.1
    gap = np.linalg.norm(flow[row, both] - other[row, both], axis=1)
    assert np.median(gap) > 0.0
    assert np.all(gap < 2.0 * late * speed + 0.02)


def test_offsets_are_those_the_world_is_drawn_with() -> None:
    made = recording("walk", Degradations(moving_objects=4))
    world: World = made.imager.world
    world.move_to(0.0)
    low = world.low.copy()
    world.move_to(1.3)
    np.testing.assert_allclose(world.low - low, world.offsets(1.3) - world.offsets(0.0), atol=1e-12)
    assert np.count_nonzero(np.linalg.norm(world.offsets(1.3), axis=1)) == 4
