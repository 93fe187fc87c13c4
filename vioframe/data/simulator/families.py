"""Families of motions: the same name and seed always give the same motion.

Each family writes down where a body of its kind would like to be at the control times of a spline; the
spline makes that exact and smooth. A family works in its own time, which stands still while the body
rests, so a rest is one to rounding.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from vioframe.checks import Array
from vioframe.conventions import GRAVITY
from vioframe.data.simulator.drive import plan_drive
from vioframe.data.simulator.patrol import plan_patrol
from vioframe.data.simulator.plan import Place, PlannedMotion, own_time, rotation_from_angles, start_rest, sway
from vioframe.data.simulator.spline import SplineMotion, control_times
from vioframe.errors import ConfigError

Kit = Literal["euroc", "kitti"]

# Room-scale motions have control poses ten times a second, which carries the two steps a second of a walk.
_KNOT_S = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class FamilyTraits:
    """What belongs to a family unless the configuration says otherwise.

    Attributes:
        place: the kind of world built around the motion.
        kit: sensors.
        duration_s: length of a sequence.
        standstill_s: rest at the start.
    """

    place: Place
    kit: Kit = "euroc"
    duration_s: float = 30.0
    standstill_s: float = 2.0


def _loop(
    rng: np.random.Generator, time: Array, half_x: float, half_y: float, speed: float
) -> tuple[Array, Array, Array]:
    """A closed path that never crosses its middle: x, y (N,) m and heading (N,) rad."""
    turn_rate = rng.choice([-1.0, 1.0]) * speed / (0.5 * (half_x + half_y))
    start = rng.uniform(0.0, 2.0 * np.pi)
    waves = rng.uniform(0.0, 2.0 * np.pi, 2)

    def at(angle: Array) -> tuple[Array, Array]:
        radius = 0.88 + 0.08 * np.sin(2.0 * angle + waves[0]) + 0.04 * np.sin(3.0 * angle + waves[1])
        return half_x * radius * np.cos(angle), half_y * radius * np.sin(angle)

    angle = start + turn_rate * time
    x, y = at(angle)
    ahead_x, ahead_y = at(angle + 1e-4 * np.sign(turn_rate))
    heading = np.arctan2(ahead_y - y, ahead_x - x)
    return x, y, np.unwrap(heading)


def _held_walk(rng: np.random.Generator, time: Array) -> tuple[Array, Array]:
    """Walking around in a room with the sensor in the hand, looking about."""
    half_x, half_y = rng.uniform(2.2, 2.8), rng.uniform(1.6, 2.1)
    x, y, heading = _loop(rng, time, half_x, half_y, rng.uniform(0.75, 0.95))
    step = rng.uniform(0.0, 2.0 * np.pi)
    position = np.stack(
        [
            x + sway(rng, time, 0.12, 0.3, 0.8),
            y + sway(rng, time, 0.12, 0.3, 0.8),
            # Steps lift the body a centimetre or so, twice a second.
            1.45 + sway(rng, time, 0.18, 0.2, 0.6) + 0.012 * np.sin(2.0 * np.pi * 1.9 * time + step),
        ],
        axis=-1,
    )
    rotation = rotation_from_angles(
        heading + sway(rng, time, 0.5, 0.05, 0.18),
        0.08 + sway(rng, time, 0.2, 0.1, 0.5),
        sway(rng, time, 0.14, 0.1, 0.6),
    )
    return position, rotation


def _walk(rng: np.random.Generator, duration_s: float, standstill_s: float) -> PlannedMotion:
    times = control_times(duration_s, _KNOT_S)
    position, rotation = _held_walk(rng, own_time(times, start_rest(standstill_s), _KNOT_S))
    return PlannedMotion(motion=SplineMotion(knot_s=_KNOT_S, positions=position, rotations=rotation), place="room")


def _standing(rng: np.random.Generator, duration_s: float, standstill_s: float) -> PlannedMotion:
    """A long rest, then a walk with halts."""
    times = control_times(duration_s, _KNOT_S)
    rests = start_rest(standstill_s)
    halt = standstill_s + rng.uniform(6.0, 9.0)
    while halt < duration_s:
        length = rng.uniform(2.0, 5.0)
        rests.append((halt, halt + length))
        halt += length + rng.uniform(6.0, 9.0)
    position, rotation = _held_walk(rng, own_time(times, rests, _KNOT_S))
    return PlannedMotion(motion=SplineMotion(knot_s=_KNOT_S, positions=position, rotations=rotation), place="room")


def _rotation(rng: np.random.Generator, duration_s: float, standstill_s: float) -> PlannedMotion:
    """Turning on the spot: the body's origin does not move."""
    times = control_times(duration_s, _KNOT_S)
    time = own_time(times, start_rest(standstill_s), _KNOT_S)
    position = np.broadcast_to(np.array([0.0, 0.0, 1.5]), (len(time), 3)).copy()
    rotation = rotation_from_angles(
        rng.uniform(-np.pi, np.pi) + rng.choice([-1.0, 1.0]) * 0.25 * time + sway(rng, time, 0.8, 0.05, 0.2),
        0.05 + sway(rng, time, 0.3, 0.1, 0.4),
        sway(rng, time, 0.25, 0.1, 0.4),
    )
    return PlannedMotion(motion=SplineMotion(knot_s=_KNOT_S, positions=position, rotations=rotation), place="room")


