"""Smooth motions with exact derivatives: uniform cumulative B-splines on SO(3) × R³.

Formulas: Sommer, Usenko, Schubert, Demmel, Cremers, "Efficient derivative computation for cumulative
B-splines on Lie groups", CVPR 2020, sections 4 and 5.
"""

from dataclasses import dataclass
from math import comb, factorial
from typing import Protocol

import numpy as np

from vioframe.checks import Array
from vioframe.errors import ConfigError
from vioframe.geometry import se3, so3

ORDER = 6
"""Control points that shape one instant: degree five, so that jerk and angular jerk are still continuous."""


def blending_matrix(order: int = ORDER) -> Array:
    """Coefficients (order, order) of a uniform B-spline: weight of point s is ``Σ_n out[s, n] uⁿ`` (Sommer, eq. 5)."""
    k = order
    out = np.zeros((k, k))
    for s in range(k):
        for n in range(k):
            total = sum((-1) ** (i - s) * comb(k, i - s) * (k - 1 - i) ** (k - 1 - n) for i in range(s, k))
            out[s, n] = comb(k - 1, n) / factorial(k - 1) * total
    return out


_BLENDING = blending_matrix()
_CUMULATIVE = np.cumsum(_BLENDING[::-1], axis=0)[::-1]


def _powers(u: Array, derivative: int) -> Array:
    """Derivatives (ORDER, N) of u⁰ … u⁵."""
    rows = []
    for n in range(ORDER):
        factor = float(np.prod(np.arange(n, n - derivative, -1))) if n >= derivative else 0.0
        rows.append(factor * u ** max(n - derivative, 0))
    return np.stack(rows)


def basis_weights(u: Array) -> Array:
    """Weights (ORDER, N) of the control points at fractions (N,) of a segment."""
    return _BLENDING @ _powers(u, 0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MotionState:
    """The body at one or many instants, exactly.

    Attributes:
        T_world_body: (..., 4, 4).
        velocity: (..., 3) m/s, world.
        acceleration: (..., 3) m/s², world, without gravity.
        rotation_rate: (..., 3) rad/s, body.
        rotation_acceleration: (..., 3) rad/s², body.
    """

    T_world_body: Array
    velocity: Array
    acceleration: Array
    rotation_rate: Array
    rotation_acceleration: Array


class Motion(Protocol):
    """Where the body is, at any time from 0 to ``duration_s``."""

    @property
    def duration_s(self) -> float:
        """Length in s."""
        ...

    def evaluate(self, t_s: Array | float) -> MotionState:
        """State at times (...) in s; times outside are taken as the nearest end."""
        ...


class SplineMotion:
    """A motion shaped by control poses in equal steps.

    Control pose i has its greatest influence at ``(i - 2) knot_s``; the motion stays in the convex hull of
    the positions, and rests wherever six neighbours agree.

    Args:
        knot_s: time between control poses.
        positions: (M, 3) m, world, M ≥ 6.
        rotations: (M, 3, 3), R_world_body; neighbours less than half a turn apart.

    Raises:
        ConfigError: fewer than six control poses, or a step that is not positive.
    """

    def __init__(self, *, knot_s: float, positions: Array, rotations: Array) -> None:
        if len(positions) < ORDER or len(positions) != len(rotations):
            raise ConfigError(
                f"a spline motion needs at least {ORDER} control positions and as many rotations, "
                f"got {len(positions)} and {len(rotations)}"
            )
        if not knot_s > 0.0:
            raise ConfigError(f"knot_s must be positive, got {knot_s}")
        self.knot_s = knot_s
        self.positions = positions
        self.rotations = rotations
        self._steps = so3.log(np.swapaxes(rotations[:-1], -1, -2) @ rotations[1:])

    @property
    def duration_s(self) -> float:
        """Length in s."""
        return (len(self.positions) - ORDER + 1) * self.knot_s

    def locate(self, t_s: Array) -> tuple[np.ndarray, Array]:
        """First control point (N,) and fraction of its segment (N,) of times (N,)."""
        scaled = np.clip(t_s, 0.0, self.duration_s) / self.knot_s
        first = np.minimum(scaled.astype(np.int64), len(self.positions) - ORDER)
        return first, scaled - first

    def evaluate(self, t_s: Array | float) -> MotionState:
        """State at times (...) in s; times outside are taken as the nearest end."""
        times = np.asarray(t_s, dtype=float)
        shape = times.shape
        first, u = self.locate(times.ravel())
        near = self.positions[first[:, None] + np.arange(ORDER)]
        position, velocity, acceleration = (
            np.einsum("sn,nsx->nx", _BLENDING @ _powers(u, d), near) / self.knot_s**d for d in range(3)
        )
        weight, rate, bend = (_CUMULATIVE @ _powers(u, d) / self.knot_s**d for d in range(3))
        R = self.rotations[first]
        omega = np.zeros((len(u), 3))
        alpha = np.zeros((len(u), 3))
        for j in range(1, ORDER):
            step = self._steps[first + j - 1]
            turn = so3.exp(weight[j][:, None] * step)
            back = np.swapaxes(turn, -1, -2)
            R = R @ turn
            swing = rate[j][:, None] * step
            omega = (back @ omega[..., None])[..., 0] + swing
            alpha = (back @ alpha[..., None])[..., 0] + bend[j][:, None] * step + np.cross(omega, swing)
        return MotionState(
            T_world_body=se3.from_parts(R, position).reshape(*shape, 4, 4),
            velocity=velocity.reshape(*shape, 3),
            acceleration=acceleration.reshape(*shape, 3),
            rotation_rate=omega.reshape(*shape, 3),
            rotation_acceleration=alpha.reshape(*shape, 3),
        )


def control_times(duration_s: float, knot_s: float) -> Array:
    """Times (M,) in s at which the control poses of a motion of at least this length have their greatest influence."""
    segments = int(np.ceil(duration_s / knot_s - 1e-9))
    return (np.arange(segments + ORDER - 1) - 2) * knot_s
