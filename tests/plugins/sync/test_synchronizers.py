"""Windows out of packets in any order, with holes, late and repeated packets, and what is counted."""

import itertools
import time
from dataclasses import replace

import numpy as np
import pytest

from inertial_truth import NOISE, make_rig
from vioframe.errors import ConfigError, StateError
from vioframe.interfaces import Synchronizer
from vioframe.testing import check_component
from vioframe.types import Frame, ImuBlock, Packet, SyncedWindow
from vioframe_sync import InterpolateSynchronizer, NearestSynchronizer

MS = 1_000_000
BOTH = [pytest.param(InterpolateSynchronizer, id="interpolate"), pytest.param(NearestSynchronizer, id="nearest")]


def block(stamps_ms: np.ndarray | list[float]) -> ImuBlock:
    """Samples whose values are linear in time, so that interpolation must be exact: gyro = t·(1, 2, 3) in s."""
    stamps_ns = np.round(np.asarray(stamps_ms, dtype=float) * MS).astype(np.int64)
    t = stamps_ns[:, None] * 1e-9
    return ImuBlock(stamps_ns=stamps_ns, gyro=t * [1.0, 2.0, 3.0], accel=9.81 + t * [-1.0, 0.5, 4.0])


def frame(ms: float) -> Frame:
    return Frame(stamp_ns=round(ms * MS))


def started(cls: type[Synchronizer], delay_ms: float = 0.0, **options: float) -> Synchronizer:
    synchronizer = cls(**options)
    synchronizer.setup(make_rig(NOISE, camera_delay_ns=round(delay_ms * MS)))
    return synchronizer


def run(synchronizer: Synchronizer, packets: list[Packet]) -> list[SyncedWindow]:
    windows = [window for packet in packets for window in synchronizer.push(packet)]
    return windows + synchronizer.flush()


def ends(windows: list[SyncedWindow]) -> list[tuple[float, float]]:
    return [(window.previous.stamp_ns / MS, window.current.stamp_ns / MS) for window in windows]


@pytest.mark.parametrize("cls", BOTH)
@pytest.mark.parametrize("option", ["max_wait_s", "max_gap_s"])
def test_a_limit_that_is_not_positive_is_refused(cls: type[Synchronizer], option: str) -> None:
    with pytest.raises(ConfigError, match=f"synchronizer.{option}.*0"):
        cls(**{option: 0.0})


@pytest.mark.parametrize("cls", BOTH)
def test_pushing_before_setup_is_refused(cls: type[Synchronizer]) -> None:
    with pytest.raises(StateError, match="setup"):
        cls().push(frame(0))


@pytest.mark.parametrize("cls", BOTH)
def test_keeps_the_contract(cls: type[Synchronizer]) -> None:
    check_component(cls())


def test_both_ends_are_interpolated_linearly() -> None:
    windows = run(started(InterpolateSynchronizer), [block(np.arange(0, 200, 5)), frame(11), frame(62.3), frame(110)])
    assert ends(windows) == [(11, 62.3), (62.3, 110)]
    for window in windows:
        exact = block(window.imu.stamps_ns / MS)
        np.testing.assert_allclose(window.imu.gyro, exact.gyro, atol=1e-12)
        np.testing.assert_allclose(window.imu.accel, exact.accel, atol=1e-12)
        inner = window.imu.stamps_ns[1:-1]
        measured = np.arange(0, 200 * MS, 5 * MS)
        expected = measured[(measured > window.previous.stamp_ns) & (measured < window.current.stamp_ns)]
        np.testing.assert_array_equal(inner, expected)


def test_interpolation_keeps_the_integral() -> None:
    """Cut at any stamps, the windows' trapezoids add up to that of the samples."""
    random = np.random.default_rng(2)
    stamps = np.arange(0, 1000, 5) * MS
    whole = ImuBlock(stamps_ns=stamps, gyro=random.normal(size=(200, 3)), accel=random.normal(size=(200, 3)))
    frames = [frame(x) for x in (5.0, 48.3, 97.777, 160.0, 161.0, 163.5, 990.0)]
    windows = run(started(InterpolateSynchronizer), [whole, *frames])
    assert len(windows) == len(frames) - 1
    pieces = sum(np.trapezoid(window.imu.gyro, window.imu.stamps_ns * 1e-9, axis=0) for window in windows)
    expected = np.trapezoid(whole.gyro[1:199], whole.stamps_ns[1:199] * 1e-9, axis=0)
    np.testing.assert_allclose(pieces, expected, atol=1e-12)


