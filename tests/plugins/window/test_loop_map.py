"""Maps on disk: to be started in, to be refused where they do not belong, and never to run anything."""

import io
import pickle
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from loop_scenes import CAMERA, RIG, STEP_NS, PointWorld, circle
from vioframe.errors import DataError
from vioframe.geometry import se3, so3
from vioframe.types import SensorRig, Trajectory
from vioframe_window import BowLoop
from vioframe_window.loop_map import load_map


def give(loop: BowLoop, world: PointWorld, truth: np.ndarray, poses: np.ndarray, seed: int) -> int:
    """Walk; the number of matches."""
    rng = np.random.default_rng(seed)
    matches = [
        loop.add_keyframe(world.keyframe(index, T_true, T_world, rng))
        for index, (T_true, T_world) in enumerate(zip(truth, poses, strict=True))
    ]
    return sum(match is not None for match in matches)


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, PointWorld, np.ndarray]:
    truth = circle(0.6)
    world = PointWorld.around(truth, 0)
    path = tmp_path_factory.mktemp("maps") / "place.npz"
    loop = BowLoop(save_map=str(path))
    loop.setup(RIG)
    give(loop, world, truth, truth, 1)
    loop.finish()
    return path, world, truth


def test_a_map_comes_back_as_it_was(stored: tuple[Path, PointWorld, np.ndarray]) -> None:
    path, _, truth = stored
    places = load_map(path, CAMERA)
    np.testing.assert_allclose(places.T_map_body, truth, atol=1e-12)
    np.testing.assert_array_equal(places.stamps_ns, np.arange(len(truth)) * STEP_NS)
    assert min(len(seen) for seen in places.appearances) > 10
    assert not list(path.parent.glob("*.part"))


def test_a_sequence_that_starts_in_a_map_comes_out_in_its_frame(stored: tuple[Path, PointWorld, np.ndarray]) -> None:
    path, world, truth = stored
    T_map_world = se3.from_parts(so3.rotation_z(1.1), np.array([5.0, -3.0, 0.7]))
    second = truth[10:40]
    poses = se3.inverse(T_map_world) @ second
    loop = BowLoop(load_map=str(path))
    loop.setup(RIG)
    np.testing.assert_array_equal(loop.T_map_world, np.eye(4))
    assert give(loop, world, second, poses, 2) > 10
    stamps_ns = np.arange(len(poses), dtype=np.int64) * STEP_NS
    final = loop.correct(Trajectory(stamps_ns=stamps_ns, T_world_body=poses)).T_world_body
    assert np.linalg.norm(final[:, :3, 3] - second[:, :3, 3], axis=1).max() < 0.05
    assert np.degrees(so3.angle(np.swapaxes(final[:, :3, :3], 1, 2) @ second[:, :3, :3])).max() < 0.5


def test_one_look_alike_alone_does_not_move_a_sequence_into_a_map(stored: tuple[Path, PointWorld, np.ndarray]) -> None:
    path, world, truth = stored
    loop = BowLoop(load_map=str(path))
    loop.setup(RIG)
    assert give(loop, world, truth[20:21], truth[:1], 3) == 0
    np.testing.assert_array_equal(loop.T_map_world, np.eye(4))


def test_a_map_grows_by_the_sequence_that_started_in_it(
    stored: tuple[Path, PointWorld, np.ndarray], tmp_path: Path
) -> None:
    path, world, truth = stored
    loop = BowLoop(load_map=str(path), save_map=str(tmp_path / "grown.npz"))
    loop.setup(RIG)
    give(loop, world, truth[10:30], truth[10:30], 4)
    loop.finish()
    assert len(load_map(tmp_path / "grown.npz", CAMERA).stamps_ns) == len(truth) + 20


def test_a_sequence_that_was_not_found_in_a_map_is_not_saved_into_it(
    stored: tuple[Path, PointWorld, np.ndarray], tmp_path: Path
) -> None:
    path, _, truth = stored
    loop = BowLoop(load_map=str(path), save_map=str(tmp_path / "same.npz"))
    loop.setup(RIG)
    give(loop, PointWorld.around(truth, 99), truth[:20], truth[:20], 5)
    loop.finish()
    assert len(load_map(tmp_path / "same.npz", CAMERA).stamps_ns) == len(truth)


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"size_px": (752, 480)}, "size"),
        ({"intrinsics_px": np.array([458.0, 457.0, 367.0, 248.0])}, "intrinsics"),
        ({"model": "radtan", "distortion": np.array([-0.28, 0.07, 0.0, 0.0])}, "model"),
        ({"T_body_cam": np.eye(4)}, "T_body_cam"),
    ],
)
def test_a_map_of_another_rig_is_refused(
    stored: tuple[Path, PointWorld, np.ndarray], changes: dict[str, object], what: str
) -> None:
    rig = SensorRig(cameras=(replace(CAMERA, **changes),), imu=RIG.imu)
    with pytest.raises(DataError, match=rf"another rig.*{what}"):
        BowLoop(load_map=str(stored[0])).setup(rig)


class Burglar:
    """Creates a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        return Path.touch, (self.path,)


def test_a_map_with_a_program_in_it_runs_nothing(stored: tuple[Path, PointWorld, np.ndarray], tmp_path: Path) -> None:
    mark, bad = tmp_path / "mark", tmp_path / "bad.npz"
    with np.load(stored[0]) as arrays:
        parts = dict(arrays)
    parts["stamps_ns"] = np.array([Burglar(mark)] * len(parts["stamps_ns"]), dtype=object)
    np.savez(bad, **parts)
    with pytest.raises(DataError, match="bad.npz"):
        load_map(bad, CAMERA)
    bad.write_bytes(pickle.dumps(Burglar(mark)))
    with pytest.raises(DataError, match="bad.npz"):
        load_map(bad, CAMERA)
    assert not mark.exists()


def spoil(parts: dict[str, np.ndarray], name: str) -> None:
    if name == "corner_counts":
        parts[name] = parts[name] + 1
    elif name in ("T_map_body", "T_body_cam"):
        parts[name] = 2.0 * parts[name]
    elif name == "version":
        parts[name] = np.array([99])
    elif name == "descriptors":
        parts[name] = parts[name].astype(np.int64)
    else:
        del parts[name]


@pytest.mark.parametrize("name", ["corner_counts", "T_map_body", "T_body_cam", "version", "descriptors", "bearings"])
def test_a_map_that_does_not_hold_together_is_refused(
    stored: tuple[Path, PointWorld, np.ndarray], tmp_path: Path, name: str
) -> None:
    with np.load(stored[0]) as arrays:
        parts = dict(arrays)
    spoil(parts, name)
    np.savez(tmp_path / "bad.npz", **parts)
    with pytest.raises(DataError, match="bad.npz"):
        load_map(tmp_path / "bad.npz", CAMERA)


def test_an_array_that_states_more_than_it_holds_is_refused(
    stored: tuple[Path, PointWorld, np.ndarray], tmp_path: Path
) -> None:
    path = tmp_path / "bad.npz"
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**14, 2)})
    with zipfile.ZipFile(stored[0]) as good, zipfile.ZipFile(path, "w") as bad:
        for name in good.namelist():
            bad.writestr(name, header.getvalue() if name == "pixels.npy" else good.read(name))
    with pytest.raises(DataError, match="bad.npz"):
        load_map(path, CAMERA)


@pytest.mark.parametrize("content", [b"", b"not a map", None])
def test_a_file_that_is_no_map_is_refused(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "nothing.npz"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(DataError, match="nothing.npz"):
        load_map(path, CAMERA)
