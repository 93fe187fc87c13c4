"""What faults do to inertial samples: they get lost, noisier, clipped, or read along other axes."""

from collections import Counter

import numpy as np

from vioframe.checks import Array, Mask, Stamps
from vioframe.conventions import NANOSECONDS
from vioframe.types import ImuBlock, ImuNoise

Intervals = tuple[tuple[float, float], ...]
"""Pairs (start, length) in s, from the first image on."""

AXES = {"x": (0, 1.0), "y": (1, 1.0), "z": (2, 1.0), "-x": (0, -1.0), "-y": (1, -1.0), "-z": (2, -1.0)}
"""Column and sign by the name of an axis."""

# Streams of chance, beside those of the frames.
_MISSES, _GAPS, _WHITE, _WALK = 2, 3, 4, 5


def within(intervals: Intervals, stamps_ns: Stamps, first_ns: int | None) -> Mask:
    """Which stamps (N,), IMU clock, lie in an interval; none before the first image has come."""
    inside: Mask = np.zeros(len(stamps_ns), dtype=bool)
    if first_ns is not None:
        elapsed = (stamps_ns - first_ns) / NANOSECONDS
        for start, length in intervals:
            inside |= (elapsed >= start) & (elapsed < start + length)
    return inside


class InertialDamage:
    """The damage of one pass over a recording; each kind draws from a stream of its own.

    Args:
        lost_s: intervals without samples.
        gap_s: length of the holes that come again and again, s; 0 for none.
        gap_every_s: one hole lies somewhere in each stretch of this length but the first, s.
        missing: 0…1, share of samples that never arrive.
        noise: factor on the noise densities, 1 or more.
        gyro_limit: rad/s, end of the range; 0 for none.
        axes: which axis of the body each delivered axis reads.
        accel_negated: the accelerometer reads −g at rest.
        densities: of the samples as they are.
        seed: of all that is random.
        counts: where to count what happens.
    """

    def __init__(
        self,
        *,
        lost_s: Intervals,
        gap_s: float,
        gap_every_s: float,
        missing: float,
        noise: float,
        gyro_limit: float,
        axes: tuple[str, str, str],
        accel_negated: bool,
        densities: ImuNoise,
        seed: tuple[int, int],
        counts: Counter[str],
    ) -> None:
        self._lost_s = lost_s
        self._gap_s, self._gap_every_s = gap_s, gap_every_s
        self._missing = missing
        self._gyro_limit = gyro_limit
        self._accel_negated = accel_negated
        self._counts = counts
        self._seed = seed
        self._misses, self._white, self._walk = (np.random.default_rng((*seed, k)) for k in (_MISSES, _WHITE, _WALK))
        self._gap_starts: dict[int, float] = {}
        columns, signs = zip(*(AXES[axis] for axis in axes), strict=True)
        self._columns, self._signs = list(columns), np.array(signs)
        # Variances add, so this much is missing to the factor on the standard deviation.
        added = np.sqrt(noise**2 - 1.0)
        pairs = ((densities.gyro_noise, densities.gyro_walk), (densities.accel_noise, densities.accel_walk))
        root_hz = np.sqrt(densities.rate_hz)
        self._white_sigma = added * root_hz * np.repeat([white for white, _ in pairs], 3)
        self._walk_sigma = added / root_hz * np.repeat([walk for _, walk in pairs], 3)
        self._drift = np.zeros(6)

    def of(self, block: ImuBlock, first_ns: int | None) -> ImuBlock | None:
        """The samples that arrive, as they read, or None where none does.

        Args:
            block: as it was recorded.
            first_ns: instant of the first image, IMU clock, or None before it.
        """
        lost = within(self._lost_s, block.stamps_ns, first_ns) | self._in_gap(block.stamps_ns, first_ns)
        missing = (self._misses.random(len(block)) < self._missing) & ~lost
        self._counts["samples lost with the IMU"] += int(lost.sum())
        self._counts["missing samples"] += int(missing.sum())
        kept = ~(lost | missing)
        # Drawn for every sample, so that a loss does not change the noise of the others.
        noise = self._noise(len(block))[kept]
        gyro = self._turned(block.gyro[kept]) + noise[:, :3]
        if self._gyro_limit:
            beyond = np.abs(gyro) > self._gyro_limit
            self._counts["saturated samples"] += int(beyond.any(axis=1).sum())
            gyro = np.clip(gyro, -self._gyro_limit, self._gyro_limit)
        accel = self._turned(block.accel[kept]) + noise[:, 3:]
        accel = -accel if self._accel_negated else accel
        return ImuBlock(stamps_ns=block.stamps_ns[kept], gyro=gyro, accel=accel) if kept.any() else None

    def _turned(self, values: Array) -> Array:
        turned: Array = values[:, self._columns] * self._signs
        return turned

    def _noise(self, count: int) -> Array:
        """What is added to gyro and accelerometer, (N, 6)."""
        if not self._white_sigma.any() and not self._walk_sigma.any():
            return np.zeros((count, 6))
        drift = self._drift + np.cumsum(self._walk_sigma * self._walk.standard_normal((count, 6)), axis=0)
        if count:
            self._drift = drift[-1]
        noise: Array = drift + self._white_sigma * self._white.standard_normal((count, 6))
        return noise

    def _in_gap(self, stamps_ns: Stamps, first_ns: int | None) -> Mask:
        """Which stamps (N,) lie in one of the holes that come again and again."""
        if not self._gap_s or first_ns is None:
            return np.zeros(len(stamps_ns), dtype=bool)
        elapsed = (stamps_ns - first_ns) / NANOSECONDS
        stretches = np.floor(elapsed / self._gap_every_s).astype(int)
        starts = np.array([self._gap_start(int(k)) for k in stretches])
        inside: Mask = (elapsed >= starts) & (elapsed < starts + self._gap_s)
        return inside

    def _gap_start(self, stretch: int) -> float:
        """Where the hole of a stretch begins, s after the first image; the first stretch has none."""
        if stretch < 1:
            return float("inf")
        if stretch not in self._gap_starts:
            share = float(np.random.default_rng((*self._seed, _GAPS, stretch)).random())
            self._gap_starts[stretch] = stretch * self._gap_every_s + share * (self._gap_every_s - self._gap_s)
        return self._gap_starts[stretch]