def test_nearest_takes_measured_samples_only() -> None:
    packets = [block(np.arange(0, 200, 5)), frame(11), frame(62.3), frame(64), frame(65)]
    windows = run(started(NearestSynchronizer), packets)
    assert ends(windows) == [(11, 62.3), (62.3, 64), (64, 65)]
    first = windows[0].imu
    np.testing.assert_allclose(first.gyro[0], block([10]).gyro[0])
    np.testing.assert_array_equal(first.stamps_ns[1:-1] / MS, np.arange(15, 60, 5))
    np.testing.assert_allclose(first.gyro[-1], block([60]).gyro[0])
    # A window shorter than the sample interval still has both ends.
    np.testing.assert_allclose(windows[1].imu.gyro, block([60, 65]).gyro)
    np.testing.assert_allclose(windows[2].imu.gyro, block([65, 65.0001]).gyro, atol=1e-6)


@pytest.mark.parametrize("cls", BOTH)
def test_frames_on_the_samples_need_no_others(cls: type[Synchronizer]) -> None:
    windows = run(started(cls), [block([0, 5, 10, 15, 20]), frame(0), frame(10), frame(20)])
    assert ends(windows) == [(0, 10), (10, 20)]
    np.testing.assert_array_equal(windows[0].imu.stamps_ns / MS, [0, 5, 10])
    np.testing.assert_array_equal(windows[1].imu.gyro, block([10, 15, 20]).gyro)


@pytest.mark.parametrize("cls", BOTH)
def test_a_delay_found_on_the_way_holds_for_the_frames_to_come(cls: type[Synchronizer]) -> None:
    """A frame that already waits keeps its stamp; windows still follow each other, and say what they contain."""
    synchronizer = started(cls, delay_ms=5.0)
    windows = run(synchronizer, [block(np.arange(0.0, 61.0, 5.0)), frame(0), frame(50)])
    synchronizer.push(frame(100))
    synchronizer.assume_camera_delay(15 * MS)
    windows += run(synchronizer, [frame(150), block(np.arange(65.0, 201.0, 5.0))])
    assert ends(windows) == [(5.0, 55.0), (55.0, 105.0), (105.0, 165.0)]
    assert [window.camera_delay_ns / MS for window in windows] == [5.0, 5.0, 15.0]
    synchronizer.setup(make_rig(NOISE, camera_delay_ns=5 * MS))
    windows = run(synchronizer, [block(np.arange(0.0, 61.0, 5.0)), frame(0), frame(50)])
    assert ends(windows) == [(5.0, 55.0)]


@pytest.mark.parametrize("cls", BOTH)
def test_the_camera_delay_moves_frames_to_the_imu_clock(cls: type[Synchronizer]) -> None:
    synchronizer = started(cls, delay_ms=7.0)
    picture = np.zeros((4, 4), dtype=np.uint8)
    windows = run(
        synchronizer, [block(np.arange(0, 100, 5)), Frame(stamp_ns=10 * MS, images=(picture,)), frame(50), frame(70)]
    )
    assert ends(windows) == [(17, 57), (57, 77)]
    assert windows[0].previous.images[0] is picture


