"""The inertial sensor: exact where it is perfect, and with the noise it states where it is not."""

import numpy as np
import pytest

from vioframe.checks import Array
from vioframe.conventions import GRAVITY, NANOSECONDS, gravity_vector
from vioframe.data.simulator.families import plan_motion
from vioframe.data.simulator.imu import BlockCutter, ImuSamples, ImuSettings, InertialSensor, exact_imu, join_stamps
from vioframe.data.simulator.spline import SplineMotion
from vioframe.errors import ConfigError
from vioframe.geometry import so3
from vioframe.types import ImuBlock

START_NS = 10**18
QUIET = {
    "gyro_noise": 0.0,
    "gyro_walk": 0.0,
    "accel_noise": 0.0,
    "accel_walk": 0.0,
    "gyro_bias_spread": 0.0,
    "accel_bias_spread": 0.0,
}


def standing(duration_s: float) -> SplineMotion:
    count = int(duration_s) + 7
    return SplineMotion(knot_s=1.0, positions=np.zeros((count, 3)), rotations=np.tile(np.eye(3), (count, 1, 1)))


def sense(settings: ImuSettings, motion: SplineMotion, duration_s: float, seed: int = 0) -> list[ImuSamples]:
    sensor = InertialSensor(
        settings, motion=motion, gravity=GRAVITY, start_ns=START_NS, duration_s=duration_s, seed=seed
    )
    return list(sensor.stream())


def joined(samples: list[ImuSamples]) -> ImuBlock:
    return ImuBlock(
        stamps_ns=np.concatenate([s.block.stamps_ns for s in samples]),
        gyro=np.concatenate([s.block.gyro for s in samples]),
        accel=np.concatenate([s.block.accel for s in samples]),
    )


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("rate_hz", 0.0),
        ("gyro_noise", -1.0),
        ("accel_limit", -1.0),
        ("gyro_misalignment", (0.0, 0.0)),
        ("gaps_s", ((1.0, -1.0),)),
        ("gaps_s", ((1.0,),)),
    ],
)
def test_wrong_settings_are_refused_by_name(option: str, value: object) -> None:
    with pytest.raises(ConfigError, match=option):
        ImuSettings(**{option: value})  # type: ignore[arg-type]


def test_at_rest_it_reads_gravity_upwards() -> None:
    rate, force = exact_imu(standing(5.0), np.linspace(0.0, 5.0, 20), GRAVITY)
    np.testing.assert_allclose(rate, 0.0, atol=1e-12)
    np.testing.assert_allclose(force, np.tile([0.0, 0.0, GRAVITY], (20, 1)), atol=1e-9)


def integrate(motion: SplineMotion, start_s: float, end_s: float, steps: int) -> tuple[Array, Array, Array]:
    """Mid-point integration of exact samples."""
    times = np.linspace(start_s, end_s, steps + 1)
    h = times[1] - times[0]
    rate, force = exact_imu(motion, 0.5 * (times[1:] + times[:-1]), GRAVITY)
    state = motion.evaluate(start_s)
    R, v, p = state.T_world_body[:3, :3], state.velocity, state.T_world_body[:3, 3]
    for w, f in zip(rate, force, strict=True):
        a = R @ so3.exp(0.5 * h * w) @ f + gravity_vector()
        p = p + h * v + 0.5 * h * h * a
        v = v + h * a
        R = R @ so3.exp(h * w)
    return R, v, p


@pytest.mark.parametrize("family", ["walk", "drone"])
def test_integrating_exact_samples_gives_the_motion_back_at_second_order(family: str) -> None:
    motion = plan_motion(family, 0, 10.0, 1.0).motion
    end = motion.evaluate(5.0)
    errors = []
    for steps in (100, 200, 400):
        R, v, p = integrate(motion, 3.0, 5.0, steps)
        errors.append(
            [
                so3.angle(R.T @ end.T_world_body[:3, :3]),
                np.linalg.norm(v - end.velocity),
                np.linalg.norm(p - end.T_world_body[:3, 3]),
            ]
        )
    ratio = np.array(errors[:-1]) / np.array(errors[1:])
    assert np.all((ratio > 3.3) & (ratio < 4.7)), ratio
    assert np.max(errors[-1]) < 2e-3


def test_noise_and_walk_have_their_densities() -> None:
    settings = ImuSettings(
        rate_hz=100.0, gyro_noise=1e-3, gyro_walk=2e-3, accel_noise=1e-2, accel_walk=2e-2,
        gyro_bias_spread=0.0, accel_bias_spread=0.0,
    )  # fmt: skip
    samples = sense(settings, standing(400.0), 400.0)
    block = joined(samples)
    for measured, true, bias, noise, walk in (
        (block.gyro, np.zeros(3), np.concatenate([s.gyro_bias for s in samples]), 1e-3, 2e-3),
        (block.accel, [0, 0, GRAVITY], np.concatenate([s.accel_bias for s in samples]), 1e-2, 2e-2),
    ):
        white = measured - true - bias
        # 120 000 draws: the deviation is known to 0.2 %.
        assert np.std(white) == pytest.approx(noise * 10.0, rel=0.01)
        assert np.std(np.diff(bias, axis=0)) == pytest.approx(walk * 0.1, rel=0.01)
        neighbours = np.mean(white[1:] * white[:-1]) / np.var(white)
        assert abs(neighbours) < 0.01


