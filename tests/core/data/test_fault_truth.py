"""What simulates a camera from the truth meets the faults too; and the inertial faults have the size they say."""

from itertools import pairwise

import numpy as np
import pytest

from vioframe.data.exposure import ExposedFrame, exposure_ns, with_exposures
from vioframe.data.faults import Faults, FaultyRecording
from vioframe.data.simulated_vo import SimulatedVO
from vioframe.data.simulator import CameraSettings, ImuSettings, SimulatedDataset
from vioframe.errors import ConfigError
from vioframe.geometry import se3, so3
from vioframe.geometry.interpolation import interpolate_poses
from vioframe.types import Frame, ImuBlock, VisualFeatures

MS = 1_000_000


@pytest.fixture(scope="module")
def clean():
    """Twenty seconds of a walk, without pixels, with a delay that the rig tells."""
    dataset = SimulatedDataset(
        sequence="walk",
        duration_s=20.0,
        standstill_s=0.0,
        camera=CameraSettings(images=False, delay_s=0.01),
        imu=ImuSettings(rate_hz=200.0),
    )
    return dataset.open(dataset.sequences[0])


def frames_of(recording):
    """As a synchronizer hands them on: on the clock of the inertial sensor, by the delay that the rig tells."""
    delay_ns = recording.rig.camera_delay_ns
    told = with_exposures(recording.packets(), delay_ns)
    return [
        ExposedFrame(stamp_ns=p.stamp_ns + delay_ns, exposed_ns=p.exposed_ns)
        for p in told
        if isinstance(p, ExposedFrame)
    ]


def samples_of(recording):
    blocks = [packet for packet in recording.packets() if isinstance(packet, ImuBlock)]
    return tuple(np.concatenate([getattr(b, name) for b in blocks]) for name in ("stamps_ns", "gyro", "accel"))


def answers(recording):
    """Camera motions of an odometer without errors of its own."""
    vo = SimulatedVO(rotation_noise=0.0, translation_noise=0.0)
    vo.setup(recording.rig)
    vo.take_ground_truth(recording.seen_truth())
    features = [VisualFeatures(frame=frame) for frame in frames_of(recording)]
    return np.array([vo.estimate(*pair).T_prev_cur for pair in pairwise(features[5:26])])


@pytest.mark.parametrize(
    "options",
    [
        {"time_offset_s": 0.05},
        {"stamp_jitter_s": 0.01},
        {"rotation_deg": [0, 3, 0], "position_m": [0.1, 0, 0]},
        {"rotation_random_deg": 4.0, "time_offset_s": -0.03},
    ],
)
def test_picture_stays_that_of_its_instant_and_of_the_true_camera(clean, options):
    """No fault of stamps or of calibration changes what the camera saw, so none changes its motion."""
    spoilt = FaultyRecording(clean, Faults(**options))
    assert np.allclose(answers(spoilt), answers(clean), atol=1e-9)


def test_motion_is_that_of_the_true_instants(clean):
    frames = frames_of(FaultyRecording(clean, Faults(time_offset_s=0.05)))[5:7]
    assert [exposure_ns(frame) - frame.stamp_ns for frame in frames] == [50 * MS, 50 * MS]
    instants = np.array([exposure_ns(frame) for frame in frames])
    poses = interpolate_poses(clean.ground_truth(), instants, max_gap_ns=50 * MS)[0] @ clean.rig.cameras[0].T_body_cam
    spoilt = FaultyRecording(clean, Faults(time_offset_s=0.05))
    assert np.allclose(answers(spoilt)[0], se3.inverse(poses[0]) @ poses[1], atol=1e-9)


def test_truth_for_comparison_is_never_touched(clean):
    spoilt = FaultyRecording(clean, Faults(rotation_deg=[0, 3, 0], time_offset_s=0.1))
    assert np.array_equal(spoilt.ground_truth().T_world_body, clean.ground_truth().T_world_body)
    assert clean.seen_truth().T_world_body is clean.ground_truth().T_world_body or np.array_equal(
        clean.seen_truth().T_world_body, clean.ground_truth().T_world_body
    )


