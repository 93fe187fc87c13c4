"""The sequential cache of EE-LCVIO: for each image one pose of the VO and N poses of the inertial sensor.

The paper stacks absolute poses of both, those of the inertial sensor by equations without gravity, which leave the
road within a second. Here both begin at the window's start. The inertial positions need a speed to begin with and the
direction of gravity; both are fitted to the VO's positions of the window, with which everything is linear:

    p(t) = v₀ t + g₀ A(t) + s(t),     A = ∬ 1, s = ∬ R f   over the times with samples.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Self

import torch
from torch import Tensor

from vioframe.learning.motion import exp_so3, log_so3, product
from vioframe_lstm.net.likelihood import attitudes
from vioframe_lstm.net.pairs import Pairs, integrated

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

    turned: Tensor
    speed: Tensor
    shift: Tensor

    def at(self, index: Tensor) -> Self:
        """Of the pairs (A, M) by number: (B·A, M, N, 3)."""
        return type(self)(**{each.name: getattr(self, each.name)[:, index].flatten(0, 1) for each in fields(self)})


def sample_paths(imu: Tensor, time_s: Tensor, mask: Tensor, duration_s: Tensor, poses: int) -> Paths:
    """Integrate samples (B, S, K, 6) of any rate and read off ``poses`` instants; zero where there are none.

    Args:
        imu: gyro rad/s, specific force m/s².
        time_s: (B, S, K) since the pair's first image.
        mask: (B, S, K) bool.
        duration_s: (B, S) of the pairs.
        poses: N.
    """
    if imu.shape[2] < 2:
        nothing = imu.new_zeros(*imu.shape[:2], poses, 3)
        return Paths(turned=nothing, speed=nothing, shift=nothing)
    turned, gains, steps = integrated(imu, time_s, mask)
    speed = gains.cumsum(-2)
    shift = ((speed - 0.5 * gains) * steps[..., None]).cumsum(-2)
    known = torch.nn.functional.pad(torch.cat([turned, speed, shift], dim=-1), (0, 0, 1, 0))
    share = torch.arange(1, poses + 1, device=imu.device, dtype=imu.dtype) / poses
    wanted = duration_s[..., None] * share
    # Padding lies behind everything.
    places = torch.where(mask, time_s, torch.full_like(time_s, 1e9)).contiguous()
    after = torch.searchsorted(places, wanted.contiguous()).clamp(1, imu.shape[2] - 1)
    after = torch.minimum(after, (mask.sum(-1, keepdim=True) - 1).clamp_min(1))
    begin, end = time_s.gather(2, after - 1), time_s.gather(2, after)
    part = ((wanted - begin) / (end - begin).clamp_min(1e-9)).clamp(0.0, 1.0)[..., None]
    low = known.gather(2, (after - 1)[..., None].expand(*after.shape, 9))
    high = known.gather(2, after[..., None].expand(*after.shape, 9))
    there = (steps.sum(-1) > 0.0)[..., None, None]
    found = (low + part * (high - low)) * there
    return Paths(turned=found[..., :3], speed=found[..., 3:6], shift=found[..., 6:])


def joined_paths(parts: Sequence[Paths]) -> Paths:
    """Paths put in a row."""
    return Paths(
        **{each.name: torch.cat([getattr(part, each.name) for part in parts], dim=1) for each in fields(Paths)}
    )


def filled(pairs: Pairs) -> tuple[Tensor, Tensor]:
    """Rotations (B, S, 3, 3) and shifts (B, S, 3) of the body by the VO; where it is silent, by gyro and last speed."""
    there = pairs.visual[..., None]
    speed = pairs.t_body() / pairs.duration_s[..., None]
    number = torch.arange(len(pairs), device=speed.device).expand_as(pairs.visual)
    last = torch.where(pairs.visual, number, torch.zeros_like(number)).cummax(1).values
    held = speed.gather(1, last[..., None].expand_as(speed)) * pairs.duration_s[..., None]
    return torch.where(there[..., None], pairs.R_visual, pairs.R_body), held


def chained(R_prev_cur: Tensor, t_prev_cur: Tensor) -> tuple[Tensor, Tensor]:
    """Attitudes (B, S, 3, 3) and positions (B, S, 3) after each of S motions in a row, from the identity."""
    R = attitudes(R_prev_cur)
    return R, product(_before(R), t_prev_cur[..., None])[..., 0].cumsum(1)


def window_stack(pairs: Pairs, paths: Paths, present: Tensor) -> tuple[Tensor, Tensor]:
    """Attitudes (W, M, N + 1, 3, 3) and positions (W, M, N + 1, 3) since the window's start: the VO's, then the others.

    Args:
        pairs: of W windows of M pairs.
        paths: the same windows.
        present: (W, M) bool; pairs before the beginning of the recording are not.
    """
    pairs = pairs.without(~present, ~present)
    R_step, t_step = filled(pairs)
    seconds = pairs.duration_s * present
    t_step = t_step * present[..., None]
    R_visual, p_visual = chained(R_step, t_step)

    heard = (pairs.inertial & present)[..., None, None]
    poses = paths.turned.shape[2]
    share = torch.arange(1, poses + 1, device=seconds.device, dtype=seconds.dtype) / poses
    # Without samples the body turns as the VO says, evenly.
    turned = torch.where(heard, paths.turned, share[:, None] * log_so3(R_step)[..., None, :])
    R_inertial = attitudes(exp_so3(turned[..., -1, :]))
    R_start = _before(R_inertial)
    gained = product(R_start[..., None, :, :], (paths.speed * heard)[..., None])[..., 0]
    shifted = product(R_start[..., None, :, :], (paths.shift * heard)[..., None])[..., 0]
    inside = seconds[..., None] * share
    own = heard[..., 0]

    clock = _before_sum(seconds)
    speed = _before_sum(gained[..., -1, :])
    place = _before_sum(speed * seconds[..., None] + shifted[..., -1, :])
    s = place[..., None, :] + speed[..., None, :] * inside[..., None] + shifted
    weight_speed = _before_sum(seconds * own[..., 0])
    weight = _before_sum(weight_speed * seconds + 0.5 * seconds**2 * own[..., 0])
    A = weight[..., None] + weight_speed[..., None] * inside + 0.5 * inside**2 * own
    t = clock[..., None] + inside
    push = speed[:, -1] + gained[:, -1, -1]
    v0, g0 = _fit(t[..., -1], A[..., -1], p_visual - s[..., -1, :], present, push)
    p_inertial = t[..., None] * v0[:, None, None] + A[..., None] * g0[:, None, None] + s
    R_path = product(R_start[..., None, :, :], exp_so3(turned))
    R = torch.cat([R_visual[..., None, :, :], R_path], dim=2)
    return R, torch.cat([p_visual[..., None, :], p_inertial], dim=2)


def _fit(t: Tensor, A: Tensor, wanted: Tensor, present: Tensor, push: Tensor) -> tuple[Tensor, Tensor]:
    """First speed and gravity (W, 3): least squares with weak knowledge of both beforehand."""
    usual = -_GRAVITY * push / push.square().sum(-1, keepdim=True).sqrt().clamp_min(1e-6)
    there = present.to(t.dtype) / _POSITION_SIGMA**2
    a = (there * t * t).sum(1) + _SPEED_SIGMA**-2
    b = (there * t * A).sum(1)
    c = (there * A * A).sum(1) + _GRAVITY_SIGMA**-2
    x = (there[..., None] * t[..., None] * wanted).sum(1)
    y = (there[..., None] * A[..., None] * wanted).sum(1) + usual * _GRAVITY_SIGMA**-2
    determinant = (a * c - b * b)[:, None]
    return (c[:, None] * x - b[:, None] * y) / determinant, (a[:, None] * y - b[:, None] * x) / determinant


def _before(R: Tensor) -> Tensor:
    """(B, S, 3, 3) moved on by one, the identity first."""
    identity = torch.eye(3, dtype=R.dtype, device=R.device).expand_as(R[:, :1])
    return torch.cat([identity, R[:, :-1]], dim=1)


def _before_sum(values: Tensor) -> Tensor:
    """Sums of what comes before each along the second axis."""
    return values.cumsum(1) - values
