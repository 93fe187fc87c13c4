"""Sequences by name, splits, packets in order, and the truth that goes with them."""

import hashlib

import numpy as np
import pytest

from vioframe.checks import check_increasing
from vioframe.data.simulator import CameraSettings, Degradations, ImuSettings, SimulatedDataset
from vioframe.errors import ConfigError, DataError
from vioframe.types import Frame, ImuBlock

BLIND = CameraSettings(images=False)
SMALL = CameraSettings(size_px=(160, 120))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"sequence": "jog"}, "jog"),
        ({"sequence": []}, "at least one"),
        ({"duration_s": -1.0}, "duration_s"),
        ({"standstill_s": -1.0}, "standstill_s"),
        ({"split": "exam"}, "split"),
        ({"seed": -1}, "seed"),
        ({"seed": 10_000}, "seed"),
        ({"seed": 0.5}, "seed"),
        ({"gravity": 0.0}, "gravity"),
    ],
)
def test_wrong_options_are_refused_by_name(options: dict[str, object], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        SimulatedDataset(**options)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"kit": "phone"}, "kit"),
        ({"count": 3}, "count"),
        ({"rate_hz": 0.0}, "rate_hz"),
        ({"noise_dn": -1.0}, "noise_dn"),
        ({"delay_s": 2.0}, "delay_s"),
    ],
)
def test_wrong_cameras_are_refused_by_name(options: dict[str, object], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        CameraSettings(**options)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "options",
    [{"model": "orthographic"}, {"distortion": [0.1]}, {"T_body_cam": [[1.0]]}, {"T_body_cam": np.ones((4, 4))},
     {"size_px": [0, 10]}, {"size_px": [752, 480, 1]}, {"intrinsics_px": [1.0]}],
)  # fmt: skip
def test_numbers_that_make_no_camera_are_refused(options: dict[str, object]) -> None:
    with pytest.raises(ConfigError, match=r"dataset\.camera"):
        CameraSettings(**options).build("euroc")  # type: ignore[arg-type]


def test_sequences_are_families_and_seeds() -> None:
    dataset = SimulatedDataset(sequence=["walk", "drone"], seed=[0, 3], camera=BLIND)
    assert list(dataset.sequences) == ["walk-0", "walk-3", "drone-0", "drone-3"]
    with pytest.raises(DataError, match="walk-7"):
        dataset.open("walk-7")


def test_splits_share_no_sequence() -> None:
    names = [
        set(SimulatedDataset(seed=[0, 1, 9999], split=split).sequences) for split in ("train", "validation", "test")
    ]
    assert sum(map(len, names)) == 9
    assert len(set.union(*names)) == 9


def test_the_default_walk_is_what_the_documentation_says() -> None:
    recording = SimulatedDataset(camera=BLIND).open("walk-0")
    camera = recording.rig.cameras[0]
    assert not recording.rig.has_images
    assert (camera.model, camera.size_px, recording.frame_count) == ("radtan", (752, 480), 601)
    assert recording.duration_s == pytest.approx(30.0)
    path = recording.ground_truth().T_world_body[:, :3, 3]
    assert 12.0 < np.linalg.norm(np.diff(path, axis=0), axis=1).sum() < 40.0


def test_packets_arrive_in_order_and_cover_every_frame() -> None:
    settings = CameraSettings(images=False, delay_s=0.013)
    recording = SimulatedDataset(duration_s=4.0, camera=settings).open("walk-0")
    delay_ns = recording.rig.camera_delay_ns
    assert delay_ns == 13_000_000
    latest, frames, stamps = 0, [], []
    for packet in recording.packets():
        if isinstance(packet, Frame):
            frames.append(packet.stamp_ns)
            # Every sample up to the exposure is already there.
            assert 0 <= packet.stamp_ns + delay_ns - latest < 5_000_001
        else:
            stamps.append(packet.stamps_ns)
            assert len(packet) <= 21
            latest = int(packet.stamps_ns[-1])
    check_increasing("stamps", np.concatenate(stamps))
    assert len(frames) == recording.frame_count == 81
    assert frames[-1] + delay_ns <= latest