@pytest.mark.parametrize("cls", BOTH)
@pytest.mark.parametrize("seed", range(4))
def test_the_order_of_arrival_does_not_matter(cls: type[Synchronizer], seed: int) -> None:
    """Two streams, each in order, that lag behind each other by up to 0.4 s give the windows of a tidy one."""
    random = np.random.default_rng(seed)
    blocks = [block(np.arange(start, start + 25, 5)) for start in range(0, 2000, 25)]
    frames = [frame(3 + 50 * k) for k in range(38)]
    tidy = run(started(cls), sorted([*blocks, *frames], key=_last))
    arrivals: list[tuple[float, int, Packet]] = []
    for stream in (blocks, frames):
        when = np.maximum.accumulate([_last(p) + 400 * MS * random.random() for p in stream])
        arrivals += [(at, len(arrivals) + k, p) for k, (at, p) in enumerate(zip(when, stream, strict=True))]
    synchronizer = started(cls, max_wait_s=1.0)
    got = run(synchronizer, [p for _, _, p in sorted(arrivals, key=lambda item: item[:2])])
    assert len(tidy) == 37 and ends(got) == ends(tidy)
    for one, other in zip(got, tidy, strict=True):
        np.testing.assert_array_equal(one.imu.stamps_ns, other.imu.stamps_ns)
        np.testing.assert_array_equal(one.imu.gyro, other.imu.gyro)
    assert not any(synchronizer.counters().values())
    for before, after in itertools.pairwise(got):
        assert before.current.stamp_ns == after.previous.stamp_ns


def _last(packet: Packet) -> int:
    return packet.stamp_ns if isinstance(packet, Frame) else int(packet.stamps_ns[-1])


@pytest.mark.parametrize("cls", BOTH)
def test_frames_first_then_samples(cls: type[Synchronizer]) -> None:
    synchronizer = started(cls)
    assert synchronizer.push(frame(10)) == [] and synchronizer.push(frame(30)) == []
    assert synchronizer.push(block(np.arange(0, 30, 5))) == []
    assert ends(synchronizer.push(block([30]))) == [(10, 30)]


@pytest.mark.parametrize("cls", BOTH)
def test_crossed_frames_are_put_in_order(cls: type[Synchronizer]) -> None:
    synchronizer = started(cls)
    windows = run(synchronizer, [frame(30), frame(10), frame(50), block(np.arange(0, 100, 5))])
    assert ends(windows) == [(10, 30), (30, 50)]
    assert not any(synchronizer.counters().values())


@pytest.mark.parametrize("cls", BOTH)
def test_images_alone_make_windows_at_once_and_without_samples(cls: type[Synchronizer]) -> None:
    synchronizer = cls()
    synchronizer.setup(replace(make_rig(NOISE, camera_delay_ns=5 * MS), has_imu=False))
    windows = [synchronizer.push(frame(ms)) for ms in (0.0, 100.0, 200.0, 150.0, 300.0)]
    # The one that came after a later one had been used is late, as ever.
    assert [ends(each) for each in windows] == [[], [(5, 105)], [(105, 205)], [], [(205, 305)]]
    assert [(len(w.imu), w.gap_ns, w.camera_delay_ns) for w in windows[1]] == [(0, 100 * MS, 5 * MS)]
    assert synchronizer.flush() == [] and synchronizer.counters()["dropped frames"] == 1


@pytest.mark.parametrize("cls", BOTH)
def test_early_late_and_repeated_frames_are_dropped_and_counted(cls: type[Synchronizer]) -> None:
    synchronizer = started(cls)
    windows = run(
        synchronizer,
        [frame(3), block(np.arange(10, 100, 5)), frame(20), frame(40), frame(40), frame(30), frame(60), frame(200)],
    )
    assert ends(windows) == [(20, 40), (40, 60)]
    # 3 ms is before the first sample, 40 repeats, 30 comes after 40 was used, 200 is after the last sample.
    assert synchronizer.counters()["dropped frames"] == 4


@pytest.mark.parametrize("cls", BOTH)
def test_a_frame_waits_no_longer_than_allowed(cls: type[Synchronizer]) -> None:
    synchronizer = started(cls, max_wait_s=0.2)
    synchronizer.push(block(np.arange(0, 105, 5)))
    for k in range(1, 40):
        synchronizer.push(frame(50 * k))
        assert len(synchronizer._waiting) <= 5
    windows = synchronizer.push(block(np.arange(1900, 2000, 5)))
    # The stretch without samples is one window, and its hole is told.
    assert ends(windows)[0] == (100, 1750) and windows[0].gap_ns == 1800 * MS
    assert ends(windows)[-1] == (1900, 1950)
    assert synchronizer.counters()["dropped frames"] == 32
    assert synchronizer.counters()["inertial gaps"] == 1


