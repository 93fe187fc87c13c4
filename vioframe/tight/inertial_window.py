"""Inertial samples of a few seconds in a row, integrated between any instants.

With rotations R(τ) from an instant to τ, specific force f and the rate ω, both without bias, the increment
from there to T is ΔR = R(T), Δv = ∫ R f, Δp = ∬ R f; a change of the gyro bias turns R(τ) by
−C(τ) δb_g from the left, C = ∫ R, so that

    ∂θ/∂b_g = −ΔRᵀ C(T),  ∂Δv/∂b_g = ∫ hat(R f) C,  ∂Δv/∂b_a = −C(T),  ∂Δp: the integrals of these

(Forster et al., IEEE T-RO 33(1), 2017, appendices A and B, as sums over the samples).
"""

from dataclasses import dataclass

import numpy as np

from vioframe.checks import Array, Mask, Stamps
from vioframe.conventions import NANOSECONDS
from vioframe.geometry import so3
from vioframe.types import ImuBias, ImuBlock, ImuNoise


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Increments:
    """Inertial increments of many intervals, stacked.

    Attributes:
        delta_R: (N, 3, 3); delta_v: (N, 3) m/s; delta_p: (N, 3) m; gravity not applied.
        duration_s: (N,).
        bias_jacobian: (N, 9, 6), order (R, v, p) by (gyro, accel).
        covariance: (N, 9, 9), order (R, v, p), of the white noise.
        bias: what was subtracted.
    """

    delta_R: Array
    delta_v: Array
    delta_p: Array
    duration_s: Array
    bias_jacobian: Array
    covariance: Array
    bias: ImuBias


class InertialWindow:
    """The samples of adjoining blocks, in seconds from a first instant.

    Args:
        blocks: oldest first; each begins with the last sample of the one before.
        origin_ns: the instant from which seconds are counted.
    """

    def __init__(self, blocks: list[ImuBlock], origin_ns: int) -> None:
        stamps_ns: Stamps = np.concatenate([block.stamps_ns for block in blocks])
        gyro = np.concatenate([block.gyro for block in blocks])
        accel = np.concatenate([block.accel for block in blocks])
        stamps_ns, first = np.unique(stamps_ns, return_index=True)
        self.elapsed: Array = (stamps_ns - origin_ns) / NANOSECONDS
        self.gyro: Array = gyro[first]
        self.accel: Array = accel[first]

    def part(self, start: float, end: float) -> ImuBlock:
        """The samples between two instants, s, with their stamps counted from the first instant."""
        inside = (self.elapsed >= start - 1e-9) & (self.elapsed <= end + 1e-9)
        return ImuBlock(
            stamps_ns=np.round(self.elapsed[inside] * NANOSECONDS).astype(np.int64),
            gyro=self.gyro[inside],
            accel=self.accel[inside],
        )

    def rotations(self, times: Array, gyro_bias: Array) -> Array:
        """Rotations (..., 3, 3) of the body from the first sample to ``times`` (...,) s, held at the ends."""
        steps = np.diff(self.elapsed)
        rates = 0.5 * (self.gyro[1:] + self.gyro[:-1]) - gyro_bias
        R = _cumulative(so3.exp(rates * steps[:, None]))
        at = np.clip(times, self.elapsed[0], self.elapsed[-1])
        before = np.clip(np.searchsorted(self.elapsed, at, side="right") - 1, 0, len(steps) - 1)
        into = at - self.elapsed[before]
        turned: Array = R[before] @ so3.exp(rates[before] * into[..., None])
        return turned

    def increments(self, starts: Array, ends: Array, bias: ImuBias, noise: ImuNoise) -> Increments:
        """Integrate from ``starts`` to ``ends`` ((N,) s each, inside the samples), subtracting ``bias``."""
        parts = [self._increment(start, end, bias, noise) for start, end in zip(starts, ends, strict=True)]
        stacked = [np.array(values) for values in zip(*parts, strict=True)]
        return Increments(
            delta_R=stacked[0],
            delta_v=stacked[1],
            delta_p=stacked[2],
            bias_jacobian=stacked[3],
            covariance=stacked[4],
            duration_s=ends - starts,
            bias=bias,
        )

    def _increment(
        self, start: float, end: float, bias: ImuBias, noise: ImuNoise
    ) -> tuple[Array, Array, Array, Array, Array]:
        inside = (self.elapsed > start + 1e-7) & (self.elapsed < end - 1e-7)
        times = np.concatenate([[start], self.elapsed[inside], [end]])
        gyro = self._sampled(self.gyro, inside, start, end) - bias.gyro
        accel = self._sampled(self.accel, inside, start, end) - bias.accel
        steps = np.diff(times)
        R = _cumulative(so3.exp(0.5 * (gyro[1:] + gyro[:-1]) * steps[:, None]))
        force = np.einsum("nij,nj->ni", R, accel)
        v, p = _integrate_twice(force, steps)
        C, CC = _integrate_twice(R, steps)
        bend_v, bend_p = _integrate_twice(so3.hat(force) @ C, steps)
        jacobian = np.zeros((9, 6))
        jacobian[:3, :3] = -R[-1].T @ C[-1]
        jacobian[3:6, :3], jacobian[6:, :3] = bend_v[-1], bend_p[-1]
        jacobian[3:6, 3:], jacobian[6:, 3:] = -C[-1], -CC[-1]
        covariance = _noise_covariance(R, v, p, times, noise)
        return R[-1], v[-1], p[-1], jacobian, covariance

    def _sampled(self, values: Array, inside: Mask, start: float, end: float) -> Array:
        """Values (M + 2, 3) at the samples inside, and interpolated at both ends."""
        borders = np.stack([np.interp([start, end], self.elapsed, values[:, axis]) for axis in range(3)], axis=1)
        return np.concatenate([borders[:1], values[inside], borders[1:]])


