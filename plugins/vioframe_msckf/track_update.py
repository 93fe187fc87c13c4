"""The constraint that a track sets on the clones that saw it, without its point in the state.

A point f seen from clone j with Jacobian F_j (by f, over all rows at that clone, of unit noise) has, by the clone's
error ξ = (φ, ρ), the Jacobian ``F_j A`` with ``A = [hat(f), −I]``, the same for all clones. With
``W_j = F_jᵀ F_j``, ``b_j = F_jᵀ r_j`` and ``G = (Σ W_j)⁻¹``, projecting the rows onto the left null space of F
(by ``I − F G Fᵀ``; Mourikis & Roumeliotis, ICRA 2007, project by a basis) gives the information

    Λ_jl = Aᵀ (δ_jl W_j − W_j G W_l) A,      η_j = Aᵀ (b_j − W_j G Σ b).

So a track costs 3 × 3 blocks only, however many rows it has.
"""

from dataclasses import dataclass

import numpy as np

from vioframe.checks import Array, Mask
from vioframe.geometry import so3

# Added to the points' information, relative to it, so that it has an inverse.
_RIDGE = 1e-12


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Linearised:
    """Tracks linearised at their points: N tracks, C cameras, M clones.

    Attributes:
        found: (N, 3) m, the points.
        F: (N, C, M, 2, 3), residuals' Jacobian by the point; zero where unseen.
        residual: (N, C, M, 2), of unit noise.
        W: (N, M, 3, 3), b: (N, M, 3) and G: (N, 3, 3) as above.
        A: (N, 3, 6).
        rows: (N,) how many residuals each has.
    """

    found: Array
    F: Array
    residual: Array
    W: Array
    b: Array
    G: Array
    A: Array
    rows: Array

    def pick(self, wanted: Mask) -> "Linearised":
        """Some of the tracks."""
        return Linearised(
            found=self.found[wanted],
            F=self.F[wanted],
            residual=self.residual[wanted],
            W=self.W[wanted],
            b=self.b[wanted],
            G=self.G[wanted],
            A=self.A[wanted],
            rows=self.rows[wanted],
        )

    @property
    def squares(self) -> Array:
        """Squared length (N,) of the projected residuals: no χ² of theirs can be larger."""
        total = self.b.sum(axis=1)
        explained = (total * (self.G @ total[..., None])[..., 0]).sum(axis=-1)
        squares: Array = (self.residual**2).sum(axis=(1, 2, 3)) - explained
        return squares


def point_jacobian(R: Array, p: Array, found: Array) -> tuple[Array, Array]:
    """Projection (..., 2) of points (..., 3) on the normalised planes of cameras and its Jacobian (..., 2, 3).

    Args:
        R: (..., 3, 3) of the cameras, into the world.
        p: (..., 3) m.
        found: (..., 3) m, in front of the cameras.
    """
    X = ((found - p)[..., None, :] @ R)[..., 0, :]
    inverse = 1.0 / X[..., 2]
    uv = X[..., :2] * inverse[..., None]
    Rt = np.swapaxes(R, -1, -2)
    return uv, inverse[..., None, None] * (Rt[..., :2, :] - uv[..., None] * Rt[..., 2:, :])


