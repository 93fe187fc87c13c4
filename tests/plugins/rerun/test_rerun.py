"""The Rerun viewer writes what a pipeline gave, readable again; it refuses what it cannot do before a run."""

import importlib.util
import inspect
import socket
from pathlib import Path

import cv2
import numpy as np
import pytest
from omegaconf import OmegaConf

import vioframe_rerun.viewer as module
from vioframe.errors import ConfigError, StateError
from vioframe.geometry import se3, so3
from vioframe.plugins import core_conf
from vioframe.types import (
    Camera,
    Frame,
    ImuBias,
    ImuBlock,
    ImuNoise,
    Measurement,
    NavState,
    SensorRig,
    SyncedWindow,
    Tracks,
    Trajectory,
    VisualFeatures,
)
from vioframe.viewer import build_viewer
from vioframe_rerun import RerunViewer

HAS_RERUN = importlib.util.find_spec("rerun") is not None
needs_rerun = pytest.mark.skipif(not HAS_RERUN, reason="rerun-sdk is not installed (pip install 'vioframe[viewer]')")

START_NS = 1_403_636_579_763_555_584
STEP_NS = 50_000_000
WINDOWS = 6
SIZE = (64, 48)
RIG = SensorRig(
    cameras=(
        Camera(
            model="pinhole",
            intrinsics_px=np.array([50.0, 50.0, 31.5, 23.5]),
            size_px=SIZE,
            T_body_cam=se3.exp(np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])),
        ),
    ),
    imu=ImuNoise(gyro_noise=1e-4, gyro_walk=1e-5, accel_noise=1e-3, accel_walk=1e-4, rate_hz=200.0),
)


def pose(index: int) -> np.ndarray:
    return se3.exp(np.array([0.0, 0.0, 0.1 * index, 0.5 * index, 0.1 * index, 0.0]))


