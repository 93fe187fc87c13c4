"""A recorded trajectory, drawn anew."""

from collections.abc import Iterator, Sequence

import numpy as np
import pytest

from shared_data import shared_data
from vioframe.conventions import NANOSECONDS
from vioframe.data.recording import Dataset, Recording
from vioframe.data.simulator import CameraSettings, ImuSettings, ReplayDataset, ReplayRecording, SimulatedDataset
from vioframe.data.simulator.fit import fit_spline, longest_covered
from vioframe.errors import ConfigError, DataError
from vioframe.geometry import so3
from vioframe.types import Frame, ImuBlock, Packet, SensorRig, Trajectory


class Known(Recording):
    """A simulated walk handed on as if it had been recorded, with holes and an end to its truth."""

    def __init__(self, truth: bool = True, hole_s: tuple[float, float] | None = None, cameras: int = 1) -> None:
        self.name = "known"
        settings = CameraSettings(size_px=(160, 120), count=cameras, images=False)
        self.inner = SimulatedDataset(duration_s=10.0, camera=settings).open("walk-0")
        self._truth, self._hole_s = truth, hole_s

    @property
    def rig(self) -> SensorRig:
        return self.inner.rig

    def packets(self) -> Iterator[Packet]:
        return self.inner.packets()

    @property
    def frame_count(self) -> int:
        return self.inner.frame_count

    @property
    def duration_s(self) -> float:
        return self.inner.duration_s

    def ground_truth(self) -> Trajectory | None:
        if not self._truth:
            return None
        truth = self.inner.ground_truth()
        elapsed = self.inner.elapsed_s(truth.stamps_ns)
        kept = (elapsed >= 1.0) & (elapsed <= 9.0)
        if self._hole_s is not None:
            kept &= (elapsed < self._hole_s[0]) | (elapsed > self._hole_s[1])
        return Trajectory(stamps_ns=truth.stamps_ns[kept], T_world_body=truth.T_world_body[kept])


class KnownDataset(Dataset):
    def __init__(self, recording: Known) -> None:
        self._recording = recording

    @property
    def sequences(self) -> Sequence[str]:
        return ["known"]

    def open(self, sequence: str) -> Known:
        return self._recording