@pytest.mark.parametrize("cls", BOTH)
def test_a_hole_in_the_samples_is_survived_and_told(cls: type[Synchronizer]) -> None:
    synchronizer = started(cls)
    stamps = np.concatenate([np.arange(0, 101, 5), np.arange(400, 600, 5)])
    windows = run(synchronizer, [block(stamps), *(frame(50 * k) for k in range(11))])
    assert len(windows) == 10
    gaps = [window.gap_ns / MS for window in windows]
    # Every window that the hole from 100 to 400 ms touches tells all of it.
    assert gaps == [5, 5, 300, 300, 300, 300, 300, 300, 5, 5]
    assert synchronizer.counters()["inertial gaps"] == 1


@pytest.mark.parametrize("cls", BOTH)
def test_a_slow_sensor_is_not_called_a_hole(cls: type[Synchronizer]) -> None:
    from dataclasses import replace

    synchronizer = cls()
    synchronizer.setup(make_rig(replace(NOISE, rate_hz=10.0)))
    run(synchronizer, [block(np.arange(0, 3000, 100)), *(frame(100 * k) for k in range(29))])
    assert not any(synchronizer.counters().values())


@pytest.mark.parametrize("cls", BOTH)
def test_missing_frames_are_counted(cls: type[Synchronizer]) -> None:
    synchronizer = started(cls)
    kept = [k for k in range(30) if k not in (12, 20, 21, 22)]
    windows = run(synchronizer, [block(np.arange(0, 1500, 5)), *(frame(50 * k) for k in kept)])
    assert len(windows) == len(kept) - 1
    assert synchronizer.counters()["missing frames"] == 4


@pytest.mark.parametrize("cls", BOTH)
def test_repeated_and_late_samples_are_dropped_and_counted(cls: type[Synchronizer]) -> None:
    synchronizer = started(cls)
    packets = [block([0, 5, 10]), block([5, 10, 15]), block([0, 5]), block([15, 20, 25]), frame(0), frame(25)]
    windows = run(synchronizer, packets)
    np.testing.assert_array_equal(windows[0].imu.stamps_ns / MS, [0, 5, 10, 15, 20, 25])
    assert synchronizer.counters()["dropped inertial samples"] == 5


@pytest.mark.parametrize("cls", BOTH)
def test_setup_forgets(cls: type[Synchronizer]) -> None:
    synchronizer = started(cls)
    run(synchronizer, [block(np.arange(0, 100, 5)), frame(500), frame(20), frame(20)])
    synchronizer.setup(make_rig(NOISE))
    assert not any(synchronizer.counters().values())
    assert ends(run(synchronizer, [block(np.arange(0, 100, 5)), frame(10), frame(20)])) == [(10, 20)]


@pytest.mark.parametrize("cls", BOTH)
def test_clocks_without_overlap_are_said(cls: type[Synchronizer], caplog: pytest.LogCaptureFixture) -> None:
    run(started(cls), [block(np.arange(0, 100, 5)), frame(1e6), frame(1e6 + 50)])
    assert "both clocks overlap" in caplog.text


@pytest.mark.parametrize("cls", BOTH)
@pytest.mark.parametrize("per_block", [1, 10])
def test_memory_is_flat_and_packets_are_cheap(cls: type[Synchronizer], per_block: int) -> None:
    synchronizer = started(cls)
    stamps = np.arange(0, 60_000, 5)
    packets: list[Packet] = [block(stamps[k : k + per_block]) for k in range(0, len(stamps), per_block)]
    packets = sorted([*packets, *(frame(50 * k + 2) for k in range(1, 1200))], key=_last)
    held, windows = 0, 0
    begun = time.process_time()
    for packet in packets:
        windows += len(synchronizer.push(packet))
        held = max(held, sum(len(part) for part in synchronizer._blocks))
    taken = (time.process_time() - begun) / len(packets)
    assert windows == 1198
    assert held <= 30
    assert taken < 3e-4  # about 0.05 ms on a quiet machine


@pytest.mark.parametrize("cls", BOTH)
def test_samples_without_frames_do_not_pile_up(cls: type[Synchronizer]) -> None:
    synchronizer = started(cls, max_wait_s=0.5)
    for start in range(0, 60_000, 50):
        synchronizer.push(block(np.arange(start, start + 50, 5)))
    assert sum(len(part) for part in synchronizer._blocks) <= 0.5 * 200 + 20
