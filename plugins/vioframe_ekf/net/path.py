"""The filter over windows of a batch: from measured motions to poses, with gradients through every step."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from vioframe.checks import Array
from vioframe.inertial import level
from vioframe_ekf.net.increments import Preintegrated, gap_covariance, increment_covariance
from vioframe_ekf.net.robocentric import (
    AT_IMAGE,
    BIAS,
    GRAVITY,
    VELOCITY,
    WORLD,
    Increment,
    State,
    apply,
    correct,
    hat,
    innovate,
    motion_residual,
    motion_rows,
    passing,
    propagate,
    settle,
    turn,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class StartSigmas:
    """Of a state that is given: :class:`vioframe.fusion_options.StartOptions`, with two of biases that may be learned.

    Attributes:
        tilt, yaw, position, velocity: as there.
        gravity: m/s², of its size.
        biases: (2,) rad/s of the gyro and m/s² of the accelerometer.
    """

    tilt: float
    yaw: float
    position: float
    velocity: float
    gravity: float
    biases: Tensor


@dataclass(frozen=True, slots=True, kw_only=True)
class Holes:
    """What is assumed where samples are missing: fields of :class:`vioframe.fusion_options.InertialOptions`."""

    allowed_s: float
    rate_sigma: float
    accel_sigma: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Path:
    """What the filter made of S pairs.

    Attributes:
        states: S + 1, the first the one given.
        chi_square: (B, S) of the motions measured.
        used: (B, S) bool, whether they were.
    """

    states: Sequence[State]
    chi_square: Tensor
    used: Tensor

    def poses(self) -> Tensor:
        """T_world_body (B, S + 1, 4, 4)."""
        R = torch.stack([state.R for state in self.states], dim=1)
        p = torch.stack([state.p for state in self.states], dim=1)
        bottom = torch.zeros_like(R[..., :1, :])
        corner = torch.ones_like(bottom[..., :1])
        return torch.cat([torch.cat([R, p[..., None]], dim=-1), torch.cat([bottom, corner], dim=-1)], dim=-2)

    def pose_covariances(self) -> Tensor:
        """(B, S, 6, 6) of ζ after each pair."""
        return torch.stack([state.covariance[:, WORLD, WORLD] for state in self.states[1:]], dim=1)


def from_nav_errors(R: Tensor, p: Tensor, v: Tensor, gravity: Tensor) -> Tensor:
    """Errors of a ``NavState`` (θ local, p and v in the world, biases) into those at an image: (B, 18, 15).

    Args:
        R: (B, 3, 3) R_world_body; p: (B, 3) in the world; v and gravity: (B, 3) in the body.
    """
    into = R.new_zeros(len(R), AT_IMAGE, 15)
    into[:, 0:3, 0:3] = R
    into[:, 3:6, 0:3] = hat(p) @ R
    into[:, 3:6, 3:6] = torch.eye(3, dtype=R.dtype, device=R.device)
    into[:, GRAVITY, 0:3] = hat(gravity)
    into[:, VELOCITY, 0:3] = hat(v)
    into[:, VELOCITY, 6:9] = R.transpose(-1, -2)
    into[:, BIAS, 9:15] = torch.eye(6, dtype=R.dtype, device=R.device)
    return into


def to_nav_errors(R: Tensor, p: Tensor, v: Tensor) -> Tensor:
    """Errors at an image into those of a ``NavState``: (B, 15, 18); arguments as of :func:`from_nav_errors`."""
    into = R.new_zeros(len(R), 15, AT_IMAGE)
    into[:, 0:3, 0:3] = R.transpose(-1, -2)
    into[:, 3:6, 0:3] = -hat(p)
    into[:, 3:6, 3:6] = torch.eye(3, dtype=R.dtype, device=R.device)
    into[:, 6:9, 0:3] = -hat(apply(R, v))
    into[:, 6:9, VELOCITY] = R
    into[:, 9:15, BIAS] = torch.eye(6, dtype=R.dtype, device=R.device)
    return into


def state_of(R: Tensor, p: Tensor, v: Tensor, gravity: Tensor, bias: Tensor, nav: Tensor, size_sigma: float) -> State:
    """A state from the covariance (B, 15, 15) of a ``NavState``.

    Args:
        R: (B, 3, 3) R_world_body; p: (B, 3) in the world; v and gravity: (B, 3) in the body.
        bias: (B, 6).
        nav: see above.
        size_sigma: of the magnitude of gravity, m/s².
    """
    into = from_nav_errors(R, p, v, gravity)
    along = gravity.new_zeros(len(gravity), AT_IMAGE)
    along[:, GRAVITY] = gravity / gravity.norm(dim=-1, keepdim=True) * size_sigma
    covariance = into @ nav @ into.transpose(-1, -2) + along[:, :, None] * along[:, None, :]
    return State(
        R=R, p=p, gravity=gravity, v=v, bias=bias, covariance=0.5 * (covariance + covariance.transpose(-1, -2))
    )


def given_state(v: Tensor, gravity: Tensor, sigmas: StartSigmas) -> State:
    """The state at a window's beginning, from velocity and gravity (B, 3) in the body; heading and place are any."""
    R = torch.from_numpy(_levels(gravity)).to(gravity)
    B, eye = len(R), torch.eye(3, dtype=R.dtype, device=R.device)
    up = R[:, 2]
    nav = R.new_zeros(B, 15, 15)
    nav[:, 0:3, 0:3] = sigmas.tilt**2 * eye + (sigmas.yaw**2 - sigmas.tilt**2) * up[:, :, None] * up[:, None, :]
    nav[:, 3:6, 3:6], nav[:, 6:9, 6:9] = sigmas.position**2 * eye, sigmas.velocity**2 * eye
    nav[:, 9:12, 9:12] = sigmas.biases[0].square() * eye
    nav[:, 12:15, 12:15] = sigmas.biases[1].square() * eye
    return state_of(R, torch.zeros_like(v), v, gravity, v.new_zeros(B, 6), nav, sigmas.gravity)


