"""Numbers of size one that the net of the residual head sees of each pair."""

import numpy as np

from vioframe.checks import Array, Mask
from vioframe_lstm.pairs import Pairs, transposed, turned

FEATURES = 37
# Where the curves bend, as part of the units: a car's sideways shift matters at a hundredth of its speed.
_FINE = 0.02
# m/s²: the accelerations of a car, and a third of gravity.
_ACCELERATION = 3.0
# Usual interval of images, s, and usual ln variance of a motion: shifts only.
_INTERVAL_S, _LOG_VARIANCE = 0.1, -9.0


def features(pairs: Pairs, speed_unit: float, rate_unit: float) -> Array:
    """(B, S, FEATURES) of pairs; each looks at its pair and the one before, the first at a missing one.

    Args:
        pairs: in a row.
        speed_unit: m/s that count as one.
        rate_unit: rad/s that count as one.
    """
    seconds = pairs.duration_s[..., None]
    visual, inertial = pairs.visual[..., None], pairs.inertial[..., None]
    velocity = pairs.t_body / seconds
    rate = pairs.turn / seconds
    apart = pairs.disagreement / seconds
    force = pairs.push / seconds
    change, needed, both = _changes(pairs, velocity, force)
    return np.concatenate(
        [
            np.log(seconds / _INTERVAL_S),
            visual,
            inertial,
            both[..., None],
            velocity / speed_unit,
            np.arcsinh(velocity / (_FINE * speed_unit)),
            rate / rate_unit,
            np.arcsinh(rate / (_FINE * rate_unit)),
            np.arcsinh(apart / (_FINE * rate_unit)),
            force / _ACCELERATION,
            change / _ACCELERATION,
            (change - needed) / _ACCELERATION,
            np.cross(rate, velocity) / _ACCELERATION,
            0.25 * (pairs.log_variances - _LOG_VARIANCE) * visual,
        ],
        axis=-1,
    )


def _changes(pairs: Pairs, velocity: Array, force: Array) -> tuple[Array, Array, Mask]:
    """Acceleration that the VO's mean velocities imply, the specific force over the same time, and where both are.

    From the middle of the pair before to the middle of this one, in the body at this one's first image. Their
    difference is gravity as the body sees it, and the errors of both sensors.
    """
    known = pairs.visual & pairs.inertial
    both = np.zeros_like(known)
    both[:, 1:] = known[:, 1:] & known[:, :-1]
    back = transposed(pairs.R_gyro[:, :-1])
    elapsed = 0.5 * (pairs.duration_s[:, 1:] + pairs.duration_s[:, :-1])[..., None]
    change, mean_force = np.zeros_like(velocity), np.zeros_like(force)
    change[:, 1:] = (velocity[:, 1:] - turned(back, velocity[:, :-1])) / elapsed
    mean_force[:, 1:] = 0.5 * (force[:, 1:] + turned(back, force[:, :-1]))
    return change * both[..., None], mean_force * both[..., None], both
