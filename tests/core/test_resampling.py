"""Resampled inertial samples integrate to what the measured ones did."""

import numpy as np
import pytest

from vioframe.checks import Array
from vioframe.conventions import NANOSECONDS
from vioframe.resampling import resample
from vioframe.types import ImuBlock


def block(stamps_s: Array, seed: int = 0) -> ImuBlock:
    random = np.random.default_rng(seed)
    stamps_ns = np.round(np.asarray(stamps_s) * NANOSECONDS).astype(np.int64) + 1_600_000_000_000_000_000
    shape = (len(stamps_ns), 3)
    return ImuBlock(stamps_ns=stamps_ns, gyro=random.normal(size=shape), accel=random.normal(size=shape))


def integral(imu: ImuBlock, start_ns: int, end_ns: int) -> Array:
    """Of the piecewise linear signal from one stamp to another, by brute force."""
    within = imu.stamps_ns[(imu.stamps_ns > start_ns) & (imu.stamps_ns < end_ns)]
    stamps = np.concatenate([[start_ns], within, [end_ns]]) - imu.stamps_ns[0]
    values = np.stack([np.interp(stamps, imu.stamps_ns - imu.stamps_ns[0], column) for column in imu.gyro.T], axis=1)
    return np.trapezoid(values, stamps / NANOSECONDS, axis=0)


@pytest.mark.parametrize("count", [2, 3, 8, 20, 21, 100])
@pytest.mark.parametrize("intervals", [1, 7, 10])
def test_the_integral_of_every_interval_is_kept(count: int, intervals: int) -> None:
    random = np.random.default_rng(count)
    imu = block(np.concatenate([[0.0], np.sort(random.uniform(0.001, 0.099, count - 2)), [0.1]]))
    even = resample(imu, intervals)
    assert len(even) == intervals + 1
    assert (even.stamps_ns[[0, -1]] == imu.stamps_ns[[0, -1]]).all()
    assert np.ptp(np.diff(even.stamps_ns)) <= 1
    for k in range(intervals):
        start_ns, end_ns = int(even.stamps_ns[k]), int(even.stamps_ns[k + 1])
        expected = integral(imu, start_ns, end_ns)
        np.testing.assert_allclose(integral(even, start_ns, end_ns), expected, atol=1e-9)


def test_a_linear_signal_stays_itself() -> None:
    stamps = np.array([0.0, 0.013, 0.02, 0.055, 0.1])
    imu = block(stamps)
    slopes = np.array([1.0, -2.0, 3.0])
    line = ImuBlock(stamps_ns=imu.stamps_ns, gyro=stamps[:, None] * slopes, accel=9.81 - stamps[:, None] * slopes)
    even = resample(line, 10)
    elapsed = (even.stamps_ns - even.stamps_ns[0])[:, None] / NANOSECONDS
    np.testing.assert_allclose(even.gyro, elapsed * slopes, atol=1e-8)
    np.testing.assert_allclose(even.accel, 9.81 - elapsed * slopes, atol=1e-8)


def test_samples_that_are_even_already_are_left_alone() -> None:
    imu = block(np.arange(11) * 0.01038)
    assert resample(imu, 10) is imu
    shaken = block(np.arange(11) * 0.01 + np.where(np.arange(11) % 10, 5e-5, 0.0))
    assert resample(shaken, 10) is shaken


def test_what_is_too_short_to_divide_is_left_alone() -> None:
    imu = block(np.array([0.0, 5e-9]))
    assert resample(imu, 10) is imu
