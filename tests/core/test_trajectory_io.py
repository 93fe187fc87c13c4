"""Trajectory files: wrong input first, then exact stamps, round trips and real files."""

from pathlib import Path

import numpy as np
import pytest

from shared_data import shared_data
from vioframe import trajectory_io
from vioframe.errors import ClockError, DataError
from vioframe.geometry import se3, so3
from vioframe.trajectory_io import read_trajectory, write_euroc, write_kitti, write_tum
from vioframe.types import Trajectory

IDENTITY_TUM = "0 0 0 0 0 0 1"


def write(tmp_path: Path, text: str, name: str = "trajectory.txt") -> Path:
    path = tmp_path / name
    path.write_text(text)
    return path


@pytest.fixture
def trajectory() -> Trajectory:
    rng = np.random.default_rng(3)
    count = 200
    stamps = 1403715273262142976 + np.cumsum(rng.integers(1_000_000, 9_000_001, count))
    T = se3.from_parts(so3.exp(rng.normal(size=(count, 3)) * 2.0), rng.normal(size=(count, 3)) * 500.0)
    return Trajectory(stamps_ns=stamps, T_world_body=T, v_world_body=rng.normal(size=(count, 3)))


@pytest.mark.parametrize(
    ("text", "error", "words"),
    [
        ("", DataError, "empty"),
        ("# only a comment\n", DataError, "empty"),
        (f"1.0 {IDENTITY_TUM}\n2.0 0 0\n", DataError, ":2: .*3 columns"),
        (f"# c\n\n1.0 {IDENTITY_TUM}\n2.0 0 nan 0 0 0 0 1\n", DataError, ":4: column 3 is nan"),
        (f"1.0 {IDENTITY_TUM}\n2.0 0 x 0 0 0 0 1\n", DataError, ":2: column 3 .*'x', not a number"),
        (f"2.0 {IDENTITY_TUM}\n1.0 {IDENTITY_TUM}\n", ClockError, ":2: .*earlier"),
        (f"1.0 {IDENTITY_TUM}\n2.0 0 0 0 0 0 0 0\n", DataError, ":2: .*unit length"),
        ("1 2 3\n", DataError, ":1: 3 columns fit none"),
        ("1403715273.26,0,0,0,1,0,0,0,0,0,0\n", DataError, "fit none"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n2 0 0 0 0 1 0 0 0 0 1 0\n", DataError, ":2: .*not a rotation"),
        ("3 1 0 0 0 0 1 0 0 0 0 1 0\n3 1 0 0 0 0 1 0 0 0 0 1 0\n", DataError, ":2: .*frame index"),
    ],
)
def test_what_is_wrong_is_told_with_file_and_line(
    tmp_path: Path, text: str, error: type[DataError], words: str
) -> None:
    with pytest.raises(error, match=words) as caught:
        read_trajectory(write(tmp_path, text))
    assert "trajectory.txt" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no such file"):
        read_trajectory(tmp_path / "nothing.txt")


def test_repeated_stamps(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = write(tmp_path, f"1.0 {IDENTITY_TUM}\n2.0 {IDENTITY_TUM}\n2.0 5 0 0 0 0 0 1\n3.0 {IDENTITY_TUM}\n")
    with pytest.raises(ClockError, match=r":3: .*repeats"):
        read_trajectory(path, repeated="refuse")
    read = read_trajectory(path)
    assert read.stamps_ns.tolist() == [1_000_000_000, 2_000_000_000, 3_000_000_000]
    assert read.T_world_body[1, 0, 3] == 0.0
    assert "1 of 4 rows repeat" in caplog.text and "line 3" in caplog.text


def test_wrong_units_are_told(tmp_path: Path) -> None:
    with pytest.raises(ClockError, match=r":1: .*seconds"):
        read_trajectory(write(tmp_path, "1403715273.26,0,0,0,1,0,0,0\n1403715273.27,0,0,0,1,0,0,0\n"), "euroc")
    with pytest.raises(ClockError, match="nanoseconds"):
        read_trajectory(write(tmp_path, f"1403715273262142976 {IDENTITY_TUM}\n"), "tum")
    with pytest.raises(ClockError, match="1 ns apart"):
        read_trajectory(write(tmp_path, "10,0,0,0,1,0,0,0\n11,0,0,0,1,0,0,0\n12,0,0,0,1,0,0,0\n"), "euroc")


def test_stamps_in_seconds_keep_every_digit(tmp_path: Path) -> None:
    text = f"1403715274.302142976 {IDENTITY_TUM}\n1.403715529112143517e+09 {IDENTITY_TUM}\n"
    assert read_trajectory(write(tmp_path, text)).stamps_ns.tolist() == [1403715274302142976, 1403715529112143517]


def test_integer_stamps_keep_every_digit(tmp_path: Path) -> None:
    text = "1403715273262142977,0,0,0,1,0,0,0\n1403715273267142912,0,0,0,1,0,0,0\n"
    assert read_trajectory(write(tmp_path, text)).stamps_ns.tolist() == [1403715273262142977, 1403715273267142912]


@pytest.mark.parametrize("stamp_ns", [0, 5, -5, -1_000_000_001, 1403715274302142976])
def test_format_seconds_is_the_inverse_of_parsing(stamp_ns: int) -> None:
    from vioframe.tables import seconds_to_ns

    assert seconds_to_ns(trajectory_io.format_seconds(stamp_ns)) == stamp_ns


def test_quaternion_order(tmp_path: Path) -> None:
    """A quarter turn about z takes x to y in every format."""
    half = np.sqrt(0.5)
    tum = read_trajectory(write(tmp_path, f"1.0 0 0 0 0 0 {half} {half}\n"))
    euroc = read_trajectory(write(tmp_path, f"1403715273262142976,0,0,0,{half},0,0,{half}\n"))
    for read in (tum, euroc):
        np.testing.assert_allclose(read.T_world_body[0, :3, :3] @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-12)


def test_round_trips(tmp_path: Path, trajectory: Trajectory) -> None:
    write_tum(tmp_path / "t.tum", trajectory)
    write_euroc(tmp_path / "t.csv", trajectory)
    write_kitti(tmp_path / "t.kitti", trajectory, tmp_path / "times.txt")
    for back in (
        read_trajectory(tmp_path / "t.tum"),
        read_trajectory(tmp_path / "t.csv"),
        read_trajectory(tmp_path / "t.kitti", stamps=tmp_path / "times.txt"),
        read_trajectory(tmp_path / "t.kitti", "kitti", stamps=trajectory.stamps_ns),
    ):
        np.testing.assert_array_equal(back.stamps_ns, trajectory.stamps_ns)
        np.testing.assert_allclose(back.T_world_body, trajectory.T_world_body, atol=1e-9)
    velocity = read_trajectory(tmp_path / "t.csv").v_world_body
    assert velocity is not None and trajectory.v_world_body is not None
    np.testing.assert_allclose(velocity, trajectory.v_world_body, atol=1e-9)


@pytest.mark.parametrize("causal", [True, False])
def test_whether_it_is_causal_survives(tmp_path: Path, trajectory: Trajectory, causal: bool) -> None:
    given = Trajectory(stamps_ns=trajectory.stamps_ns, T_world_body=trajectory.T_world_body, causal=causal)
    write_tum(tmp_path / "t.tum", given)
    write_euroc(tmp_path / "t.csv", given)
    assert read_trajectory(tmp_path / "t.tum").causal is causal
    assert read_trajectory(tmp_path / "t.csv").causal is causal


def test_kitti_frame_index_picks_the_stamp(tmp_path: Path) -> None:
    path = write(tmp_path, "4 1 0 0 7 0 1 0 0 0 0 1 0\n6 1 0 0 8 0 1 0 0 0 0 1 0\n")
    stamps = np.arange(7, dtype=np.int64) ** 2 * 1_000_000
    assert read_trajectory(path, stamps=stamps).stamps_ns.tolist() == [16_000_000, 36_000_000]
    assert read_trajectory(path).stamps_ns.tolist() == [400_000_000, 600_000_000]
    with pytest.raises(DataError, match="frame 6 has no stamp"):
        read_trajectory(path, stamps=stamps[:6])


def test_real_files() -> None:
    euroc = read_trajectory(shared_data("trajectories", "evo", "V102_groundtruth.csv"))
    assert len(euroc) == 16702 and euroc.stamps_ns[0] == 1403715524907143168 and euroc.v_world_body is not None
    assert len(read_trajectory(shared_data("trajectories", "evo", "V102.txt"))) == 803
    assert len(read_trajectory(shared_data("trajectories", "evo", "freiburg1_xyz-groundtruth.txt"))) == 3000
    assert len(read_trajectory(shared_data("trajectories", "evo", "KITTI_00_ORB.txt"))) == 4541
    kitti = read_trajectory(shared_data("trajectories", "kitti_odom_eval", "10.txt"))
    assert len(kitti) == 1197 and kitti.stamps_ns[0] == 4 * trajectory_io.KITTI_STEP_NS
    optitrack = shared_data("euroc_imu_gt", "V1_01_easy", "mav0", "gt_openvins_V1_01_easy_optitrack_corrected.csv")
    assert len(read_trajectory(optitrack)) == 2895


def test_reading_a_long_file_is_quick() -> None:
    import time

    path = shared_data("euroc_imu_gt", "MH_01_easy", "mav0", "state_groundtruth_estimate0", "data.csv")
    started = time.process_time()
    read_trajectory(path)
    assert time.process_time() - started < 1.5