def _drone(rng: np.random.Generator, duration_s: float, standstill_s: float) -> PlannedMotion:
    """A multirotor that leans into its accelerations, at 2 to 4 m/s, from a stand."""
    times = control_times(duration_s, _KNOT_S)
    time = own_time(times, start_rest(standstill_s), _KNOT_S)
    pace = rng.uniform(0.95, 1.15)
    phases = rng.uniform(0.0, 2.0 * np.pi, 6)
    hand = rng.choice([-1.0, 1.0])

    def fly(at: Array) -> Array:
        around = hand * 0.62 * pace * at + phases[0]
        return np.stack(
            [
                4.2 * np.cos(around) + 0.5 * np.sin(1.9 * pace * at + phases[1]),
                2.6 * np.sin(2.0 * around + phases[2]) + 0.4 * np.sin(1.3 * pace * at + phases[3]),
                2.0 + 0.75 * np.sin(0.9 * pace * at + phases[4]) + 0.2 * np.sin(2.1 * pace * at + phases[5]),
            ],
            axis=-1,
        )

    position = fly(time)
    # Acceleration in real time, so that the vehicle is level while it stands.
    step = 0.02
    acceleration = (
        fly(own_time(times + step, start_rest(standstill_s), _KNOT_S))
        - 2.0 * position
        + fly(own_time(times - step, start_rest(standstill_s), _KNOT_S))
    ) / step**2
    yaw = phases[3] + hand * 0.35 * time + sway(rng, time, 0.7, 0.05, 0.15)
    ahead = np.stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)], axis=-1)
    thrust = acceleration + np.array([0.0, 0.0, GRAVITY])
    up = thrust / np.linalg.norm(thrust, axis=-1, keepdims=True)
    left = np.cross(up, ahead)
    left /= np.linalg.norm(left, axis=-1, keepdims=True)
    rotation = np.stack([np.cross(left, up), left, up], axis=-1)
    return PlannedMotion(motion=SplineMotion(knot_s=_KNOT_S, positions=position, rotations=rotation), place="hall")


def _corridor(rng: np.random.Generator, duration_s: float, standstill_s: float) -> PlannedMotion:
    """To the end of a corridor and back, again and again, with a turn on the spot at each end."""
    times = control_times(duration_s, _KNOT_S)
    time = own_time(times, start_rest(standstill_s), _KNOT_S)
    length, speed, turn_s = rng.uniform(32.0, 40.0), rng.uniform(1.2, 1.4), 3.0
    leg_s = length / speed + turn_s
    leg = np.floor(time / leg_s)
    within = time - leg * leg_s
    # Distance along the leg eases out into the turn and in again, so that the turn is nearly on the spot.
    progress = np.clip(within / (leg_s - turn_s), 0.0, 1.0)
    ease = 1.5 / (length / speed)
    eased = (np.sqrt((progress - 1.0) ** 2 + ease**2) - np.sqrt(1.0 + ease**2)) / (ease - np.sqrt(1.0 + ease**2))
    soft_start = np.minimum(progress / (2.0 * ease), 1.0)
    eased = eased * soft_start + 0.5 * eased * (1.0 - soft_start)
    back = (leg % 2.0) == 1.0
    x = np.where(back, length * (1.0 - eased), length * eased)
    turning = np.clip((within - (leg_s - turn_s)) / turn_s, 0.0, 1.0)
    heading = np.pi * (leg + turning * turning * (3.0 - 2.0 * turning))
    step = rng.uniform(0.0, 2.0 * np.pi)
    position = np.stack(
        [
            x,
            sway(rng, time, 0.3, 0.05, 0.3),
            1.5 + sway(rng, time, 0.08, 0.2, 0.5) + 0.012 * np.sin(2.0 * np.pi * 1.9 * time + step),
        ],
        axis=-1,
    )
    rotation = rotation_from_angles(
        heading + sway(rng, time, 0.2, 0.05, 0.3),
        0.05 + sway(rng, time, 0.1, 0.1, 0.5),
        sway(rng, time, 0.08, 0.1, 0.6),
    )
    return PlannedMotion(motion=SplineMotion(knot_s=_KNOT_S, positions=position, rotations=rotation), place="corridor")


Builder = Callable[[np.random.Generator, float, float], PlannedMotion]

FAMILIES: dict[str, tuple[FamilyTraits, Builder]] = {
    "walk": (FamilyTraits(place="room"), _walk),
    "standing": (FamilyTraits(place="room", standstill_s=8.0), _standing),
    "rotation": (FamilyTraits(place="room"), _rotation),
    "drone": (FamilyTraits(place="hall"), _drone),
    "corridor": (FamilyTraits(place="corridor", duration_s=70.0), _corridor),
    "car": (FamilyTraits(place="street", kit="kitti", duration_s=110.0), plan_drive),
    "building": (FamilyTraits(place="building", duration_s=115.0), plan_patrol),
}
"""Name → traits and builder (generator, duration_s, standstill_s)."""


def family_traits(family: str) -> FamilyTraits:
    """Traits of a family.

    Raises:
        ConfigError: no family has this name.
    """
    if family not in FAMILIES:
        raise ConfigError(f"dataset.sequence={family!r} is no simulated family; choose from {', '.join(FAMILIES)}")
    return FAMILIES[family][0]


def plan_motion(family: str, seed: int, duration_s: float, standstill_s: float) -> PlannedMotion:
    """The motion of a family and seed.

    Raises:
        ConfigError: unknown family, or a duration or rest that cannot be.
    """
    family_traits(family)
    if not duration_s > 0.0:
        raise ConfigError(f"dataset.duration_s must be positive, got {duration_s}")
    if standstill_s < 0.0:
        raise ConfigError(f"dataset.standstill_s must not be negative, got {standstill_s}")
    # The family's place in the seed keeps equal seeds of two families apart.
    rng = np.random.default_rng([list(FAMILIES).index(family), seed])
    return FAMILIES[family][1](rng, duration_s, standstill_s)
