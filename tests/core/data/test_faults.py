"""Faults do what they say, count it, say so in the protocol, and touch nothing else."""

from itertools import pairwise

import numpy as np
import pytest
from hydra.errors import ConfigCompositionException

from composing import composed
from vioframe.build import build, build_dataset, build_pipeline
from vioframe.data.faults import Faults, FaultyRecording
from vioframe.data.recording import Recording
from vioframe.data.simulator import CameraSettings, SimulatedDataset
from vioframe.errors import ConfigError
from vioframe.evaluation.rows import evaluate_run
from vioframe.evaluation.wording import protocol_text
from vioframe.geometry import so3
from vioframe.tasks.run_sequence import run_sequence
from vioframe.types import Frame, ImuBlock

SECOND = 1_000_000_000


@pytest.fixture(scope="module")
def clean() -> Recording:
    """Four seconds of a stereo walk, small images, a delay that the rig tells."""
    camera = CameraSettings(count=2, size_px=(94, 60), delay_s=0.01)
    dataset = SimulatedDataset(sequence="walk", duration_s=4.0, standstill_s=0.0, camera=camera)
    return dataset.open(dataset.sequences[0])


@pytest.fixture(scope="module")
def stream(clean):
    """Its packets, drawn once."""
    return list(clean.packets())


class Played(Recording):
    """The same recording from memory."""

    def __init__(self, clean: Recording, stream: list) -> None:
        self.name = clean.name
        self._clean, self._stream = clean, stream

    rig = property(lambda self: self._clean.rig)
    frame_count = property(lambda self: self._clean.frame_count)
    duration_s = property(lambda self: self._clean.duration_s)

    def packets(self):
        return iter(self._stream)

    def ground_truth(self):
        return self._clean.ground_truth()


@pytest.fixture
def spoilt(clean, stream):
    """Apply faults; gives the recording, its frames and its samples joined."""

    def apply(**options):
        recording = FaultyRecording(Played(clean, stream), Faults(**options))
        packets = list(recording.packets())
        return recording, [p for p in packets if isinstance(p, Frame)], join(packets)

    return apply


def join(packets) -> ImuBlock:
    blocks = [packet for packet in packets if isinstance(packet, ImuBlock)]
    return ImuBlock(
        stamps_ns=np.concatenate([block.stamps_ns for block in blocks]),
        gyro=np.concatenate([block.gyro for block in blocks]),
        accel=np.concatenate([block.accel for block in blocks]),
    )


def frames_of(stream):
    return [packet for packet in stream if isinstance(packet, Frame)]


def elapsed_s(frames, stream):
    return np.array([frame.stamp_ns - frames_of(stream)[0].stamp_ns for frame in frames]) / SECOND


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"dropped_frames": 1.0}, r"faults\.dropped_frames must be a share"),
        ({"missing_samples": -0.1}, r"faults\.missing_samples must be a share"),
        ({"camera_lost_s": [10, 1]}, r"faults\.camera_lost_s must be a list of pairs .*\[\[10, 1\]\]"),
        ({"imu_lost_s": [[1, 0]]}, r"faults\.imu_lost_s"),
        ({"blank_images_s": [[-1, 2]]}, r"faults\.blank_images_s"),
        ({"rotation_deg": [1, 2]}, r"faults\.rotation_deg must be three numbers"),
        ({"position_m": 3.0}, r"faults\.position_m must be three numbers"),
        ({"imu_axes": ["x", "x", "z"]}, r"faults\.imu_axes must hold x, y and z once each"),
        ({"imu_axes": "yxz"}, r"faults\.imu_axes"),
        ({"gyro_limit": -1.0}, r"faults\.gyro_limit must not be negative"),
        ({"stamp_jitter_s": -1.0}, r"faults\.stamp_jitter_s"),
        ({"seed": -1}, r"faults\.seed"),
        ({"time_offset_s": 200.0}, r"faults\.time_offset_s must lie within"),
    ],
)
def test_wrong_values_are_refused_by_name(options, match):
    with pytest.raises(ConfigError, match=match):
        Faults(**options)


def test_misspelt_fault_is_refused():
    with pytest.raises(ConfigCompositionException, match="time_offset"):
        composed("faults.time_offset=0.02")


def test_without_faults_the_data_set_is_the_same_object():
    dataset = SimulatedDataset()
    assert Faults().describe() == ()
    assert Faults(seed=3).inject(dataset) is dataset
    assert type(build_dataset(composed("dataset=simulated"))) is SimulatedDataset