def test_frame_without_more_knowledge_was_exposed_at_its_stamp():
    assert exposure_ns(Frame(stamp_ns=7)) == 7
    assert exposure_ns(next(iter(with_exposures([Frame(stamp_ns=7)], 3)))) == 10
    known = ExposedFrame(stamp_ns=7, exposed_ns=1)
    assert next(iter(with_exposures([known], 3))) is known


def test_drawn_axis_changes_with_the_seed_and_keeps_the_angle(clean):
    true = clean.rig.cameras[0].T_body_cam[:3, :3]
    turns = []
    for seed in range(3):
        told = FaultyRecording(clean, Faults(rotation_random_deg=4.0, seed=seed)).rig.cameras[0].T_body_cam[:3, :3]
        turns.append(so3.log(true.T @ told))
    assert np.allclose(np.degrees(np.linalg.norm(turns, axis=1)), 4.0)
    assert np.linalg.norm(turns[0] - turns[1]) > 1e-3 and np.linalg.norm(turns[1] - turns[2]) > 1e-3


def test_noise_factor_makes_the_densities_so_many_times_larger(clean):
    factor, noise = 10.0, clean.rig.imu
    stamps, gyro, accel = samples_of(FaultyRecording(clean, Faults(imu_noise=factor)))
    _, gyro_clean, accel_clean = samples_of(clean)
    added = np.sqrt(factor**2 - 1.0)
    for name, values, before in (("gyro", gyro, gyro_clean), ("accel", accel, accel_clean)):
        extra = values - before
        white = np.diff(extra, axis=0) / np.sqrt(2.0)
        expected = added * getattr(noise, f"{name}_noise") * np.sqrt(noise.rate_hz)
        # 12 000 differences: the sample deviation lies within 5 % with more than 0.999.
        assert abs(white.std() / expected - 1.0) < 0.05
        # The walk after T seconds has deviation σ √T; 12 draws of it hold a factor of three with more than 0.99.
        ends = extra[-100:].mean(axis=0)
        walked = added * getattr(noise, f"{name}_walk") * np.sqrt((stamps[-1] - stamps[0]) * 1e-9)
        assert np.abs(ends).max() < 4.0 * np.hypot(walked, expected / 10.0)
    again = samples_of(FaultyRecording(clean, Faults(imu_noise=factor)))[1]
    assert np.array_equal(again, gyro)


def test_gaps_come_once_a_stretch_and_never_in_the_first(clean):
    recording = FaultyRecording(clean, Faults(imu_gap_s=0.3, imu_gap_every_s=4.0, seed=2))
    stamps = samples_of(recording)[0]
    first_ns = frames_of(clean)[0].stamp_ns
    steps = np.diff(stamps)
    starts = (stamps[:-1][steps > 20 * MS] - first_ns) * 1e-9
    lengths = steps[steps > 20 * MS] * 1e-9
    assert len(starts) == 4
    assert np.array_equal(np.floor(starts / 4.0), [1, 2, 3, 4])
    assert np.allclose(lengths, 0.3, atol=0.011)
    assert recording.faults() == ("imu_gap_s=0.3", "imu_gap_every_s=4", "seed=2")


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"imu_noise": 0.5}, r"faults\.imu_noise must be 1 or more"),
        ({"imu_gap_s": 5.0}, r"imu_gap_s=5.0 must be shorter than faults\.imu_gap_every_s=5.0"),
        ({"rotation_random_deg": -1.0}, r"faults\.rotation_random_deg must not be negative"),
    ],
)
def test_wrong_values_are_refused(options, match):
    with pytest.raises(ConfigError, match=match):
        Faults(**options)


def test_how_often_is_not_told_of_gaps_that_are_not_there():
    assert Faults(imu_gap_every_s=9.0).describe() == ()
    assert Faults(imu_noise=3.0, seed=1).describe() == ("imu_noise=3", "seed=1")