def _cumulative(turns: Array) -> Array:
    """Products (N + 1, 3, 3) of successive rotations (N, 3, 3), beginning with the identity."""
    out = np.empty((len(turns) + 1, 3, 3))
    R = out[0] = np.eye(3)
    for index, turn in enumerate(turns):
        R = out[index + 1] = R @ turn
    return out


def _integrate_twice(values: Array, steps: Array) -> tuple[Array, Array]:
    """Integral and integral of the integral (N, ...) of values (N, ...), linear over each step."""
    shaped = steps.reshape(-1, *([1] * (values.ndim - 1)))
    mean = 0.5 * (values[1:] + values[:-1])
    once = np.zeros_like(values)
    np.cumsum(mean * shaped, axis=0, out=once[1:])
    twice = np.zeros_like(values)
    np.cumsum(once[:-1] * shaped + 0.5 * mean * shaped**2, axis=0, out=twice[1:])
    return once, twice


def _noise_covariance(R: Array, v: Array, p: Array, times: Array, noise: ImuNoise) -> Array:
    """Covariance (9, 9) of the white noise; θ is local at the end, v and p in the frame at the start."""
    steps = np.diff(times)
    left = times[-1] - times[:-1]
    # Turning the body at a sample turns everything that is integrated after it.
    to_theta = R[-1].T @ R[:-1]
    to_v = -so3.hat(v[-1] - v[:-1]) @ R[:-1]
    to_p = -so3.hat(p[-1] - p[:-1] - v[:-1] * left[:, None]) @ R[:-1]
    gyro = np.concatenate([to_theta, to_v, to_p], axis=1)
    # White noise of a rate: density² per second of each step.
    covariance: Array = np.einsum("nij,n,nkj->ik", gyro, noise.gyro_noise**2 * steps, gyro)
    T, accel = times[-1] - times[0], noise.accel_noise**2
    covariance[3:6, 3:6] += accel * T * np.eye(3)
    covariance[3:6, 6:9] += 0.5 * accel * T**2 * np.eye(3)
    covariance[6:9, 3:6] += 0.5 * accel * T**2 * np.eye(3)
    covariance[6:9, 6:9] += accel * T**3 / 3.0 * np.eye(3)
    return covariance
