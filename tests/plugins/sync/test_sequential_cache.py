"""Windows that never stop coming: jitter, late and missing images, silent sensors, from the start or later."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from inertial_truth import NOISE, make_rig
from vioframe.errors import ConfigError, StateError
from vioframe.testing import check_component
from vioframe.types import Frame, ImuBlock, Packet, SyncedWindow
from vioframe_sync import SequentialCacheSynchronizer

MS = 1_000_000


def block(stamps_ms: np.ndarray | list[float]) -> ImuBlock:
    """Samples whose values are linear in time: gyro = t·(1, 2, 3) in s."""
    stamps_ns = np.round(np.asarray(stamps_ms, dtype=float) * MS).astype(np.int64)
    t = stamps_ns[:, None] * 1e-9
    return ImuBlock(stamps_ns=stamps_ns, gyro=t * [1.0, 2.0, 3.0], accel=9.81 + t * [-1.0, 0.5, 4.0])


def frame(ms: float) -> Frame:
    return Frame(stamp_ns=round(ms * MS))


def started(**options: float | None) -> SequentialCacheSynchronizer:
    synchronizer = SequentialCacheSynchronizer(**options)  # type: ignore[arg-type]
    synchronizer.setup(make_rig(NOISE))
    return synchronizer


def run(synchronizer: SequentialCacheSynchronizer, packets: list[Packet]) -> list[SyncedWindow]:
    windows = [window for packet in packets for window in synchronizer.push(packet)]
    return windows + synchronizer.flush()


def stream(images_ms: list[float], samples_ms: np.ndarray, per_block: int = 5) -> list[Packet]:
    """Both sensors in the order of their stamps."""
    samples = [block(samples_ms[k : k + per_block]) for k in range(0, len(samples_ms), per_block)]
    return sorted([*samples, *map(frame, images_ms)], key=newest)


def newest(packet: Packet) -> int:
    return packet.stamp_ns if isinstance(packet, Frame) else int(packet.stamps_ns[-1])


def ends(windows: list[SyncedWindow]) -> list[tuple[float, float]]:
    return [(window.previous.stamp_ns / MS, window.current.stamp_ns / MS) for window in windows]


def check_chain(windows: list[SyncedWindow]) -> None:
    """Windows follow each other without a break, and share their frames."""
    for before, after in itertools.pairwise(windows):
        assert before.current is after.previous
    for window in windows:
        assert window.current.stamp_ns > window.previous.stamp_ns
        assert len(window.imu) in (0, 11)
        assert window.gap_ns > 0


IMAGES = [100.0 * k for k in range(101)]
SAMPLES = np.arange(-50.0, 10_050.0, 5.0)


def without(values: np.ndarray, start: float, end: float) -> np.ndarray:
    return values[(values <= start) | (values >= end)]


@pytest.mark.parametrize(
    "option", ["max_wait_s", "max_gap_s", "max_bridge_s", "max_stretch_s", "image_interval_s", "poses"]
)
def test_an_option_that_is_not_positive_is_refused(option: str) -> None:
    with pytest.raises(ConfigError, match=f"synchronizer.{option}.*0"):
        SequentialCacheSynchronizer(**{option: 0})  # type: ignore[arg-type]


def test_a_bridge_longer_than_the_wait_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"max_bridge_s=0.5 must not exceed max_wait_s=0.1"):
        SequentialCacheSynchronizer(max_wait_s=0.1, max_bridge_s=0.5)


def test_keeps_the_contract() -> None:
    check_component(SequentialCacheSynchronizer())
    with pytest.raises(StateError, match="setup"):
        SequentialCacheSynchronizer().push(frame(0))


def test_every_image_has_its_window_with_ten_even_intervals() -> None:
    synchronizer = started()
    windows = run(synchronizer, stream(IMAGES, SAMPLES))
    assert ends(windows) == list(itertools.pairwise(IMAGES))
    check_chain(windows)
    assert not any(synchronizer.counters().values())
    for window in windows:
        np.testing.assert_array_equal(np.diff(window.imu.stamps_ns), 10 * MS)
        np.testing.assert_allclose(window.imu.gyro, block(window.imu.stamps_ns / MS).gyro, atol=1e-9)


@pytest.mark.parametrize(("step", "intervals"), [(5.0, 7), (3.7, 10), (40.0, 10), (5.0, None)])
def test_any_rate_gives_the_number_asked_for(step: float, intervals: int | None) -> None:
    windows = run(started(poses=intervals), stream(IMAGES, np.arange(-50.0, 10_050.0, step)))
    assert len(windows) == 100
    assert {len(window.imu) for window in windows} == {21 if intervals is None else intervals + 1}


def test_jittered_and_late_images_keep_their_stamps() -> None:
    random = np.random.default_rng(3)
    images = [t + 30.0 * random.uniform(-1, 1) for t in IMAGES]
    windows = run(started(), stream(images, SAMPLES))
    np.testing.assert_allclose(ends(windows), list(itertools.pairwise(images)), atol=1e-6)
    check_chain(windows)


def test_a_few_missing_images_make_one_longer_window() -> None:
    images = [t for t in IMAGES if t not in (2000.0, 5000.0, 5100.0)]
    synchronizer = started()
    windows = run(synchronizer, stream(images, SAMPLES))
    assert ends(windows) == list(itertools.pairwise(images))
    assert synchronizer.counters()["missing frames"] == 3
    assert synchronizer.counters()["stand-ins for images"] == 0


@pytest.mark.parametrize("step", [50.0, 100.0, 200.0])
@pytest.mark.parametrize("lost", [(3000.0, 8000.0), (-1.0, 4000.0), (4000.0, 20_000.0)])
def test_without_images_windows_go_on_at_the_usual_interval(step: float, lost: tuple[float, float]) -> None:
    images = [step * k for k in range(round(10_000 / step) + 1)]
    images = [t for t in images if not lost[0] < t < lost[1]]
    synchronizer = started(image_interval_s=step / 1000.0)
    windows = run(synchronizer, stream(images, SAMPLES))
    check_chain(windows)
    assert [w.current.stamp_ns / MS for w in windows if not w.current.missing][-50:] == images[1:][-50:] or lost[0] < 0
    stand_ins = [w.current.stamp_ns / MS for w in windows if w.current.missing]
    length = min(lost[1], SAMPLES[-1]) - max(lost[0], SAMPLES[0])
    assert len(stand_ins) == pytest.approx(length / step, abs=1.6)
    assert all(len(w.imu) for w in windows)
    widths = np.array([b - a for a, b in ends(windows)])
    assert widths.min() >= 0.5 * step - 1e-6 and widths.max() <= 1.5 * step + 1e-6
    assert synchronizer.counters()["stand-ins for images"] == pytest.approx(len(stand_ins), abs=1)


def test_the_usual_interval_is_learnt_from_the_images() -> None:
    images = [500.0 * k for k in range(21) if not 9 < k < 15]
    windows = run(started(), stream(images, SAMPLES))
    steady = [b - a for a, b in ends(windows)][10:]
    assert set(steady[2:]) == {500.0}


@pytest.mark.parametrize("lost", [(3000.0, 8000.0), (-100.0, 4000.0), (4000.0, 20_000.0)])
@pytest.mark.parametrize("shift", [0.0, 3.0])
def test_without_samples_windows_are_empty(lost: tuple[float, float], shift: float) -> None:
    images = [t + shift for t in IMAGES]
    synchronizer = started()
    windows = run(synchronizer, stream(images, without(SAMPLES, *lost)))
    assert ends(windows) == list(itertools.pairwise(images))
    check_chain(windows)
    for window in windows:
        start, end = window.previous.stamp_ns / MS, window.current.stamp_ns / MS
        overlap = min(end, lost[1]) - max(start, lost[0])
        assert (len(window.imu) == 0) == (overlap > 50.0)
    empty = sum(not len(window.imu) for window in windows)
    assert synchronizer.counters()["windows without inertial samples"] == empty > 35


def test_a_window_that_reaches_into_a_hole_keeps_its_last_value_and_tells() -> None:
    windows = run(started(poses=None), stream(IMAGES, without(SAMPLES, 2070.0, 5000.0)))
    window = windows[20]
    assert len(window.imu) and window.gap_ns == 30 * MS
    np.testing.assert_array_equal(window.imu.gyro[-1], block([2070.0]).gyro[0])
    assert window.imu.stamps_ns[-1] == 2100 * MS
    # A short hole is bridged, and all of it is told.
    window = run(started(poses=None), stream(IMAGES, without(SAMPLES, 2070.0, 2170.0)))[20]
    np.testing.assert_allclose(window.imu.gyro[-1], block([2100.0]).gyro[0], atol=1e-12)
    assert window.gap_ns == 100 * MS


def test_both_sensors_silent_make_one_window_across() -> None:
    images = [t for t in IMAGES if not 3000.0 < t < 6000.0]
    windows = run(started(), stream(images, without(SAMPLES, 2990.0, 5500.0)))
    check_chain(windows)
    across = [w for w in windows if w.current.stamp_ns - w.previous.stamp_ns > 200 * MS]
    assert ends(across) == [(3000.0, 5500.0)]
    assert across[0].current.missing and not len(across[0].imu)
    assert sum(w.current.missing for w in windows) == 5


@pytest.mark.parametrize("seed", range(4))
def test_the_order_of_arrival_does_not_matter(seed: int) -> None:
    """Two streams, each in order, that lag by up to 0.4 s give the windows of a tidy one, holes and all."""
    random = np.random.default_rng(seed)
    images = [t for t in IMAGES if not 3000.0 < t < 4500.0 and random.random() < 0.8]
    samples = without(without(SAMPLES, 6000.0, 7100.0), 2020.0, 2130.0)
    tidy = stream(images, samples)
    arrivals: list[tuple[float, int, Packet]] = []
    for kind in (Frame, ImuBlock):
        own = [packet for packet in tidy if isinstance(packet, kind)]
        when = np.maximum.accumulate([newest(p) + 400 * MS * random.random() for p in own])
        arrivals += [(at, len(arrivals) + k, p) for k, (at, p) in enumerate(zip(when, own, strict=True))]
    expected = run(started(), tidy)
    got = run(started(), [p for _, _, p in sorted(arrivals, key=lambda item: item[:2])])
    assert ends(got) == ends(expected)
    for one, other in zip(got, expected, strict=True):
        assert (one.gap_ns, one.current.missing) == (other.gap_ns, other.current.missing)
        np.testing.assert_array_equal(one.imu.stamps_ns, other.imu.stamps_ns)
        np.testing.assert_array_equal(one.imu.gyro, other.imu.gyro)


def test_an_image_after_a_hole_of_both_sensors_waits_for_the_samples_before_it() -> None:
    tidy = stream([t for t in IMAGES if not 3000.0 < t < 4500.0], without(SAMPLES, 3000.0, 4000.0))
    # The samples since 4 s arrive just after the image at 4.5 s.
    early = sorted(tidy, key=lambda p: 4000 * MS if isinstance(p, Frame) and p.stamp_ns == 4500 * MS else newest(p))
    expected, got = run(started(), tidy), run(started(), early)
    assert (3000.0, 4000.0) in ends(expected)
    assert ends(got) == ends(expected)
    assert [len(window.imu) for window in got] == [len(window.imu) for window in expected]


def test_nothing_waits_longer_than_told() -> None:
    """States are at most the wait behind the stream while one sensor is silent, whichever it is."""
    for images, samples in (
        ([t for t in IMAGES if t < 3000.0], SAMPLES),
        (IMAGES, SAMPLES[SAMPLES < 3000.0]),
    ):
        synchronizer = started()
        for packet in stream(images, samples):
            windows = synchronizer.push(packet)
            if windows and newest(packet) > 4000 * MS:
                behind = newest(packet) - windows[-1].current.stamp_ns
                assert behind <= (500 + 150 + 25) * MS
        assert synchronizer.push(frame(20_000.0)) is not None


def test_memory_is_flat_whatever_is_missing() -> None:
    long = np.arange(0.0, 60_000.0, 5.0)
    images = [100.0 * k for k in range(600)]
    for packets in (stream(images, long), stream([], long), stream(images, long[:0])):
        synchronizer = started()
        held = 0
        for packet in packets:
            synchronizer.push(packet)
            held = max(held, sum(map(len, synchronizer._blocks)) + len(synchronizer._waiting))
        assert held <= 210
        assert len(synchronizer._delays) <= 10


def test_clocks_without_overlap_end_and_are_said(caplog: pytest.LogCaptureFixture) -> None:
    for shift in (1e9, -1e9):
        windows = run(started(), [block(SAMPLES), *(frame(t + shift) for t in IMAGES)])
        check_chain(windows)
        assert len(windows) < 210
    windows = run(started(), [*(frame(t - 1e9) for t in IMAGES), block(SAMPLES)])
    assert len(windows) < 210
    synchronizer = started()
    run(synchronizer, [frame(1e9), block(SAMPLES[:20]), frame(1e9 + 100)])
    assert "both clocks overlap" in caplog.text


def test_without_an_imu_on_the_rig_images_make_windows_at_once() -> None:
    synchronizer = SequentialCacheSynchronizer()
    synchronizer.setup(replace(make_rig(NOISE), has_imu=False))
    assert synchronizer.push(frame(0)) == []
    assert ends(synchronizer.push(frame(100))) == [(0, 100)]
    assert synchronizer.flush() == []


def test_setup_forgets() -> None:
    synchronizer = started()
    first = run(synchronizer, stream(IMAGES[:20], SAMPLES[:300]))
    synchronizer.setup(make_rig(NOISE))
    assert not any(synchronizer.counters().values())
    assert ends(run(synchronizer, stream(IMAGES[:20], SAMPLES[:300]))) == ends(first)
