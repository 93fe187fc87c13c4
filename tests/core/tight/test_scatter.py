"""The scatter of inertial samples against the stated noise, and what follows from it for the trust in them."""

import numpy as np
import pytest

from vioframe.tight.options import InertialTrust
from vioframe.tight.scatter import SampleScatter
from vioframe.types import Frame, ImuBlock, ImuNoise, SyncedWindow

NOISE = ImuNoise(gyro_noise=2e-4, gyro_walk=2e-5, accel_noise=2e-3, accel_walk=3e-3, rate_hz=200.0)


def window(start_s: float, stamps_s: np.ndarray, gyro: np.ndarray, accel: np.ndarray) -> SyncedWindow:
    stamps_ns = np.round(1e9 * stamps_s).astype(np.int64)
    return SyncedWindow(
        previous=Frame(stamp_ns=round(1e9 * start_s)),
        current=Frame(stamp_ns=round(1e9 * start_s) + 50_000_000),
        imu=ImuBlock(stamps_ns=stamps_ns, gyro=gyro, accel=accel),
        gap_ns=0,
    )


def walk(scatter: SampleScatter, factor: float, *, seconds: float = 3.0, missing: float = 0.0) -> None:
    """A brisk motion, read by a sensor whose noise is ``factor`` times the stated."""
    rng = np.random.default_rng(5)
    for start in np.arange(0.0, seconds, 0.05):
        stamps = start + np.linspace(0.0, 0.05, 11)
        stamps = stamps[np.r_[True, rng.random(9) >= missing, True]]
        swing = np.sin(2.0 * np.pi * 1.5 * stamps)[:, None] * np.ones(3)
        noise = factor * np.sqrt(NOISE.rate_hz) * rng.normal(size=(2, len(stamps), 3))
        scatter.push(
            window(start, stamps, swing + NOISE.gyro_noise * noise[0], 4.0 * swing + NOISE.accel_noise * noise[1])
        )


@pytest.mark.parametrize("factor", [1.0, 3.0, 20.0])
@pytest.mark.parametrize("missing", [0.0, 0.1])
def test_the_factor_on_the_noise_is_found_in_motion_and_with_samples_missing(factor, missing):
    scatter = SampleScatter(NOISE)
    walk(scatter, factor, missing=missing)
    assert scatter.ratios == pytest.approx((factor, factor), rel=0.1)


def test_it_follows_within_a_second_or_two():
    scatter = SampleScatter(NOISE)
    walk(scatter, 20.0)
    walk(scatter, 1.0, seconds=8.0)
    assert scatter.ratios == pytest.approx((1.0, 1.0), rel=0.15)


def test_nothing_is_said_before_there_are_samples_and_a_silent_sensor_is_no_division_by_zero():
    scatter = SampleScatter(NOISE)
    assert scatter.ratios is None
    scatter.push(window(0.0, np.array([0.0, 0.05]), np.zeros((2, 3)), np.zeros((2, 3))))
    assert scatter.ratios is None
    silent = SampleScatter(ImuNoise(gyro_noise=0.0, gyro_walk=0.0, accel_noise=0.0, accel_walk=0.0, rate_hz=200.0))
    walk(silent, 1.0, seconds=0.2)
    assert np.isfinite(silent.ratios).all()


def test_noise_is_scaled_as_far_as_the_samples_scatter():
    trust = InertialTrust(gyro_noise_scale=2.0, accel_noise_scale=4.0)
    assert trust.scales(None) == (2.0, 4.0)
    assert trust.scales((0.7, 0.9)) == (1.0, 1.0)
    assert trust.scales((1.5, 3.0)) == (1.5, 3.0)
    assert trust.scales((17.0, 40.0)) == (2.0, 4.0)
    assert InertialTrust(gyro_noise_scale=2.0, follow_scatter=False).scales((1.0, 1.0)) == (2.0, 1.0)
    assert InertialTrust(gyro_noise_scale=0.5).scales((1.0, 1.0)) == (0.5, 1.0)
