"""Inertial samples brought to a fixed number an image, whatever the sensor's rate."""

import numpy as np

from vioframe.checks import Array, Stamps
from vioframe.conventions import NANOSECONDS
from vioframe.types import ImuBlock

# Stamps this close to even ones, as a share of their spacing, are even but for rounding and jitter.
_EVEN = 0.01


def resample(imu: ImuBlock, intervals: int) -> ImuBlock:
    """Samples at evenly spaced stamps over the same stretch; the integral of each interval is kept.

    Taken as linear between samples, the block integrates over each of the new intervals to an area A_k. The new
    values x_k are those whose trapezoids have these areas, ``(x_k + x_{k+1}) h_k / 2 = A_k``, so that an integrator
    loses nothing of a faster sensor and invents nothing for a slower one. One freedom is left, an alternating
    ±c; it is chosen so that the values lie closest to the block's own at the new stamps.

    Args:
        imu: two samples or more; the first and last stamps stay.
        intervals: N; the result has N + 1 samples.

    Returns:
        the block itself where it has these stamps already, or is too short to be divided.
    """
    span_ns = int(imu.stamps_ns[-1] - imu.stamps_ns[0])
    if span_ns < intervals:
        return imu
    steps = np.arange(intervals + 1, dtype=np.int64)
    stamps_ns = imu.stamps_ns[0] + (steps * span_ns + intervals // 2) // intervals
    if len(imu) == intervals + 1 and np.abs(imu.stamps_ns - stamps_ns).max() <= _EVEN * span_ns / intervals:
        return imu
    values = np.concatenate([imu.gyro, imu.accel], axis=1)
    at_stamps, areas = _values_and_areas(imu.stamps_ns, values, stamps_ns)
    widths = np.diff(stamps_ns) / NANOSECONDS
    missing = 2.0 * areas / widths[:, None] - at_stamps[:-1] - at_stamps[1:]
    signs = np.where(steps % 2, -1.0, 1.0)[:, None]
    alternating = np.zeros_like(at_stamps)
    np.cumsum(signs[1:] * missing, axis=0, out=alternating[1:])
    new = at_stamps + signs * (alternating - alternating.mean(axis=0))
    return ImuBlock(stamps_ns=stamps_ns, gyro=new[:, :3], accel=new[:, 3:])


def _values_and_areas(known_ns: Stamps, values: Array, stamps_ns: Stamps) -> tuple[Array, Array]:
    """The piecewise linear signal at the stamps, (N + 1, 6), and its integrals between them, (N, 6)."""
    known = (known_ns - known_ns[0]) / NANOSECONDS
    wanted = (stamps_ns - known_ns[0]) / NANOSECONDS
    widths = np.diff(known)[:, None]
    until = np.zeros_like(values)
    np.cumsum(0.5 * (values[1:] + values[:-1]) * widths, axis=0, out=until[1:])
    before = np.clip(np.searchsorted(known, wanted, side="right") - 1, 0, len(known) - 2)
    into = (wanted - known[before])[:, None]
    slope = ((values[1:] - values[:-1]) / widths)[before]
    at_stamps = values[before] + slope * into
    integral = until[before] + (values[before] + 0.5 * slope * into) * into
    areas: Array = np.diff(integral, axis=0)
    return at_stamps, areas