def test_the_first_bias_has_its_spread() -> None:
    settings = ImuSettings(gyro_bias_spread=0.02, accel_bias_spread=0.3)
    biases = [
        InertialSensor(
            settings, motion=standing(1.0), gravity=GRAVITY, start_ns=0, duration_s=1.0, seed=seed
        ).initial_bias()
        for seed in range(500)
    ]
    assert np.std([b.gyro for b in biases]) == pytest.approx(0.02, rel=0.06)
    assert np.std([b.accel for b in biases]) == pytest.approx(0.3, rel=0.06)


def test_scale_and_misalignment_act_on_the_truth() -> None:
    motion = plan_motion("drone", 0, 6.0, 0.0).motion
    settings = ImuSettings(**QUIET, gyro_scale_error=(0.01, 0.0, 0.0), accel_misalignment=(0.0, 0.0, 0.02))
    block = joined(sense(settings, motion, 6.0))
    rate, force = exact_imu(motion, (block.stamps_ns - START_NS) / NANOSECONDS, GRAVITY)
    np.testing.assert_allclose(block.gyro, rate * [1.01, 1.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(block.accel, force @ so3.exp(np.array([0.0, 0.0, 0.02])).T, atol=1e-12)


def test_it_saturates_and_quantises() -> None:
    motion = plan_motion("drone", 0, 8.0, 0.0).motion
    settings = ImuSettings(**QUIET, gyro_limit=0.5, accel_step=0.25)
    block = joined(sense(settings, motion, 8.0))
    assert np.abs(block.gyro).max() == 0.5
    np.testing.assert_allclose(block.accel, np.round(block.accel / 0.25) * 0.25, atol=1e-12)


def test_jitter_moves_samples_and_stamps_together() -> None:
    motion = plan_motion("drone", 0, 8.0, 0.0).motion
    block = joined(sense(ImuSettings(**QUIET, jitter_s=5e-4), motion, 8.0))
    steps = np.diff(block.stamps_ns)
    assert steps.min() > 0
    assert np.std(steps) == pytest.approx(np.sqrt(2) * 5e-4 * NANOSECONDS, rel=0.1)
    rate, _ = exact_imu(motion, (block.stamps_ns - START_NS) / NANOSECONDS, GRAVITY)
    np.testing.assert_allclose(block.gyro, rate, atol=1e-9)


def test_gaps_are_where_they_were_asked_for_and_noise_goes_on() -> None:
    motion = plan_motion("walk", 0, 8.0, 0.0).motion
    whole = joined(sense(ImuSettings(), motion, 8.0))
    holed = joined(sense(ImuSettings(gaps_s=((2.0, 0.5), (5.0, 1.5))), motion, 8.0))
    kept = np.isin(whole.stamps_ns, holed.stamps_ns)
    lost = (whole.stamps_ns[~kept] - START_NS) / NANOSECONDS
    assert np.all(((lost >= 2.0) & (lost < 2.5)) | ((lost >= 5.0) & (lost < 6.5)))
    assert len(lost) == 400
    np.testing.assert_array_equal(whole.gyro[kept], holed.gyro)


def test_random_gaps_come_as_often_as_stated() -> None:
    settings = ImuSettings(random_gaps_per_minute=3.0, random_gap_s=0.1)
    counts = [
        len(
            InertialSensor(
                settings, motion=standing(1.0), gravity=GRAVITY, start_ns=0, duration_s=600.0, seed=seed
            ).gaps()
        )
        for seed in range(40)
    ]
    assert np.mean(counts) == pytest.approx(30.0, abs=3.0)


def test_a_longer_run_begins_as_a_shorter_one() -> None:
    motion = plan_motion("walk", 0, 20.0, 1.0).motion
    short, long = (joined(sense(ImuSettings(), motion, duration_s)) for duration_s in (5.0, 12.0))
    np.testing.assert_array_equal(short.gyro, long.gyro[: len(short)])


def test_blocks_are_cut_at_stamps() -> None:
    block = ImuBlock(stamps_ns=np.arange(10, dtype=np.int64), gyro=np.zeros((10, 3)), accel=np.zeros((10, 3)))
    cutter = BlockCutter(iter([block]))
    assert [len(b) for b in cutter.until(3)] == [4]
    assert [len(b) for b in cutter.until(3)] == []
    assert [len(b) for b in cutter.until(None)] == [6]


def test_stamps_join_without_near_doubles() -> None:
    joined_stamps = join_stamps(np.array([0, 10, 20, 30]), np.array([11, 25]), apart_ns=2)
    np.testing.assert_array_equal(joined_stamps, [0, 11, 20, 25, 30])
