"""Images tell a steady motion, which the inertial sensor does not feel, from rest."""

import logging

import numpy as np
import pytest

from inertial_truth import NOISE, make_rig, windows_of
from shared_data import shared_data
from vioframe.errors import ConfigError
from vioframe.fusion_options import StartOptions
from vioframe.geometry import so3
from vioframe.image_motion import ImageMotion
from vioframe.initialisation import RestInitialiser
from vioframe.types import Frame, ImuBlock, NavState, Tracks, VisualFeatures
from vioframe_klt import KltFrontend
from vioframe_recordings import KittiDataset
from vioframe_sync import InterpolateSynchronizer

FRAME_NS = 100_000_000
COUNT = 60


def points(seed: int = 1) -> np.ndarray:
    """Points (60, 3), m, before a camera that looks along z."""
    rng = np.random.default_rng(seed)
    return rng.uniform([-8.0, -3.0, 8.0], [8.0, 3.0, 40.0], (COUNT, 3))


def seen(index: int, places: np.ndarray, ids: np.ndarray | None = None) -> VisualFeatures:
    """Tracks of these places (M, 3), camera frame, at the ``index``-th frame of 10 Hz."""
    tracks = Tracks(
        ids=np.arange(len(places)) if ids is None else ids,
        pixels=np.zeros((len(places), 2)),
        bearings=places / np.linalg.norm(places, axis=1, keepdims=True),
        scores=np.ones(len(places)),
    )
    return VisualFeatures(frame=Frame(stamp_ns=1_000_000_000 + index * FRAME_NS), tracks=tracks)


def still_samples(seconds: float) -> ImuBlock:
    """What both a body at rest and a cruising one feel, 200 Hz."""
    rng = np.random.default_rng(0)
    count = round(seconds * 200) + 1
    return ImuBlock(
        stamps_ns=1_000_000_000 + np.arange(count) * 5_000_000,
        gyro=rng.normal(0.0, NOISE.gyro_noise * np.sqrt(200.0), (count, 3)),
        accel=np.array([0.0, 0.0, 9.81]) + rng.normal(0.0, NOISE.accel_noise * np.sqrt(200.0), (count, 3)),
    )


def states_of(initialiser: RestInitialiser, places_at, seconds: float = 3.0) -> list[NavState | None]:
    """The answers to windows of 0.1 s, of which the ``i``-th ends with ``places_at(i)``."""
    windows = windows_of(still_samples(seconds), 20)
    return [initialiser.push(window, seen(i + 1, places_at(i + 1))) for i, window in enumerate(windows)]


def test_the_angle_is_that_of_the_turn():
    motion = ImageMotion(0.75)
    assert motion.push(seen(0, points())) is None
    for index in (1, 2, 3):
        angle, seconds = motion.push(seen(index, points() @ so3.exp(np.radians([0.0, 1e-3 * index, 0.0])).T))
        # A point off the plane of the turn moves by less than the turn.
        assert 0.9e-3 * index < angle <= 1e-3 * index
        assert seconds == pytest.approx(0.1 * index)


def test_looks_back_as_far_as_the_stretch_and_the_points_reach():
    motion = ImageMotion(0.75)
    for index in range(20):
        moved = motion.push(seen(index, points()))
    assert moved is not None and moved[1] == pytest.approx(0.7)
    # All points are lost and new ones found: nothing is known, then what the new ones tell.
    assert motion.push(seen(20, points(), np.arange(100, 100 + COUNT))) is None
    moved = motion.push(seen(21, points(), np.arange(100, 100 + COUNT)))
    assert moved is not None and moved[1] == pytest.approx(0.1)
    assert motion.push(seen(22, points()[:9], np.arange(100, 109))) is None
    assert motion.push(None) is None


def test_a_steady_motion_does_not_pass_for_rest(caplog):
    with caplog.at_level(logging.WARNING):
        states = states_of(RestInitialiser(make_rig()), lambda i: points() - [0.0, 0.0, 0.3 * i])
    assert states == [None] * len(states)
    (record,) = caplog.records
    assert "the inertial sensor reads rest, but the images move by" in record.getMessage()
    assert "the body moves steadily; use init=groundtruth" in record.getMessage()


def test_rest_begins_when_the_images_have_stood_still_as_long():
    states = states_of(RestInitialiser(make_rig()), lambda i: points() - [0.3 * min(i, 12), 0.0, 0.0])
    first = next(i for i, state in enumerate(states) if state is not None)
    # The motion ends with frame 12, with which window 11 ends; the next frame more than 0.75 s after frame 11
    # no longer looks back to it.
    assert first == 11 + 7


def test_what_moves_before_a_camera_at_rest_changes_nothing():
    rng = np.random.default_rng(3)

    def busy(i: int) -> np.ndarray:
        places = points() * (1.0 + rng.normal(0.0, 1e-4, (COUNT, 3)))
        places[: COUNT // 3] += [0.4 * i, 0.0, 0.0]
        return places

    blind = RestInitialiser(make_rig())
    alone = [blind.push(window) for window in windows_of(still_samples(3.0), 20)]
    states = states_of(RestInitialiser(make_rig()), busy)
    assert [state is None for state in states] == [state is None for state in alone]
    assert any(state is not None for state in states)


def test_refuses_a_limit_that_cannot_be():
    with pytest.raises(ConfigError, match="max_flow_deg"):
        RestInitialiser(make_rig(), max_flow_deg=0.0)


def test_a_cruising_car_does_not_pass_for_rest(caplog):
    """KITTI 06 drives at 13 m/s and feels nothing of it."""
    root = shared_data("kitti", "imus_100hz_mat").parent
    shared_data("kitti", "sequences", "06")
    recording = KittiDataset(root=str(root), sequence="06", duration_s=2.0).open("06")
    synchronizer, frontend = InterpolateSynchronizer(), KltFrontend()
    synchronizer.setup(recording.rig)
    frontend.setup(recording.rig)
    seeing, blind = (StartOptions().at_rest(recording.rig) for _ in range(2))
    windows = [window for packet in recording.packets() for window in synchronizer.push(packet)]
    assert len(windows) > 15
    with caplog.at_level(logging.WARNING):
        assert all(seeing.push(window, frontend.process(window.current)) is None for window in windows)
    assert len([r for r in caplog.records if "the images move by" in r.getMessage()]) == 1
    assert any(blind.push(window) is not None for window in windows)