def linearise(R: Array, p: Array, found: Array, points: Array, weights: Array) -> Linearised:
    """Linearise tracks at their points.

    Args:
        R: (C, M, 3, 3) of every camera at every clone, into the world.
        p: (C, M, 3) m.
        found: (N, 3) m.
        points: (N, C, M, 2) on the normalised plane.
        weights: (N, C, M) 1/σ, zero where unseen.
    """
    X = ((found[:, None, None] - p)[..., None, :] @ R)[..., 0, :]
    seen = weights > 0.0
    inverse = np.where(seen, 1.0, 0.0) / np.where(seen, X[..., 2], 1.0)
    uv = X[..., :2] * inverse[..., None]
    Rt = np.swapaxes(R, -1, -2)
    F = (weights * inverse)[..., None, None] * (Rt[..., :2, :] - uv[..., None] * Rt[..., 2:, :])
    residual = weights[..., None] * (points - uv) * seen[..., None]
    # Rows of both cameras at one clone side by side: (N, M, 2C, 3).
    count, _, clones = weights.shape
    stacked = F.transpose(0, 2, 1, 3, 4).reshape(count, clones, -1, 3)
    flat = residual.transpose(0, 2, 1, 3).reshape(count, clones, -1)
    W = (stacked[..., :, None] * stacked[..., None, :]).sum(axis=2)
    b = (stacked * flat[..., None]).sum(axis=2)
    total = W.sum(axis=1)
    # Rays without any parallax have no depth; its uncertainty then tells so.
    total[:, (0, 1, 2), (0, 1, 2)] += _RIDGE * np.trace(total, axis1=1, axis2=2)[:, None]
    G = np.linalg.inv(total)
    A = np.concatenate([so3.hat(found), np.broadcast_to(-np.eye(3), (count, 3, 3))], axis=-1)
    return Linearised(
        found=found,
        F=F,
        residual=residual,
        W=W,
        b=b,
        G=0.5 * (G + G.transpose(0, 2, 1)),
        A=A,
        rows=2.0 * seen.sum(axis=(1, 2)),
    )


def information(tracks: Linearised) -> tuple[Array, Array]:
    """Λ (6M, 6M) and η (6M,) of all tracks together."""
    count, clones = tracks.b.shape[:2]
    At = tracks.A.transpose(0, 2, 1)
    # U (N, M, 6, 3): Aᵀ W_j.
    U = (At @ tracks.W.transpose(0, 2, 1, 3).reshape(count, 3, -1)).reshape(count, 6, clones, 3).transpose(0, 2, 1, 3)
    root = np.linalg.cholesky(tracks.G)
    V = (U.reshape(count, -1, 3) @ root).transpose(1, 0, 2).reshape(6 * clones, -1)
    out = -(V @ V.T)
    diagonal = U.transpose(1, 2, 0, 3).reshape(clones, 6, -1) @ tracks.A.reshape(-1, 6)
    for j in range(clones):
        block = slice(6 * j, 6 * j + 6)
        out[block, block] += diagonal[j]
    moved = tracks.G @ tracks.b.sum(axis=1)[..., None]
    own = (tracks.b @ tracks.A).sum(axis=0).reshape(-1)
    right = own - (U.reshape(count, -1, 3) @ moved)[..., 0].sum(axis=0)
    return out, right


def chi_squares(tracks: Linearised, P_cc: Array) -> Array:
    """χ² (N,) of each track's projected residuals, 2K − 3 of them independent, given the clones' covariance.

    With Π the projector, ``(Π r)ᵀ (Π H P Hᵀ Π + I)⁻¹ Π r``.
    """
    count, _, clones = tracks.residual.shape[:3]
    by_clone = tracks.F.transpose(0, 2, 1, 3, 4).reshape(count, clones, -1, 3)
    high = by_clone.shape[2]
    blocks = np.zeros((count, clones, high, clones, 6))
    each = np.arange(clones)
    blocks[:, each, :, each] = (by_clone @ tracks.A[:, None]).transpose(1, 0, 2, 3)
    H: Array = blocks.reshape(count, clones * high, 6 * clones)
    F = by_clone.reshape(count, -1, 3)
    r = tracks.residual.transpose(0, 2, 1, 3).reshape(count, -1, 1)
    GFt = tracks.G @ F.transpose(0, 2, 1)
    H = H - F @ (GFt @ H)
    r = r - F @ (GFt @ r)
    S = H @ P_cc @ H.transpose(0, 2, 1)
    S[:, np.arange(S.shape[1]), np.arange(S.shape[1])] += 1.0
    out: Array = (r * np.linalg.solve(S, r)).sum(axis=(1, 2))
    return out


def point_errors(tracks: Linearised) -> Array:
    """Jacobian (N, 3, 6M) of the points' errors by those of the clones: ``−G Σ W_j A ξ_j``; their noise is G."""
    count, clones = tracks.b.shape[:2]
    GW = tracks.G @ tracks.W.transpose(0, 2, 1, 3).reshape(count, 3, -1)
    by_clone = (GW.reshape(count, 3 * clones, 3) @ tracks.A).reshape(count, 3, -1)
    out: Array = -by_clone
    return out