def _levels(gravity: Tensor) -> Array:
    """R_world_body (B, 3, 3) of any heading."""
    return np.stack([level(-each) for each in gravity.detach().cpu().numpy()])


def misplaced(state: State, draw: Tensor) -> State:
    """A state whose pose, velocity and gravity are wrong by a draw from their covariance, as they are in use.

    The biases stay: what they are in the recordings is what their sigmas are learned from.

    Args:
        state: the truth, with the covariance that the filter starts with.
        draw: (B, 12) standard normal.
    """
    # Gravity and tilt err together, so the covariance has no Cholesky factor.
    values, vectors = torch.linalg.eigh(state.covariance[:, :12, :12].detach())
    error = apply(vectors, values.clamp_min(0.0).sqrt() * draw)
    turned = turn(-error[:, 0:3])
    return replace(
        state,
        R=turned @ state.R,
        p=apply(turned, state.p - error[:, 3:6]),
        gravity=state.gravity - error[:, GRAVITY],
        v=state.v - error[:, VELOCITY],
    )


def follow(
    state: State,
    samples: Preintegrated,
    duration_s: Tensor,
    densities: Tensor,
    holes: Holes,
    motion: Tensor,
    noise: Tensor,
    valid: Tensor,
    gate: float,
) -> Path:
    """Run the filter over S pairs.

    Args:
        state: at the first image.
        samples: (B, S) increments.
        duration_s: (B, S).
        densities: (4,) of :class:`vioframe_ekf.net.noise.FilterNoise`.
        holes: in the samples.
        motion: (B, S, 4, 4) measured motion of the body, and noise: (B, S, 6, 6), of
            :func:`vioframe_ekf.net.robocentric.motion_noise`.
        valid: (B, S) bool.
        gate: largest χ² of a motion that is used.
    """
    covariance = increment_covariance(samples.R, samples.v, duration_s, densities[:2])
    # Where there is no sample, what was integrated is nothing, and known to nobody.
    covariance = covariance * samples.there[..., None, None]
    hole = torch.where(samples.gap_s > holes.allowed_s, samples.gap_s, torch.zeros_like(duration_s))
    gap = torch.where(samples.there, hole, duration_s)
    covariance = covariance + gap_covariance(gap, duration_s, holes.rate_sigma, holes.accel_sigma)
    transition, added = passing(duration_s, samples.jacobian, covariance, densities[2:].square().repeat_interleave(3))
    rows = motion_rows(motion)
    complete = bool(samples.there.all())
    down = torch.zeros_like(state.gravity)
    down[:, 2] = -state.gravity.norm(dim=-1)
    states, chi_squares, taken = [state], [], []
    for k in range(motion.shape[1]):
        v, p = samples.v[:, k], samples.p[:, k]
        if not complete:
            # Constant velocity: as if the samples had measured what holds the body up.
            T = duration_s[:, k, None]
            lift = -apply(states[-1].R.transpose(-1, -2), down) * T
            there = samples.there[:, k, None]
            v, p = torch.where(there, v, lift), torch.where(there, p, 0.5 * lift * T)
        increment = Increment(
            R=samples.R[:, k],
            v=v,
            p=p,
            duration_s=duration_s[:, k],
            jacobian=samples.jacobian[:, k],
            reference=torch.zeros_like(state.bias),
            transition=transition[:, k],
            noise=added[:, k],
        )
        moved = propagate(states[-1], increment)
        innovation = innovate(moved, rows, motion_residual(moved, motion[:, k]), noise[:, k])
        used = valid[:, k] & innovation.sound & (innovation.chi_square <= gate)
        states.append(settle(correct(moved, innovation, used)))
        chi_squares.append(innovation.chi_square)
        taken.append(used)
    return Path(states=states, chi_square=torch.stack(chi_squares, dim=1), used=torch.stack(taken, dim=1))
