"""Inertial increments of whole batches of windows, and the covariance that the filter gives them.

The formulas are those of Forster et al., "On-Manifold Preintegration", IEEE T-RO 33(1), 2017, with the mean of the
samples at both ends of a step, as ``integrator=preintegration`` has them; here over leading axes.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from vioframe.learning.motion import exp_so3, right_jacobian
from vioframe_ekf.net.robocentric import apply, hat

# Covariance of (∫n, ∬n, ∭n) of white noise over T seconds: T^power / divisor.
_POWERS = torch.tensor([[1.0, 2.0, 3.0], [2.0, 3.0, 4.0], [3.0, 4.0, 5.0]], dtype=torch.float64)
_DIVISORS = torch.tensor([[1.0, 2.0, 6.0], [2.0, 3.0, 8.0], [6.0, 8.0, 20.0]], dtype=torch.float64)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Preintegrated:
    """Increments over pairs of images, at no bias; fields as of :class:`vioframe.types.InertialDelta`.

    Attributes:
        R: (..., 3, 3), v and p: (..., 3), jacobian: (..., 9, 6).
        gap_s: (...) longest time between two samples.
        there: (...) bool, False for a pair without samples, whose increment is none.
    """

    R: Tensor
    v: Tensor
    p: Tensor
    jacobian: Tensor
    gap_s: Tensor
    there: Tensor


def preintegrate(imu: Tensor, time_s: Tensor, mask: Tensor) -> Preintegrated:
    """Integrate the samples of each pair; nothing here is learned, so no gradient is kept.

    Args:
        imu: (..., N, 6) gyro and specific force.
        time_s: (..., N) since the first image of the pair.
        mask: (..., N) True for a sample; padding follows the samples.
    """
    with torch.no_grad():
        samples, times = imu.double(), time_s.double()
        lead = samples.shape[:-2]
        there = mask.sum(-1) >= 2
        if samples.shape[-2] < 2:
            samples, times = samples.new_zeros(*lead, 2, 6), samples.new_zeros(*lead, 2)
            both = torch.zeros(*lead, 1, dtype=torch.bool, device=imu.device)
        else:
            both = mask[..., 1:] & mask[..., :-1]
        # A step into padding takes no time, and so leaves everything as it is.
        steps = torch.where(both, times[..., 1:] - times[..., :-1], torch.zeros_like(times[..., 1:]))
        ends = steps.cumsum(-1)
        gyro, accel = samples[..., :3], samples[..., 3:]
        angles = 0.5 * (gyro[..., :-1, :] + gyro[..., 1:, :]) * steps[..., None]
        turns = exp_so3(angles)
        spread = right_jacobian(angles) * steps[..., None, None]
        rotations = [torch.eye(3, dtype=samples.dtype, device=samples.device).expand(*lead, 3, 3)]
        for turn in turns.unbind(-3):
            rotations.append(rotations[-1] @ turn)
        R = torch.stack(rotations, dim=-3)
        forces = apply(R, accel)
        mean_forces = 0.5 * (forces[..., :-1, :] + forces[..., 1:, :])
        remaining = ends[..., -1:] - ends + 0.5 * steps
        v = (mean_forces * steps[..., None]).sum(-2)
        p = (mean_forces * (steps * remaining)[..., None]).sum(-2)
        # How much the force at each sample counts in v and in p.
        weights = torch.zeros(*lead, 2, samples.shape[-2], dtype=samples.dtype, device=samples.device)
        halves = 0.5 * torch.stack([steps, steps * remaining], dim=-2)
        weights[..., :-1] += halves
        weights[..., 1:] += halves
        turned = torch.zeros_like(R)
        turned[..., 1:, :, :] = (R[..., 1:, :, :] @ spread).cumsum(-3)
        jacobian = torch.zeros(*lead, 9, 6, dtype=samples.dtype, device=samples.device)
        jacobian[..., :3, :3] = -R[..., -1, :, :].transpose(-1, -2) @ turned[..., -1, :, :]
        by_gyro = weights @ (hat(forces) @ turned).flatten(-2)
        by_accel = weights @ R.flatten(-2)
        jacobian[..., 3:, :3] = by_gyro.reshape(*lead, 6, 3)
        jacobian[..., 3:, 3:] = -by_accel.reshape(*lead, 6, 3)
        return Preintegrated(R=R[..., -1, :, :], v=v, p=p, jacobian=jacobian, gap_s=steps.amax(-1), there=there)


def increment_covariance(R: Tensor, v: Tensor, duration_s: Tensor, densities: Tensor) -> Tensor:
    """Covariance (..., 9, 9), order (R, v, p), of increments under white noise of the samples.

    In closed form for a specific force that is constant over the window, v/T: it asks for no sample, so that one
    learned density means the same in training and in a stream, whoever integrated.

    Args:
        R: (..., 3, 3); v: (..., 3); duration_s: (...), above 0.
        densities: (2,) of gyro rad/s/√Hz and accelerometer m/s²/√Hz.
    """
    T = duration_s[..., None, None]
    shared = T ** _POWERS.to(v) / _DIVISORS.to(v)
    # Noise of the gyro turns the force: δv = −[f] ∫θ, δp = −[f] ∬θ; θ is told in the body at the end.
    lever = -hat(v / duration_s[..., None])
    blocks = torch.stack([R.transpose(-1, -2), lever, lever], dim=-3)
    eye = torch.eye(3, dtype=v.dtype, device=v.device)
    turning = shared[..., :, None, :, None] * torch.einsum("...iab,...jcb->...iajc", blocks, blocks)
    pushing = torch.zeros_like(shared)
    pushing[..., 1:, 1:] = shared[..., :2, :2]
    force = pushing[..., :, None, :, None] * eye[:, None, :]
    both = densities[0].square() * turning + densities[1].square() * force
    return both.flatten(-2).flatten(-3, -2)


def gap_covariance(gap_s: Tensor, duration_s: Tensor, rate_sigma: float, accel_sigma: float) -> Tensor:
    """What a hole in the samples adds, (..., 9, 9); the formula of :func:`vioframe.increments.add_gap`."""
    gap = torch.minimum(gap_s, duration_s)
    velocity, position = accel_sigma * gap, 0.5 * accel_sigma * gap * duration_s
    turn = (rate_sigma * gap).square()
    zero = torch.zeros_like(turn)
    rows = [
        torch.stack([turn, zero, zero], dim=-1),
        torch.stack([zero, velocity.square(), velocity * position], dim=-1),
        torch.stack([zero, velocity * position, position.square() * (4.0 / 3.0)], dim=-1),
    ]
    shared = torch.stack(rows, dim=-2)
    eye = torch.eye(3, dtype=shared.dtype, device=shared.device)
    return (shared[..., :, None, :, None] * eye[:, None, :]).flatten(-2).flatten(-3, -2)
