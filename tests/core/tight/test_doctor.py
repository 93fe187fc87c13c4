"""Every fault that keeps a start from succeeding is named, with numbers, by the doctor."""

from dataclasses import replace

import numpy as np
import pytest

from moving_scene import Scene, rig, turned_rig
from vioframe.tight import doctor
from vioframe.tight.doctor import Examination
from vioframe.tight.motion_options import MotionStartOptions
from vioframe.tight.motion_start import MotionStart
from vioframe.tight.options import CalibrationOptions
from vioframe.tight.start import Starter, TightStartOptions
from vioframe.types import ImuBlock

SECONDS = 3.0


def attempts(measurements, the_rig=None):
    """All attempts of a start in motion, which must not succeed."""
    motion = MotionStart(the_rig or rig(), MotionStartOptions(), CalibrationOptions())
    made = []
    for measurement in measurements:
        start, attempt = motion.push(measurement)
        assert start is None
        if attempt is not None:
            made.append(attempt)
    assert len(made) >= 8
    return made


def swapped_axes():
    imu = Scene().imu(SECONDS)
    order = [1, 0, 2]
    return Scene().measurements(SECONDS, replace(imu, gyro=imu.gyro[:, order], accel=imu.accel[:, order]))


def saturated_gyro():
    imu = Scene().imu(SECONDS)
    return Scene().measurements(SECONDS, replace(imu, gyro=np.clip(imu.gyro, -0.4, 0.4)))


def half_the_samples():
    imu = Scene().imu(SECONDS)
    keep = np.random.default_rng(0).random(len(imu)) < 0.5
    keep[[0, -1]] = True
    half = ImuBlock(stamps_ns=imu.stamps_ns[keep], gyro=imu.gyro[keep], accel=imu.accel[keep])
    return Scene().measurements(SECONDS, half)


def upside_down_gravity():
    imu = Scene().imu(SECONDS)
    return Scene().measurements(SECONDS, replace(imu, accel=-imu.accel))


def all_points_behind():
    for measurement in Scene().measurements(SECONDS):
        tracks = measurement.features.tracks
        features = replace(measurement.features, tracks=replace(tracks, bearings=-tracks.bearings))
        yield replace(measurement, features=features)


FAULTS = {
    doctor.NO_ROTATION: lambda: Scene(turn=0.0).measurements(SECONDS),
    doctor.NO_ACCELERATION: lambda: Scene(sway=0.0).measurements(SECONDS),
    doctor.NO_TEXTURE: lambda: Scene(points=0).measurements(SECONDS),
    doctor.STANDSTILL: lambda: Scene(turn=0.0, sway=0.0, speed=(0.0, 0.0, 0.0)).measurements(SECONDS),
    doctor.SWAPPED_AXES: swapped_axes,
    doctor.WRONG_EXTRINSICS: lambda: Scene().measurements(SECONDS),
    doctor.TIME_OFFSET: lambda: Scene(delay_s=0.2).measurements(SECONDS),
    doctor.SATURATED: saturated_gyro,
    doctor.IMU_HOLES: half_the_samples,
    doctor.GRAVITY_SIGN: upside_down_gravity,
    doctor.TOO_FEW_POINTS: lambda: Scene(points=12).measurements(SECONDS),
    doctor.POINTS_BEHIND: all_points_behind,
}


@pytest.mark.parametrize("fault", FAULTS)
def test_fault_is_named(fault):
    the_rig = turned_rig(90.0, (0.0, 0.0, 1.0)) if fault == doctor.WRONG_EXTRINSICS else rig()
    made = attempts(FAULTS[fault](), the_rig)
    # About two axes a mirror and a turn are the same; it takes seconds of motion to tell them apart.
    assert {each.fault for each in made[-3:]} == {fault}
    for each in made:
        assert each.sentence
        assert each.measures


@pytest.mark.parametrize("delay_s", [-0.2, 0.2])
def test_the_delay_is_told_with_its_sign(delay_s):
    last = attempts(Scene(delay_s=delay_s).measurements(SECONDS))[-1]
    assert last.measures["delay by rotation"].value == pytest.approx(-1e3 * delay_s, abs=10.0)
    assert f"{-1e3 * delay_s:+.0f}"[:3] in last.sentence


def test_the_angle_of_a_wrong_extrinsic_is_told():
    last = attempts(Scene().measurements(SECONDS), turned_rig(90.0, (1.0, 0.0, 0.0)))[-1]
    assert last.measures["rotation from gyro to camera differs"].value == pytest.approx(90.0, abs=5.0)


def test_two_cameras_need_no_acceleration():
    motion = MotionStart(rig(2), MotionStartOptions(), CalibrationOptions())
    found = [motion.push(each)[0] for each in Scene(sway=0.0, cameras=2).measurements(2.0)]
    assert any(found)


def test_attempts_are_recorded_and_the_log_says_a_fault_once(caplog):
    starter = Starter(rig(), TightStartOptions(method="motion"), CalibrationOptions())
    for measurement in Scene(points=12).measurements(5.0):
        assert starter.push(measurement) is None
    assert len(starter.attempts) == 16
    assert {each.fault for each in starter.attempts} == {doctor.TOO_FEW_POINTS}
    assert len([record for record in caplog.records if doctor.TOO_FEW_POINTS in record.message]) == 1


def test_standing_still_starts_from_rest_unless_motion_is_asked_for():
    scene = Scene(turn=0.0, sway=0.0, speed=(0.0, 0.0, 0.0))
    starter = Starter(rig(), TightStartOptions(method="auto"), CalibrationOptions())
    starts = [starter.push(measurement) for measurement in scene.measurements(1.5)]
    assert next(start for start in starts if start is not None).method == "rest"


def test_the_first_fault_is_the_one_that_is_named():
    examination = Examination()
    examination.note("seconds", 1.0, "s")
    assert examination.at_least("points", 30.0, 20.0, "", "few", "too few")
    assert not examination.at_most("hole", 80.0, 30.0, "ms", "holes", "a hole of 80 ms")
    assert not examination.at_least("turn", 1.0, 2.0, "°", "turn", "turns too little")
    attempt = examination.record(7, "motion")
    assert (attempt.fault, attempt.sentence, attempt.succeeded) == ("holes", "a hole of 80 ms", False)
    assert [name for name, measure in attempt.measures.items() if not measure.good] == ["hole", "turn"]


def test_what_cannot_be_computed_is_bad_and_finite():
    examination = Examination()
    assert not examination.at_most("scale sigma", np.inf, 0.1, "", "scale", "unknown")
    assert np.isfinite(examination.measures["scale sigma"].value)
