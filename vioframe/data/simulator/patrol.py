"""Walking around inside a building: once around its corridors, and on a little along the same way."""

import numpy as np

from vioframe.checks import Array
from vioframe.data.simulator.plan import PlannedMotion, own_time, rotation_from_angles, start_rest, sway
from vioframe.data.simulator.spline import SplineMotion, control_times

_KNOT_S = 0.1
_POINT_M = 0.05
_STEPS_HZ = 1.9


def plan_patrol(rng: np.random.Generator, duration_s: float, standstill_s: float) -> PlannedMotion:
    """A lap of 104 to 114 m at 1.2 m/s, sensor in the hand: after 115 s, 14 m or more are walked again."""
    half_x, half_y = rng.uniform(17.0, 18.5), rng.uniform(10.2, 10.8)
    speed = rng.uniform(1.18, 1.24)
    route = _rounded_rectangle(half_x, half_y, radius=1.5)
    times = control_times(duration_s, _KNOT_S)
    time = own_time(times, start_rest(standstill_s), _KNOT_S)
    # Faster and slower by turns; without that an accelerometer says little about the scale.
    along = rng.uniform(0.0, 1.0) * 2.0 * half_x + speed * time + sway(rng, time, 0.25, 0.1, 0.35)
    hand = rng.choice([-1.0, 1.0])
    x, y, heading = _follow(route, hand * along, hand)
    drift = sway(rng, time, 0.3, 0.05, 0.3)
    step = 2.0 * np.pi * _STEPS_HZ * time + rng.uniform(0.0, 2.0 * np.pi)
    position = np.stack(
        [
            x - np.sin(heading) * drift,
            y + np.cos(heading) * drift,
            1.5 + sway(rng, time, 0.1, 0.2, 0.5) + 0.015 * np.sin(step),
        ],
        axis=-1,
    )
    rotation = rotation_from_angles(
        heading + sway(rng, time, 0.35, 0.05, 0.3),
        0.05 + sway(rng, time, 0.12, 0.1, 0.5),
        sway(rng, time, 0.08, 0.1, 0.6),
    )
    return PlannedMotion(
        motion=SplineMotion(knot_s=_KNOT_S, positions=position, rotations=rotation),
        place="building",
        route=np.column_stack([route, np.full(len(route), 1.5)]),
    )


def _rounded_rectangle(half_x: float, half_y: float, radius: float) -> Array:
    """Points (N, 2) m around the origin, every ``_POINT_M``, anticlockwise from the left end of the lower side."""
    points: list[Array] = []
    for quarter, (half_along, half_across) in enumerate(((half_x, half_y), (half_y, half_x)) * 2):
        turn = 0.5 * np.pi * quarter
        straight = np.arange(radius - half_along, half_along - radius, _POINT_M)
        side = np.column_stack([straight, np.full_like(straight, -half_across)])
        bend = np.arange(0.0, 0.5 * np.pi, _POINT_M / radius)
        middle = np.array([half_along - radius, radius - half_across])
        corner = middle + radius * np.column_stack([np.sin(bend), -np.cos(bend)])
        turned = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        points.append(np.concatenate([side, corner]) @ turned.T)
    return np.concatenate(points)


def _follow(route: Array, along: Array, hand: float) -> tuple[Array, Array, Array]:
    """Position x, y (N,) m and heading (N,) rad after some metres along a closed route, looking a step ahead."""
    closed = np.concatenate([route, route[:1]])
    metres = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])

    def at(distance: Array) -> Array:
        return np.column_stack([np.interp(distance % metres[-1], metres, closed[:, axis]) for axis in (0, 1)])

    ahead = at(along + 0.8 * hand) - at(along - 0.3 * hand)
    here = at(along)
    return here[:, 0], here[:, 1], np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
