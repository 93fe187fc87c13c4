"""Driving: a path of straight streets and right-angled turns, and how fast a car takes it."""

import numpy as np

from vioframe.checks import Array
from vioframe.data.simulator.plan import PlannedMotion, own_time, rotation_from_angles, start_rest
from vioframe.data.simulator.spline import SplineMotion, control_times

BODY_HEIGHT_M = 0.93
"""Of the inertial sensor above the road, as in KITTI's car."""

_KNOT_S = 0.2
_BLOCK_M = 60.0
# Accelerations, m/s², of a driver with passengers.
_TURN_LATERAL = 2.4
_ACCELERATION, _BRAKING = 1.7, 2.0
# Steps in time of the distance driven.
_STEP_S = 0.02


def plan_drive(rng: np.random.Generator, duration_s: float, standstill_s: float) -> PlannedMotion:
    """Through a town at 8 to 15 m/s, slower around corners; planar, starting along x."""
    cruise = rng.uniform(10.0, 14.0)
    path = _path(rng, cruise * duration_s + 200.0)
    distance = _distance(path, cruise, duration_s + 30.0)
    times = control_times(duration_s, _KNOT_S)
    own = own_time(times, start_rest(standstill_s), _KNOT_S)
    travelled = np.interp(own, np.arange(len(distance)) * _STEP_S, distance)
    if standstill_s == 0.0:
        # Already under way, as most recordings of cars are.
        lead = int(np.searchsorted(distance, 60.0))
        travelled = np.interp(times, np.arange(len(distance) - lead) * _STEP_S, distance[lead:])
    steps = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1))])
    x, y, heading = (np.interp(travelled, steps, path[:, column]) for column in range(3))
    position = np.stack([x, y, np.full_like(x, BODY_HEIGHT_M)], axis=-1)
    zero = np.zeros_like(x)
    return PlannedMotion(
        motion=SplineMotion(knot_s=_KNOT_S, positions=position, rotations=rotation_from_angles(heading, zero, zero)),
        place="street",
    )


def _path(rng: np.random.Generator, length_m: float) -> Array:
    """x, y (m) and heading (rad), (N, 3), every half metre or less."""
    points: list[Array] = []
    corner, heading, total = np.zeros(2), 0.0, 0.0
    radius = 0.0
    while total < length_m:
        straight = _BLOCK_M * float(rng.integers(1, 4))
        turn = float(rng.choice([-1.0, 1.0]))
        next_radius = float(rng.uniform(9.0, 13.0))
        direction = np.array([np.cos(heading), np.sin(heading)])
        sideways = np.array([-direction[1], direction[0]])
        run = np.arange(radius, straight - next_radius, 0.5)
        points += [np.array([*(corner + s * direction), heading]) for s in run]
        start = corner + (straight - next_radius) * direction
        centre = start + turn * next_radius * sideways
        for angle in np.arange(0.0, 0.5 * np.pi, 0.4 / next_radius):
            spoke = -turn * (np.cos(angle) * sideways) + np.sin(angle) * direction
            points.append(np.array([*(centre + next_radius * spoke), heading + turn * angle]))
        corner = corner + straight * direction
        heading += turn * 0.5 * np.pi
        radius = next_radius
        # A quarter of a circle is shorter than the corner that it cuts by (2 - π/2) of its radius.
        total += straight - 0.43 * next_radius
    return np.array(points)


def _distance(path: Array, cruise: float, duration_s: float) -> Array:
    """Distance (N,) m along the path every ``_STEP_S``, from rest, within what tyres and brakes allow."""
    steps = np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1)
    curvature = np.abs(np.diff(np.unwrap(path[:, 2]))) / steps
    limit = np.minimum(cruise, np.sqrt(_TURN_LATERAL / np.maximum(curvature, 1e-6)))
    squared = np.concatenate([limit**2, limit[-1:] ** 2])
    # m²/s²: it rolls off at half a metre a second.
    squared[0] = 0.3
    for index in range(1, len(squared)):
        squared[index] = min(squared[index], squared[index - 1] + 2.0 * _ACCELERATION * steps[index - 1])
    for index in range(len(squared) - 2, -1, -1):
        squared[index] = min(squared[index], squared[index + 1] + 2.0 * _BRAKING * steps[index])
    speed = np.sqrt(squared)
    clock = np.concatenate([[0.0], np.cumsum(2.0 * steps / (speed[1:] + speed[:-1]))])
    along = np.concatenate([[0.0], np.cumsum(steps)])
    distance: Array = np.interp(np.arange(0.0, duration_s, _STEP_S), clock, along)
    return distance