def window(index: int) -> Measurement:
    rng = np.random.default_rng(index)
    image = cv2.GaussianBlur(rng.integers(0, 256, SIZE[::-1], dtype=np.uint8), (0, 0), 4.0)
    stamps_ns = START_NS + STEP_NS * index + np.arange(0, STEP_NS + 1, STEP_NS // 10)
    previous = Frame(stamp_ns=int(stamps_ns[0]), images=(image,))
    current = Frame(stamp_ns=int(stamps_ns[-1]), images=(image,))
    gyro, accel = rng.normal(size=(2, len(stamps_ns), 3))
    tracks = Tracks(
        ids=np.arange(index, index + 5),
        pixels=rng.uniform(0, 40, (5, 2)),
        bearings=np.tile([0.0, 0.0, 1.0], (5, 1)),
        scores=np.ones(5),
    )
    return Measurement(
        window=SyncedWindow(
            previous=previous,
            current=current,
            imu=ImuBlock(stamps_ns=stamps_ns, gyro=gyro, accel=accel),
            gap_ns=STEP_NS // 10,
        ),
        features=VisualFeatures(frame=current, tracks=tracks),
    )


def state(index: int) -> NavState:
    return NavState(
        stamp_ns=START_NS + STEP_NS * (index + 1),
        T_world_body=pose(index),
        v_world_body=np.array([3.0, 4.0, 0.0]),
        bias=ImuBias(gyro=np.full(3, 0.01 * index), accel=np.full(3, 0.1)),
        status="starting" if index == 0 else "tracking",
    )


T_WORLD_TRUTH = se3.from_parts(so3.exp(np.array([0.0, 0.0, 2.0])), np.array([5.0, -3.0, 1.0]))
TRUTH = Trajectory(
    stamps_ns=np.array([state(index).stamp_ns for index in range(WINDOWS)]),
    T_world_body=se3.inverse(T_WORLD_TRUTH) @ np.array([pose(index) for index in range(WINDOWS)]),
)


def record(folder: Path, **options) -> RerunViewer:
    viewer = RerunViewer(**options)
    viewer.setup("a/walk", RIG, TRUTH, folder)
    for index in range(WINDOWS):
        viewer.watch(window(index), [state(index)])
    viewer.close()
    return viewer


def read(path: Path) -> dict[str, dict[str, list]]:
    """Values by entity and column, in order of stamps (``stamp``, ns) where they have them."""
    from rerun.chunk import RrdReader

    found: dict[str, dict[str, list]] = {}
    for chunk in RrdReader(path).stream().to_chunks():
        batch = chunk.to_record_batch()
        columns = found.setdefault(chunk.entity_path, {})
        for name in batch.schema.names:
            values = batch.column(name)
            kept = values.cast("int64") if name == "stamp" else values
            columns.setdefault(name, []).extend(kept.to_pylist())
    return found


@needs_rerun
def test_file_holds_what_the_pipeline_gave(tmp_path):
    viewer = record(tmp_path, every=2, image_scale=0.5, jpeg_quality=95)
    path = tmp_path / "a_walk.rrd"
    assert viewer.hint == f"rerun {path}"
    found = read(path)
    states = [state(index) for index in range(WINDOWS)]
    body = found["/world/body"]
    assert body["stamp"] == [s.stamp_ns for s in states]
    given = np.array(body["Transform3D:translation"]).reshape(-1, 3)
    np.testing.assert_allclose(given, [s.T_world_body[:3, 3] for s in states], atol=1e-6)
    # Rerun's matrices are column-major.
    rotations = np.array(body["Transform3D:mat3x3"]).reshape(-1, 3, 3).transpose(0, 2, 1)
    np.testing.assert_allclose(rotations, [s.T_world_body[:3, :3] for s in states], atol=1e-6)
    pieces = np.array(found["/world/estimate"]["LineStrips3D:strips"]).reshape(WINDOWS, 2, 3)
    np.testing.assert_allclose(pieces[:, 1], given, atol=1e-6)
    np.testing.assert_allclose(pieces[1:, 0], given[:-1], atol=1e-6)
    assert len({tuple(np.ravel(color)) for color in found["/world/estimate"]["LineStrips3D:colors"]}) == 2
    speed = np.ravel(found["/plots/speed"]["Scalars:scalars"])
    np.testing.assert_allclose(speed, 5.0)
    gyro = found["/plots/gyro"]
    samples = [row for row in gyro["Scalars:scalars"] if row is not None]
    expected = np.concatenate([window(index).window.imu.gyro[1:] for index in range(WINDOWS)])
    np.testing.assert_allclose(np.array(samples).reshape(-1, 3), expected)


@needs_rerun
def test_images_and_tracks_lie_on_each_other(tmp_path):
    record(tmp_path, every=2, image_scale=0.5, jpeg_quality=95)
    found = read(tmp_path / "a_walk.rrd")
    tracks = found["/world/body/cam0/tracks"]
    shown = range(0, WINDOWS, 2)
    assert tracks["stamp"] == [window(index).window.current.stamp_ns for index in shown]
    for index, points in zip(shown, tracks["Points2D:positions"], strict=True):
        # The corner of the first pixel is Rerun's origin, its centre ours.
        expected = (window(index).features.tracks.pixels + 0.5) / 2
        np.testing.assert_allclose(np.array(points).reshape(-1, 2), expected, atol=1e-5)
    blobs = [blob for blob in found["/world/body/cam0"]["EncodedImage:blob"] if blob]
    assert len(blobs) == len(shown)
    for index, blob in zip(shown, blobs, strict=True):
        packed = np.ravel(np.array(blob[0], dtype=np.uint8))
        image = cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE)
        original = window(index).window.current.images[0]
        halved = original.reshape(SIZE[1] // 2, 2, SIZE[0] // 2, 2).mean(axis=(1, 3))
        assert image.shape == (SIZE[1] // 2, SIZE[0] // 2)
        assert np.abs(image - halved).mean() < 2.0


@needs_rerun
def test_truth_is_moved_onto_the_first_tracked_state(tmp_path):
    record(tmp_path)
    line = np.array(read(tmp_path / "a_walk.rrd")["/world/ground_truth"]["LineStrips3D:strips"][0]).reshape(-1, 3)
    np.testing.assert_allclose(line, [pose(index)[:3, 3] for index in range(WINDOWS)], atol=1e-5)


@needs_rerun
def test_options_leave_out_images_and_imu(tmp_path):
    record(tmp_path, every=0, imu=False)
    found = read(tmp_path / "a_walk.rrd")
    assert "/world/body/cam0/tracks" not in found
    assert "stamp" not in found["/plots/gyro"]


@needs_rerun
def test_blind_rig_without_truth_or_features(tmp_path):
    viewer = RerunViewer()
    viewer.setup("blind", SensorRig(cameras=(), imu=RIG.imu), None, tmp_path)
    full = window(0).window
    frames = {name: Frame(stamp_ns=getattr(full, name).stamp_ns) for name in ("previous", "current")}
    viewer.watch(Measurement(window=SyncedWindow(**frames, imu=full.imu, gap_ns=full.gap_ns)), [])
    viewer.close()
    assert "/world/body" not in read(tmp_path / "blind.rrd")


@needs_rerun
def test_one_viewer_shows_sequence_after_sequence(tmp_path):
    viewer = RerunViewer()
    for name in ("one", "two"):
        viewer.setup(name, RIG, TRUTH, tmp_path)
        viewer.watch(window(0), [state(0)])
        viewer.close()
        viewer.close()
        assert viewer.hint.endswith(f"{name}.rrd")
        assert read(tmp_path / f"{name}.rrd")["/world/body"]["stamp"] == [state(0).stamp_ns]


@needs_rerun
def test_order_of_calls_and_unwritable_folder(tmp_path):
    with pytest.raises(StateError, match="before setup"):
        RerunViewer().watch(window(0), [])
    with pytest.raises(ConfigError, match="cannot write"):
        RerunViewer().setup("walk", RIG, None, tmp_path / "missing")


def test_truth_keeps_its_tilt_when_it_is_moved():
    """Only heading and position are free; an estimate that leans does not lean the truth."""
    leaning = NavState(stamp_ns=int(TRUTH.stamps_ns[2]), T_world_body=pose(2) @ se3.exp(np.array([0.3, 0, 0, 0, 0, 0])))
    T = module.truth_to_estimate(TRUTH, leaning)
    np.testing.assert_allclose(T[:3, 2], [0.0, 0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose((T @ TRUTH.T_world_body[2])[:3, 3], leaning.T_world_body[:3, 3], atol=1e-12)
    outside = NavState(stamp_ns=START_NS - 1, T_world_body=np.eye(4))
    assert module.truth_to_estimate(TRUTH, outside) is None


def test_thinning_keeps_the_ends():
    stamps_ns = START_NS + 5_000_000 * np.arange(20_001, dtype=np.int64)
    points = np.arange(60_003, dtype=float).reshape(-1, 3)
    kept = module.thin(points, stamps_ns)
    assert 4_000 < len(kept) <= 5_000
    np.testing.assert_array_equal(kept[[0, -1]], points[[0, -1]])


def test_colours_stay_with_their_ids():
    ids = np.array([3, 4, 1_000_000])
    colors = module.track_colors(ids)
    np.testing.assert_array_equal(module.track_colors(ids[::-1]), colors[::-1])
    assert len({tuple(color) for color in colors}) == 3
    assert module.track_colors(ids[:0]).shape == (0, 3)


@pytest.mark.parametrize(
    "address",
    ["127.0.0.1:9876", "http://127.0.0.1:9876/proxy", "rerun+http://127.0.0.1/proxy", "rerun+http://h:x/proxy"],
)
def test_addresses_that_are_none(address):
    with pytest.raises(ConfigError, match="is not like"):
        module.check_address(address, 1.0)


def test_no_viewer_at_the_address():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with pytest.raises(ConfigError, match="no viewer answers"):
        module.check_address(f"rerun+http://127.0.0.1:{port}/proxy", 1.0)


def test_missing_extra(monkeypatch):
    monkeypatch.setattr(module, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"pip install 'vioframe\[viewer\]'"):
        RerunViewer()


@pytest.mark.parametrize(
    "options", [{"every": -1}, {"image_scale": 0.0}, {"image_scale": 2.0}, {"jpeg_quality": 0}, {"timeout_s": 0.0}]
)
def test_options_out_of_range(options, monkeypatch):
    monkeypatch.setattr(module, "find_spec", lambda name: object())
    with pytest.raises(ConfigError, match=f"viewer.{next(iter(options))}"):
        RerunViewer(**options)


@needs_rerun
def test_configs_build_the_viewer_or_none():
    path = Path(module.__file__).parent / "conf" / "viewer" / "rerun.yaml"
    options = OmegaConf.load(path)
    assert set(options) - {"_target_"} == set(inspect.signature(RerunViewer).parameters)
    assert isinstance(build_viewer(OmegaConf.create({"viewer": options}), {"viewer": "rerun"}), RerunViewer)
    nothing = OmegaConf.load(core_conf() / "viewer" / "none.yaml")
    assert build_viewer(OmegaConf.create({"viewer": nothing}), {"viewer": "none"}) is None
    options.every = -1
    with pytest.raises(ConfigError, match="viewer.every"):
        build_viewer(OmegaConf.create({"viewer": options}), {"viewer": "rerun"})