def test_every_fault_leaves_what_it_does_not_touch(spoilt, stream):
    """Each alone: either the frames or the samples are those of the recording, to the last bit."""
    before = join(stream)
    for options in ({"time_offset_s": 0.02}, {"dropped_frames": 0.3}, {"camera_lost_s": [[1, 1]]}):
        _, frames, imu = spoilt(**options)
        assert np.array_equal(imu.stamps_ns, before.stamps_ns)
        assert np.array_equal(imu.gyro, before.gyro)
        drawn = {id(frame.images[0]) for frame in frames_of(stream)}
        assert {id(frame.images[0]) for frame in frames} <= drawn
    for options in ({"missing_samples": 0.3}, {"accel_negated": True}, {"gyro_limit": 0.1}):
        _, frames, _ = spoilt(**options)
        assert [frame.stamp_ns for frame in frames] == [frame.stamp_ns for frame in frames_of(stream)]
        assert frames[-1].images[1] is frames_of(stream)[-1].images[1]


def test_time_offset_is_what_the_calibration_does_not_tell(spoilt, clean, stream):
    """``t_imu = t_cam + delay + offset`` brings every frame back to the instant at which it was taken."""
    recording, frames, _ = spoilt(time_offset_s=0.03)
    assert recording.rig.camera_delay_ns == clean.rig.camera_delay_ns == 10_000_000
    for frame, true in zip(frames, frames_of(stream), strict=True):
        assert frame.stamp_ns + 30_000_000 == true.stamp_ns


def test_jitter_has_its_size_and_keeps_the_order(spoilt, stream):
    _, frames, _ = spoilt(stamp_jitter_s=0.004)
    error = np.array([f.stamp_ns - t.stamp_ns for f, t in zip(frames, frames_of(stream), strict=True)]) / SECOND
    # 81 normal draws: the sample deviation lies within 30 % with more than 0.999.
    assert 0.7 * 0.004 < error.std() < 1.3 * 0.004
    _, wild, _ = spoilt(stamp_jitter_s=1.0)
    assert all(later.stamp_ns > earlier.stamp_ns for earlier, later in pairwise(wild))


def test_rotation_is_wrong_in_camera_0_and_the_pair_stays_calibrated(spoilt, clean):
    recording, _, _ = spoilt(rotation_deg=[0, 0, 3], position_m=[0.1, 0.0, -0.2])
    true0, true1 = (camera.T_body_cam for camera in clean.rig.cameras)
    told0, told1 = (camera.T_body_cam for camera in recording.rig.cameras)
    assert np.allclose(so3.log(true0[:3, :3].T @ told0[:3, :3]), [0, 0, np.radians(3)], atol=1e-12)
    assert np.allclose(told0[:3, 3] - true0[:3, 3], [0.1, 0.0, -0.2], atol=1e-12)
    assert np.allclose(np.linalg.inv(told0) @ told1, np.linalg.inv(true0) @ true1, atol=1e-12)


def test_camera_is_lost_in_its_intervals_only(spoilt, stream):
    recording, frames, _ = spoilt(camera_lost_s=[[1.0, 0.5], [3.0, np.inf]])
    seen = elapsed_s(frames, stream)
    true = elapsed_s(frames_of(stream), stream)
    lost = ((true >= 1.0) & (true < 1.5)) | (true >= 3.0)
    assert np.array_equal(seen, true[~lost])
    assert recording.counters() == {"injected: frames lost with the camera": int(lost.sum())}
    assert recording.frame_count == len(true)


def test_intervals_are_told_on_the_true_clock(spoilt, stream):
    """A camera with a wrong clock is lost with everybody else's."""
    _, frames, _ = spoilt(camera_lost_s=[[1.0, 0.5]], time_offset_s=-0.05)
    _, reference, _ = spoilt(camera_lost_s=[[1.0, 0.5]])
    assert [f.stamp_ns - 50_000_000 for f in frames] == [f.stamp_ns for f in reference]


def test_share_of_frames_is_dropped_the_same_way_each_time(spoilt, stream):
    recording, frames, _ = spoilt(dropped_frames=0.3)
    again = [packet.stamp_ns for packet in recording.packets() if isinstance(packet, Frame)]
    assert again == [frame.stamp_ns for frame in frames]
    dropped = len(frames_of(stream)) - len(frames)
    # Binomial with 81 draws of 0.3: mean 24, deviation 4.
    assert 10 <= dropped <= 38
    assert recording.counters() == {"injected: dropped frames": dropped}
    _, others, _ = spoilt(dropped_frames=0.3, seed=1)
    assert [frame.stamp_ns for frame in others] != again
    _, fewer, _ = spoilt(dropped_frames=0.3, camera_lost_s=[[1, 1]])
    assert {frame.stamp_ns for frame in fewer} < set(again)


