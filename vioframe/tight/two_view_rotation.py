"""Rotations between pairs of images from their points alone, all pairs at once.

Points x in the second camera are seen from the first along b with ``t · (b₁ × R b₂) = 0``. For a given R the
best direction t is the eigenvector of the smallest eigenvalue of Σ n nᵀ, n = b₁ × R b₂ (Kneip and Lynen,
"Direct optimization of frame-to-frame rotation", ICCV 2013), so that R alone is searched, by Gauss–Newton on

    e = u · R b₂ / ‖(t × b₁, t × R b₂)‖,  u = t × b₁,  ∂e/∂θ = −(Rᵀu × b₂)   (R ← R Exp(θ))

with t eliminated. Unlike an essential matrix, R stays determined where the camera only turns.
"""

from dataclasses import dataclass

import numpy as np

from vioframe.checks import Array, Mask
from vioframe.geometry import so3

# Factors on sigma, one an iteration: from afar no point is an outlier, from near by some are.
_LOOSENESS = (16.0, 8.0, 4.0, 2.0, 1.0, 1.0, 1.0, 1.0)
# A residual of this many sigmas counts half, as by Cauchy's loss; tracks that jumped count nothing.
_CAUCHY = 2.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TwoViewRotations:
    """Rotations of P pairs of images.

    Attributes:
        R: (P, 3, 3), coordinates of the second camera into the first.
        information: (P, 3, 3), 1/rad², of a local error (R_true = R Exp(θ)).
        points: (P,) number of points in common.
        residual: (P,) rms of the angular residuals in sigmas, robustly weighted.
    """

    R: Array
    information: Array
    points: Array
    residual: Array


def relative_rotations(
    first: Array, second: Array, common: Mask, starts: tuple[Array, ...], sigma: float
) -> TwoViewRotations:
    """Best rotation of each pair, from whichever of the starts fits better.

    Args:
        first: (P, M, 3) unit vectors in the first camera of each pair.
        second: (P, M, 3) the same points in the second.
        common: (P, M) which points both see.
        starts: rotations (P, 3, 3) to search from; the first may be far off, others are taken for close.
        sigma: rad, of a bearing.
    """
    pairs = len(first)
    count = len(starts)
    weight = np.tile(common.astype(float), (count, 1))
    b1, b2 = np.tile(first, (count, 1, 1)), np.tile(second, (count, 1, 1))
    R = np.concatenate(starts)
    trust = weight
    near = (np.arange(len(R)) >= pairs)[:, None]
    for looseness in _LOOSENESS:
        loose = np.where(near, min(looseness, 2.0), looseness) * sigma
        equations = normal_equations(R, b1, b2, weight, loose, trust)
        trust = equations.trust
        step = np.linalg.solve(equations.H + 1e-6 * np.eye(3), equations.gradient[..., None])[..., 0]
        R = R @ so3.exp(-step)
    equations = normal_equations(R, b1, b2, weight, sigma, trust)
    cost, squares, H = equations.cost, equations.squares, equations.H
    best = np.argmin(cost.reshape(count, pairs), axis=0) * pairs + np.arange(pairs)
    points = common.sum(axis=1)
    return TwoViewRotations(
        R=R[best], information=H[best], points=points, residual=np.sqrt(squares[best] / np.maximum(points - 5, 1))
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EpipolarEquations:
    """Gauss–Newton's equations of P rotations, with the directions of the translations eliminated.

    Attributes:
        H: (P, 3, 3) and gradient: (P, 3).
        cost: (P,) robust cost; squares: (P,) robustly weighted squares.
        trust: (P, M) weights of the points after this evaluation, for the next.
    """

    H: Array
    gradient: Array
    cost: Array
    squares: Array
    trust: Array


def normal_equations(
    R: Array, b1: Array, b2: Array, weight: Array, sigma: Array | float, trust: Array
) -> EpipolarEquations:
    """Linearise at rotations R (P, 3, 3).

    Args:
        R: second camera into the first.
        b1: (P, M, 3) unit vectors in the first camera; b2: in the second.
        weight: (P, M), 0 where a point is not seen in both.
        sigma: rad, of a bearing, one for all or (P, 1).
        trust: (P, M) weights of the last evaluation, by which the directions are found; ``weight`` at first.
    """
    Rb2 = b2 @ R.swapaxes(-1, -2)
    n = np.cross(b1, Rb2)
    _, vectors = np.linalg.eigh((n * trust[..., None]).swapaxes(-1, -2) @ n)
    t, sideways = vectors[..., 0], vectors[..., 1:]
    u = np.cross(t[:, None], b1)
    length = np.sqrt((u**2).sum(-1) + (np.cross(t[:, None], Rb2) ** 2).sum(-1)) + 1e-9
    e = (n @ t[..., None])[..., 0] / (length * sigma)
    robust = weight / (1.0 + (e / _CAUCHY) ** 2)
    J_theta = -np.cross(u @ R, b2) / (length * sigma)[..., None]
    J_t = n @ sideways / (length * sigma)[..., None]
    J = np.concatenate([J_theta, J_t], axis=-1)
    weighted = (J * robust[..., None]).swapaxes(-1, -2)
    full = weighted @ J
    gradient = (weighted @ e[..., None])[..., 0]
    H_tt = full[:, 3:, 3:] + 1e-6 * np.eye(2)
    gain = full[:, :3, 3:] @ np.linalg.inv(H_tt)
    H = full[:, :3, :3] - gain @ full[:, 3:, :3]
    gradient = gradient[:, :3] - (gain @ gradient[:, 3:, None])[..., 0]
    cost = (weight * np.log1p((e / _CAUCHY) ** 2)).sum(axis=1)
    return EpipolarEquations(H=H, gradient=gradient, cost=cost, squares=(robust * e**2).sum(axis=1), trust=robust)
