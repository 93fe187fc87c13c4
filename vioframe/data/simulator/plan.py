"""A motion and the world it needs, and the pieces that such plans are written with."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from vioframe.checks import Array
from vioframe.data.simulator.spline import SplineMotion
from vioframe.geometry import so3

Place = Literal["room", "hall", "corridor", "building", "street"]

_RAMP_S = 1.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlannedMotion:
    """A motion and the world it needs.

    Attributes:
        motion: of the body.
        place: kind of world.
        route: (N, 3) m, the whole way that the place is built around, where it goes on beyond the motion; a closed
            polygon for a building.
    """

    motion: SplineMotion
    place: Place
    route: Array | None = None


def rotation_from_angles(yaw: Array, pitch: Array, roll: Array) -> Array:
    """R_world_body (N, 3, 3) for x forward, y left, z up: yaw about z, then nose *down* by ``pitch``, then roll."""
    zero = np.zeros_like(yaw)
    turn = so3.exp(np.stack([zero, zero, yaw], -1))
    nod = so3.exp(np.stack([zero, pitch, zero], -1))
    lean = so3.exp(np.stack([roll, zero, zero], -1))
    return turn @ nod @ lean


def own_time(t_s: Array, rests: list[tuple[float, float]], knot_s: float) -> Array:
    """Time that stops during rests, and slows and speeds up smoothly around them.

    Args:
        t_s: (N,) times of the motion.
        rests: (from, to) in s of the motion.
        knot_s: knot interval of the spline that will carry the motion.

    Returns:
        (N,) seconds; 0 at 0.
    """
    grid = np.arange(min(t_s.min(), 0.0) - 1.0, t_s.max() + 1.0, 0.01)
    rate = np.ones_like(grid)
    for start, end in rests:
        # The spline looks three knots ahead and behind, so it rests only well inside a constant stretch.
        before = np.clip((start - 3.0 * knot_s - grid) / _RAMP_S, 0.0, 1.0)
        after = np.clip((grid - (end + 3.0 * knot_s)) / _RAMP_S, 0.0, 1.0)
        gate = np.maximum(before, after)
        rate = np.minimum(rate, gate * gate * (3.0 - 2.0 * gate))
    elapsed = np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * 0.01)])
    elapsed -= np.interp(0.0, grid, elapsed)
    own: Array = np.interp(t_s, grid, elapsed)
    return own


def start_rest(standstill_s: float) -> list[tuple[float, float]]:
    """The rest (from, to) in s before the motion sets out; none where it starts under way."""
    # From well before zero, where control points lie that shape the first instant.
    return [(-10.0, standstill_s)] if standstill_s > 0.0 else []


def sway(rng: np.random.Generator, time: Array, amplitude: float, low_hz: float, high_hz: float) -> Array:
    """Three incommensurate waves (N,) between two frequencies, at most ``amplitude`` high."""
    frequencies = rng.uniform(low_hz, high_hz, 3)
    phases = rng.uniform(0.0, 2.0 * np.pi, 3)
    weights = rng.dirichlet(np.full(3, 4.0)) * amplitude
    waves = np.sin(2.0 * np.pi * frequencies * time[:, None] + phases)
    total: Array = waves @ weights
    return total
