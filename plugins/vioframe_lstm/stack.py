"""The sequential cache of EE-LCVIO: for each image one pose of the VO and N poses of the inertial sensor.

The paper stacks absolute poses of both, those of the inertial sensor by equations without gravity, which leave the
road within a second. Here both begin at the window's start. The inertial positions need a speed to begin with and the
direction of gravity; both are fitted to the VO's positions of the window, with which everything is linear:

    p(t) = v₀ t + g₀ A(t) + s(t),     A = ∬ 1, s = ∬ R f   over the times with samples.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Self

import numpy as np

from vioframe.checks import Array, Mask
from vioframe.geometry import se3, so3
from vioframe_lstm.pairs import Pairs, attitudes, held_shifts, integrated, turned

# How far the direction and size of gravity may be from what the mean specific force says, m/s², and the first speed
# from none, m/s; against errors of the VO's positions, m.
_GRAVITY_SIGMA, _SPEED_SIGMA, _POSITION_SIGMA = 1.0, 100.0, 0.1
_GRAVITY = 9.81


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Paths:
    """Inertial increments from the first image of each pair to N instants, the last at its second image.

    Attributes:
        turned: (B, S, N, 3) rad, rotation vector.
        speed: (B, S, N, 3) m/s and shift: (B, S, N, 3) m, in the body at the first image, gravity not applied.
    """

    turned: Array
    speed: Array
    shift: Array

    def at(self, index: np.ndarray) -> Self:
        """Of the pairs (A, M) by number: (B·A, M, N, 3)."""
        return type(self)(**{each.name: flat(getattr(self, each.name)[:, index]) for each in fields(self)})


def sample_paths(imu: Array, time_s: Array, mask: Mask, duration_s: Array, poses: int) -> Paths:
    """Integrate samples (B, S, K, 6) of any rate and read off ``poses`` instants; zero where there are none.

    Args:
        imu: gyro rad/s, specific force m/s².
        time_s: (B, S, K) since the pair's first image.
        mask: (B, S, K).
        duration_s: (B, S) of the pairs.
        poses: N.
    """
    if imu.shape[2] < 2:
        nothing = np.zeros((*imu.shape[:2], poses, 3))
        return Paths(turned=nothing, speed=nothing, shift=nothing)
    steps = integrated(imu, time_s, mask)
    speed = np.cumsum(steps.gains, axis=-2)
    shift = np.cumsum((speed - 0.5 * steps.gains) * steps.lengths_s[..., None], axis=-2)
    known = np.concatenate([steps.turned, speed, shift], axis=-1)
    known = np.concatenate([np.zeros_like(known[..., :1, :]), known], axis=-2)
    wanted = duration_s[..., None] * (np.arange(1, poses + 1) / poses)
    # Padding lies behind everything.
    places = np.where(mask, time_s, np.inf)
    after = (places[..., None, :] < wanted[..., None]).sum(axis=-1)
    after = np.clip(after, 1, np.maximum(mask.sum(axis=-1, keepdims=True) - 1, 1))
    begin, end = np.take_along_axis(time_s, after - 1, axis=2), np.take_along_axis(time_s, after, axis=2)
    part = np.clip((wanted - begin) / np.maximum(end - begin, 1e-9), 0.0, 1.0)[..., None]
    low = np.take_along_axis(known, (after - 1)[..., None], axis=2)
    high = np.take_along_axis(known, after[..., None], axis=2)
    found = (low + part * (high - low)) * (steps.lengths_s.sum(axis=-1) > 0.0)[..., None, None]
    return Paths(turned=found[..., :3], speed=found[..., 3:6], shift=found[..., 6:])


def joined_paths(parts: Sequence[Paths]) -> Paths:
    """Paths put in a row."""
    names = [each.name for each in fields(Paths)]
    return Paths(**{name: np.concatenate([getattr(part, name) for part in parts], axis=1) for name in names})


def filled(pairs: Pairs) -> tuple[Array, Array]:
    """Rotations (B, S, 3, 3) and shifts (B, S, 3) of the body by the VO; where it is silent, by gyro and last speed."""
    R = np.where(pairs.visual[..., None, None], pairs.R_visual, pairs.R_body)
    return R, held_shifts(pairs, pairs.t_body)


def visual_poses(pairs: Pairs) -> Array:
    """Poses (B, S + 1, 4, 4) of the body since the first, by the VO alone."""
    T = se3.from_parts(*_chained(*filled(pairs)))
    return np.concatenate([np.broadcast_to(np.eye(4), T[:, :1].shape), T], axis=1)


def window_stack(pairs: Pairs, paths: Paths, present: Mask) -> tuple[Array, Array]:
    """Attitudes (W, M, N + 1, 3, 3) and positions (W, M, N + 1, 3) since the window's start: the VO's, then the others.

    Args:
        pairs: of W windows of M pairs.
        paths: the same windows.
        present: (W, M); pairs before the beginning of the recording are not.
    """
    pairs = pairs.without(~present, ~present)
    R_step, t_step = filled(pairs)
    seconds = pairs.duration_s * present
    R_visual, p_visual = _chained(R_step, t_step * present[..., None])

    heard = (pairs.inertial & present)[..., None, None]
    share = np.arange(1, paths.turned.shape[2] + 1) / paths.turned.shape[2]
    # Without samples the body turns as the VO says, evenly.
    turns = np.where(heard, paths.turned, share[:, None] * so3.log(R_step)[..., None, :])
    R_start = _before(attitudes(so3.exp(turns[..., -1, :])))[..., None, :, :]
    gained, shifted = turned(R_start, paths.speed * heard), turned(R_start, paths.shift * heard)
    inside = seconds[..., None] * share
    own = heard[..., 0]

    speed = _sum_before(gained[..., -1, :])
    place = _sum_before(speed * seconds[..., None] + shifted[..., -1, :])
    s = place[..., None, :] + speed[..., None, :] * inside[..., None] + shifted
    covered = _sum_before(seconds * own[..., 0])
    doubled = _sum_before(covered * seconds + 0.5 * seconds**2 * own[..., 0])
    A = doubled[..., None] + covered[..., None] * inside + 0.5 * inside**2 * own
    t = _sum_before(seconds)[..., None] + inside
    push = speed[:, -1] + gained[:, -1, -1]
    v0, g0 = _fit(t[..., -1], A[..., -1], p_visual - s[..., -1, :], present, push)
    p_inertial = t[..., None] * v0[:, None, None] + A[..., None] * g0[:, None, None] + s
    R = np.concatenate([R_visual[..., None, :, :], R_start @ so3.exp(turns)], axis=2)
    return R, np.concatenate([p_visual[..., None, :], p_inertial], axis=2)


def carried(T: Array, R: Array, p: Array) -> tuple[Array, Array]:
    """Stacks (W, M, N + 1, …) seen from where the start has the poses (W, 4, 4)."""
    turn, shift = T[:, None, None, :3, :3], T[:, None, None, :3, 3]
    return turn @ R, turned(turn, p) + shift


def flat(values: np.ndarray) -> np.ndarray:
    """(B, A, …) as (B·A, …)."""
    return values.reshape(-1, *values.shape[2:])


def _fit(t: Array, A: Array, wanted: Array, present: Mask, push: Array) -> tuple[Array, Array]:
    """First speed and gravity (W, 3): least squares with weak knowledge of both beforehand."""
    usual = -_GRAVITY * push / np.maximum(np.linalg.norm(push, axis=-1, keepdims=True), 1e-6)
    there = present / _POSITION_SIGMA**2
    a = (there * t * t).sum(axis=1) + _SPEED_SIGMA**-2
    b = (there * t * A).sum(axis=1)
    c = (there * A * A).sum(axis=1) + _GRAVITY_SIGMA**-2
    x = ((there * t)[..., None] * wanted).sum(axis=1)
    y = ((there * A)[..., None] * wanted).sum(axis=1) + usual * _GRAVITY_SIGMA**-2
    a, b, c = a[:, None], b[:, None], c[:, None]
    determinant = a * c - b * b
    return (c * x - b * y) / determinant, (a * y - b * x) / determinant


def _chained(R_prev_cur: Array, t_prev_cur: Array) -> tuple[Array, Array]:
    """Attitudes (B, S, 3, 3) and positions (B, S, 3) after each of S motions in a row, from the identity."""
    R = attitudes(R_prev_cur)
    return R, np.cumsum(turned(_before(R), t_prev_cur), axis=1)


def _before(R: Array) -> Array:
    """(B, S, 3, 3) moved on by one, the identity first."""
    return np.concatenate([np.broadcast_to(np.eye(3), R[:, :1].shape), R[:, :-1]], axis=1)


def _sum_before(values: Array) -> Array:
    """Sums of what comes before each along the second axis."""
    total: Array = np.cumsum(values, axis=1) - values
    return total
