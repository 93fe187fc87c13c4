"""The path that an attempt found, to hold the next attempt's against it."""

from dataclasses import dataclass

import numpy as np

from vioframe.checks import Array, Stamps
from vioframe.conventions import NANOSECONDS
from vioframe.tight.start_bundle import BundleResult

# On a shorter overlap the ratio of two sizes says little.
_LEAST_OVERLAP_S = 0.5
_SAMPLES = 20


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SolvedPath:
    """Attributes: stamps_ns: (K,); p: (K, 3) m and v: (K, 3) m/s, in a world of its own."""

    stamps_ns: Stamps
    p: Array
    v: Array

    @staticmethod
    def of(result: BundleResult, origin_ns: int, times: Array) -> "SolvedPath":
        """The path of a bundle adjustment whose instants are ``times`` (K,) s after ``origin_ns``."""
        stamps_ns = origin_ns + np.round(times * NANOSECONDS).astype(np.int64)
        return SolvedPath(stamps_ns=stamps_ns, p=result.state.p, v=result.state.v)

    def size_against(self, other: "SolvedPath") -> float | None:
        """Ratio of the sizes of both paths where they overlap; None where they hardly do."""
        start = max(self.stamps_ns[0], other.stamps_ns[0])
        end = min(self.stamps_ns[-1], other.stamps_ns[-1])
        if end - start < _LEAST_OVERLAP_S * NANOSECONDS:
            return None
        wanted = np.linspace(0, end - start, _SAMPLES).astype(np.int64) + start
        own, its = self._spread(wanted), other._spread(wanted)
        return own / its if its > 1e-9 else None

    def _spread(self, wanted: Stamps) -> float:
        """Root of the summed squared distances from the middle, by cubic interpolation (Hermite)."""
        origin = self.stamps_ns[0]
        knots, at = (self.stamps_ns - origin) / NANOSECONDS, (wanted - origin) / NANOSECONDS
        before = np.clip(np.searchsorted(knots, at, side="right") - 1, 0, len(knots) - 2)
        span = (knots[before + 1] - knots[before])[:, None]
        u = (at - knots[before])[:, None] / span
        places = (
            (1 + 2 * u) * (1 - u) ** 2 * self.p[before]
            + u * (1 - u) ** 2 * span * self.v[before]
            + u**2 * (3 - 2 * u) * self.p[before + 1]
            + u**2 * (u - 1) * span * self.v[before + 1]
        )
        return float(np.linalg.norm(places - places.mean(axis=0)))