def test_blank_images_have_their_size_and_no_texture(spoilt, stream):
    recording, frames, _ = spoilt(blank_images_s=[[2.0, 1.0]])
    blank = [len(np.unique(frame.images[1])) == 1 for frame in frames]
    elapsed = elapsed_s(frames, stream)
    assert blank == list((elapsed >= 2.0) & (elapsed < 3.0))
    assert all(frame.images[0].shape == (60, 94) for frame in frames)
    assert recording.counters() == {"injected: blank frames": sum(blank)}


def test_inertial_samples_go_missing(spoilt, stream):
    before = join(stream)
    recording, _, imu = spoilt(imu_lost_s=[[1.0, 0.3]], missing_samples=0.5)
    start_ns = frames_of(stream)[0].stamp_ns + 10_000_000
    elapsed = (imu.stamps_ns - start_ns) / SECOND
    assert not ((elapsed >= 1.0) & (elapsed < 1.3)).any()
    counted = recording.counters()
    assert counted["injected: samples lost with the IMU"] == 60
    missing = counted["injected: missing samples"]
    assert abs(missing - 0.5 * (len(before) - 60)) < 4 * np.sqrt(0.25 * len(before))
    assert len(imu) == len(before) - 60 - missing
    assert set(imu.stamps_ns) < set(before.stamps_ns)


def test_gyro_saturates(spoilt, stream):
    before = join(stream)
    limit = float(np.quantile(np.abs(before.gyro), 0.9))
    recording, _, imu = spoilt(gyro_limit=limit)
    assert np.abs(imu.gyro).max() == limit
    beyond = (np.abs(before.gyro) > limit).any(axis=1)
    assert recording.counters() == {"injected: saturated samples": int(beyond.sum())}
    assert np.array_equal(imu.gyro[~beyond], before.gyro[~beyond])


def test_axes_are_swapped_and_gravity_turned(spoilt, stream):
    before = join(stream)
    _, _, imu = spoilt(imu_axes=["-y", "x", "z"], accel_negated=True)
    assert np.array_equal(imu.gyro, np.stack([-before.gyro[:, 1], before.gyro[:, 0], before.gyro[:, 2]], axis=1))
    assert np.array_equal(imu.accel, -np.stack([-before.accel[:, 1], before.accel[:, 0], before.accel[:, 2]], axis=1))


def test_recording_says_what_was_done_to_it(spoilt):
    recording, _, _ = spoilt(time_offset_s=-0.02, camera_lost_s=[[10, 1]], imu_axes=["y", "x", "z"], accel_negated=True)
    said = ("time_offset_s=-0.02", "camera_lost_s=[[10,1]]", "imu_axes=[y,x,z]", "accel_negated=true")
    assert recording.faults() == said
    assert Faults(dropped_frames=0.1, seed=4).describe() == ("dropped_frames=0.1", "seed=4")
    finding = recording.findings()[-1]
    assert finding.level == "note"
    assert "time_offset_s=-0.02" in finding.text


def test_faults_are_said_in_the_words_that_switch_them_on():
    """Whoever reads a protocol can repeat the run."""
    options = {"rotation_deg": [0, 0, 90], "imu_lost_s": [[1.5, 0.3], [4, np.inf]], "imu_axes": ["y", "-x", "z"]}
    said = Faults(**options, dropped_frames=0.1, accel_negated=True, seed=7).describe()
    assert build(composed(*(f"faults.{one}" for one in said)), "faults", Faults).describe() == said


def test_protocol_of_every_number_names_the_faults(tmp_path):
    config = composed("system=imu_only", "dataset.duration_s=2", "faults.missing_samples=0.2", "init=groundtruth")
    dataset = build_dataset(config)
    run, _, stop = run_sequence(
        build_pipeline(config, {}),
        dataset.open(dataset.sequences[0]),
        folder=tmp_path,
        init="groundtruth",
        sample_count=0,
        progress=lambda done: None,
    )
    assert stop is None
    row = evaluate_run(run)
    assert row["protocol"]["faults"] == ["missing_samples=0.2"]
    assert protocol_text(row).endswith("injected faults: missing_samples=0.2")
    assert row["counters"]["injected: missing samples"] > 40
