"""Rigid motions as 4×4 matrices, batched over leading axes; tangent order (rotation, translation).

Formulas: Solà et al. 2018, appendix D; Barfoot, "State Estimation for Robotics", 2017, section 7.1.
"""

import numpy as np

from vioframe.checks import Array
from vioframe.geometry import so3


def from_parts(R: Array, p: Array) -> Array:
    """T (..., 4, 4) with rotation (..., 3, 3) and translation (..., 3)."""
    shape = np.broadcast_shapes(R.shape[:-2], p.shape[:-1])
    T = np.zeros((*shape, 4, 4))
    T[..., :3, :3] = R
    T[..., :3, 3] = p
    T[..., 3, 3] = 1.0
    return T


def inverse(T: Array) -> Array:
    """T_b_a (..., 4, 4) of T_a_b."""
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)
    return from_parts(Rt, -(Rt @ T[..., :3, 3:])[..., 0])


def exp(xi: Array) -> Array:
    """Motion (..., 4, 4) of a tangent (..., 6), ordered (rotation rad, translation m)."""
    phi, rho = xi[..., :3], xi[..., 3:]
    return from_parts(so3.exp(phi), (so3.left_jacobian(phi) @ rho[..., None])[..., 0])


def log(T: Array) -> Array:
    """Tangent (..., 6) of motions (..., 4, 4), ordered (rotation rad, translation m)."""
    phi = so3.log(T[..., :3, :3])
    rho = (so3.left_jacobian_inverse(phi) @ T[..., :3, 3:])[..., 0]
    return np.concatenate([phi, rho], axis=-1)


def adjoint(T: Array) -> Array:
    """Ad (..., 6, 6): ``T Exp(ξ) T⁻¹ = Exp(Ad ξ)``, tangent order (rotation, translation)."""
    R = T[..., :3, :3]
    out = np.zeros((*T.shape[:-2], 6, 6))
    out[..., :3, :3] = R
    out[..., 3:, 3:] = R
    out[..., 3:, :3] = so3.hat(T[..., :3, 3]) @ R
    return out


def transform(T: Array, points: Array) -> Array:
    """Points (..., N, 3) of frame b in frame a, by T_a_b (..., 4, 4)."""
    return points @ np.swapaxes(T[..., :3, :3], -1, -2) + T[..., None, :3, 3]