def test_the_truth_holds_at_frames_and_between() -> None:
    recording = SimulatedDataset(
        duration_s=5.0, camera=CameraSettings(images=False, rate_hz=7.0), imu=ImuSettings(rate_hz=50.0)
    ).open("walk-0")
    truth = recording.ground_truth()
    assert np.isin(recording.frame_stamps_ns, truth.stamps_ns).all()
    steps = np.diff(truth.stamps_ns)
    assert 1e6 < steps.min() <= steps.max() <= 1.21e7
    state = recording.motion.evaluate(recording.elapsed_s(truth.stamps_ns))
    np.testing.assert_array_equal(truth.T_world_body, state.T_world_body)
    assert truth.v_world_body is not None
    middle = (truth.T_world_body[2:, :3, 3] - truth.T_world_body[:-2, :3, 3]) / (
        (truth.stamps_ns[2:] - truth.stamps_ns[:-2]) / 1e9
    )[:, None]
    np.testing.assert_allclose(truth.v_world_body[1:-1], middle, atol=0.02)


def digest(dataset: SimulatedDataset, name: str) -> str:
    total = hashlib.sha256()
    for packet in dataset.open(name).packets():
        if isinstance(packet, ImuBlock):
            for array in (packet.stamps_ns, packet.gyro, packet.accel):
                total.update(array.tobytes())
        else:
            total.update(packet.stamp_ns.to_bytes(8, "big"))
            for image in packet.images:
                total.update(image.tobytes())
    return total.hexdigest()


def test_the_same_seed_gives_the_same_bytes_and_another_does_not() -> None:
    def make() -> SimulatedDataset:
        spoilt = Degradations(flicker=0.1, low_light=0.5, moving_objects=1)
        return SimulatedDataset(seed=[0, 1], duration_s=0.5, camera=SMALL, degradations=spoilt)

    first = digest(make(), "walk-0")
    assert first == digest(make(), "walk-0")
    assert first != digest(make(), "walk-1")


def test_packets_can_be_streamed_twice() -> None:
    recording = SimulatedDataset(duration_s=1.0, camera=SMALL).open("walk-0")
    first, second = list(recording.packets()), list(recording.packets())
    assert len(first) == len(second)
    for a, b in zip(first, second, strict=True):
        if isinstance(a, Frame):
            assert isinstance(b, Frame)
            np.testing.assert_array_equal(a.images[0], b.images[0])


def test_an_hour_streams_from_its_first_second() -> None:
    recording = SimulatedDataset(duration_s=3600.0, camera=BLIND).open("walk-0")
    assert recording.frame_count == 72_001
    packets = recording.packets()
    assert sum(isinstance(next(packets), Frame) for _ in range(100)) >= 40


def test_dropped_frames_are_counted_and_come_in_runs() -> None:
    spoilt = Degradations(dropped_frames=0.2, drop_length=4.0)
    recording = SimulatedDataset(duration_s=600.0, camera=BLIND, degradations=spoilt).open("walk-0")
    lost = 12_001 - recording.frame_count
    assert lost / 12_001 == pytest.approx(0.2, abs=0.03)
    assert recording.counters()["dropped frames"] == lost
    steps = np.round(np.diff(recording.frame_stamps_ns) / 5e7).astype(int)
    assert np.mean(steps[steps > 1] - 1) == pytest.approx(4.0, abs=0.5)


def test_a_second_camera_stands_to_the_right_of_the_first() -> None:
    first, second = SimulatedDataset(camera=CameraSettings(count=2, images=False)).open("walk-0").rig.cameras
    between = np.linalg.inv(first.T_body_cam) @ second.T_body_cam
    np.testing.assert_allclose(between[:3, 3], [0.11, 0.0, 0.0], atol=1e-12)


def test_another_size_keeps_the_field_of_view() -> None:
    from vioframe.geometry import camera as camera_models

    large, small = (CameraSettings(size_px=size).build("euroc")[0] for size in (None, (376, 240)))
    corner_large = camera_models.normalised(large, np.array([-0.5, -0.5]))
    corner_small = camera_models.normalised(small, np.array([-0.5, -0.5]))
    np.testing.assert_allclose(corner_large, corner_small, atol=1e-9)


@pytest.mark.parametrize("duration_s", [0.2, 3.0, 5.0])
def test_a_drive_that_hardly_leaves_has_a_street_all_the_same(duration_s: float) -> None:
    camera = CameraSettings(size_px=(64, 20))
    spoilt = Degradations(moving_objects=3)
    dataset = SimulatedDataset(sequence="car", duration_s=duration_s, camera=camera, degradations=spoilt)
    frames = [packet for packet in dataset.open("car-0").packets() if isinstance(packet, Frame)]
    assert len(frames) == round(10 * duration_s) + 1
    assert min(frame.images[0].std() for frame in frames) > 10.0