def replay(recording: Known, **options: object) -> ReplayRecording:
    return ReplayDataset(source=KnownDataset(recording), **options).open("known")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"imu": "guessed"}, "imu"),
        ({"place": "moon"}, "place"),
        ({"cameras": 3}, "cameras"),
        ({"knot_s": 0.0}, "knot_s"),
        ({"duration_s": 0.0}, "duration_s"),
        ({"start_s": -1.0}, "start_s"),
        ({"seed": -1}, "seed"),
    ],
)
def test_wrong_options_are_refused_by_name(options: dict[str, object], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        replay(Known(), **options)


def test_what_cannot_be_replayed_says_why() -> None:
    with pytest.raises(DataError, match="ground truth"):
        replay(Known(truth=False))
    with pytest.raises(DataError, match="calibration"):
        replay(Known(), cameras=2)
    with pytest.raises(DataError, match="fewer than two frames"):
        replay(Known(), start_s=30.0)
    with pytest.raises(ConfigError, match="source"):
        ReplayDataset(source="euroc")  # type: ignore[arg-type]


def test_the_fitted_motion_is_the_recorded_one() -> None:
    recording = Known()
    again = replay(recording)
    stamps = again.frame_stamps_ns
    fitted = again.motion.evaluate(again.elapsed_s(stamps))
    true = recording.inner.motion.evaluate(recording.inner.elapsed_s(stamps))
    np.testing.assert_allclose(fitted.T_world_body, true.T_world_body, atol=1e-4)
    inner = slice(2, -2)
    np.testing.assert_allclose(fitted.velocity[inner], true.velocity[inner], atol=2e-3)
    np.testing.assert_allclose(fitted.acceleration[inner], true.acceleration[inner], atol=0.05)
    np.testing.assert_allclose(fitted.rotation_rate[inner], true.rotation_rate[inner], atol=2e-3)


def test_only_what_the_truth_covers_is_replayed() -> None:
    recording = Known()
    again = replay(recording, images=False)
    packets = list(again.packets())
    frames = [p.stamp_ns for p in packets if isinstance(p, Frame)]
    stamps = np.concatenate([p.stamps_ns for p in packets if isinstance(p, ImuBlock)])
    assert len(frames) == again.frame_count == 161
    truth = again.ground_truth()
    assert truth.stamps_ns[0] <= frames[0] and frames[-1] <= truth.stamps_ns[-1]
    assert truth.stamps_ns[0] <= stamps[0] and stamps[-1] <= truth.stamps_ns[-1]
    # The recorded samples pass through untouched.
    source = np.concatenate([p.stamps_ns for p in recording.packets() if isinstance(p, ImuBlock)])
    gyro = np.concatenate([p.gyro for p in recording.packets() if isinstance(p, ImuBlock)])
    given = np.concatenate([p.gyro for p in packets if isinstance(p, ImuBlock)])
    np.testing.assert_array_equal(given, gyro[np.isin(source, stamps)])


def test_the_longest_stretch_without_a_hole_is_taken() -> None:
    again = replay(Known(hole_s=(3.0, 4.0)), images=False)
    assert again.frame_count == 100
    truth = again.ground_truth()
    assert (truth.stamps_ns[-1] - truth.stamps_ns[0]) / NANOSECONDS == pytest.approx(5.0, abs=0.02)


def test_a_short_hole_is_bridged() -> None:
    recording = Known(hole_s=(4.0, 4.2))
    again = replay(recording, images=False)
    assert again.frame_count == 161
    middle = again.motion.evaluate(4.1 - 1.0)
    true = recording.inner.motion.evaluate(4.1)
    assert np.linalg.norm(middle.T_world_body[:3, 3] - true.T_world_body[:3, 3]) < 0.01


def test_part_of_it_can_be_replayed_with_a_simulated_sensor() -> None:
    sensor = ImuSettings(rate_hz=100.0, gyro_noise=0.0, gyro_walk=0.0, gyro_bias_spread=0.0)
    again = replay(Known(), start_s=2.0, duration_s=3.0, imu="simulated", images=False, imu_settings=sensor)
    assert again.rig.imu.rate_hz == 100.0
    blocks = [p for p in again.packets() if isinstance(p, ImuBlock)]
    stamps = np.concatenate([b.stamps_ns for b in blocks])
    assert np.median(np.diff(stamps)) == 10_000_000
    np.testing.assert_allclose(np.concatenate([b.gyro for b in blocks]), again.exact_imu(stamps).gyro, atol=1e-12)
    assert again.duration_s == pytest.approx(3.0, abs=0.06)


def test_images_are_drawn_with_the_calibration_of_the_source() -> None:
    recording = Known(cameras=2)
    again = replay(recording, cameras=2, duration_s=0.2)
    assert len(again.rig.cameras) == 2
    assert again.rig.has_images and not recording.rig.has_images
    frame = next(p for p in again.packets() if isinstance(p, Frame))
    assert [image.shape for image in frame.images] == [(120, 160)] * 2
    assert all(image.std() > 10.0 for image in frame.images)


def test_a_noisy_truth_is_smoothed_not_followed() -> None:
    recording = Known()
    truth = recording.ground_truth()
    assert truth is not None
    rng = np.random.default_rng(0)
    noisy = truth.T_world_body.copy()
    noisy[:, :3, 3] += 0.002 * rng.standard_normal((len(truth), 3))
    noisy[:, :3, :3] = noisy[:, :3, :3] @ so3.exp(0.002 * rng.standard_normal((len(truth), 3)))
    motion = fit_spline(Trajectory(stamps_ns=truth.stamps_ns, T_world_body=noisy), 0.1)
    elapsed = (truth.stamps_ns - truth.stamps_ns[0]) / NANOSECONDS
    fitted = motion.evaluate(elapsed).T_world_body
    position_error = fitted[:, :3, 3] - truth.T_world_body[:, :3, 3]
    assert np.sqrt(np.mean(position_error**2)) < 0.001
    turn = so3.log(np.swapaxes(fitted[:, :3, :3], -1, -2) @ truth.T_world_body[:, :3, :3])
    assert np.sqrt(np.mean(turn**2)) < 0.001


def test_too_little_truth_is_refused() -> None:
    truth = Trajectory(stamps_ns=np.arange(5) * NANOSECONDS, T_world_body=np.tile(np.eye(4), (5, 1, 1)))
    with pytest.raises(DataError, match="ten poses"):
        longest_covered(truth, 0.1)


@pytest.mark.parametrize("name", ["V1_02_medium", "V2_01_easy"])
def test_a_real_flight_agrees_with_its_own_gyro(name: str) -> None:
    root = shared_data("euroc_imu_gt", name)
    from vioframe_recordings import EurocDataset

    source = EurocDataset(root=str(root.parent), sequence=name, images=False)
    recording = ReplayDataset(source=source, images=False, duration_s=40.0).open(name)
    assert min(recording.agreement()) > 0.995
    truth = source.open(name).ground_truth()
    assert truth is not None
    inside = (truth.stamps_ns > recording.frame_stamps_ns[0]) & (truth.stamps_ns < recording.frame_stamps_ns[-1])
    fitted = recording.motion.evaluate(recording.elapsed_s(truth.stamps_ns[inside])).T_world_body
    off = np.linalg.norm(fitted[:, :3, 3] - truth.T_world_body[inside, :3, 3], axis=1)
    assert np.sqrt(np.mean(off**2)) < 0.001
