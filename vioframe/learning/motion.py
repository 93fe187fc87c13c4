"""Motions of six numbers, rigid motions, and their composition, all differentiable.

A motion vector is (rotation, translation): rotation as the SO(3) logarithm or as Euler angles, in rad; translation
as ``T_prev_cur[:3, 3]`` in the unit of the targets. The rotation block comes first, as in every tangent of the
house; the paper prints translation first.

Products are written as sums, not as ``@``: mixed precision would run a matrix product in half precision, and a
rotation of 0.01° does not survive that.

Formulas: Solà, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics", 2018, appendix B.
"""

from typing import Literal

import torch
from torch import Tensor

Rotation = Literal["log", "euler"]
"""How three numbers stand for a rotation: its logarithm, or (x, y, z) with ``R = Rz(z) Ry(y) Rx(x)``."""

# Below this squared angle the series are used. Seven terms at 0.5 rad leave less than 1e-16 out, and above it the
# closed forms lose less than two digits, so the same switch serves single and double precision.
_SERIES_BELOW = 0.25
_TERMS = 7


def hat(phi: Tensor) -> Tensor:
    """Skew matrix (..., 3, 3) of vectors (..., 3): ``hat(a) b = a × b``."""
    x, y, z = phi.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(*phi.shape[:-1], 3, 3)


def exp_so3(phi: Tensor) -> Tensor:
    """Rotation (..., 3, 3) by the vector (..., 3) in rad; the gradient exists at zero too."""
    squared = (phi * phi).sum(-1)
    skew = hat(phi)
    a = _series(squared, 0)[..., None, None]
    b = _series(squared, 1)[..., None, None]
    return _identity_like(skew) + a * skew + b * product(skew, skew)


def log_so3(R: Tensor) -> Tensor:
    """Rotation vector (..., 3) in rad of (..., 3, 3), of length in [0, π]; the gradient exists below π."""
    quat_wxyz = _quaternion(R)
    real, vector = quat_wxyz[..., 0], quat_wxyz[..., 1:]
    squared = (vector * vector).sum(-1)
    small = squared < 1e-3
    sine = torch.where(small, torch.ones_like(squared), squared).sqrt()
    # 2 asin(s)/s in powers of s²; cosine and sine of the half angle have one norm, so the real part is not needed.
    near = 2.0 + squared / 3.0 + squared**2 * (3.0 / 20.0) + squared**3 * (5.0 / 56.0) + squared**4 * (35.0 / 576.0)
    factor = torch.where(small, near, 2.0 * torch.atan2(sine, real) / sine)
    return factor[..., None] * vector


def right_jacobian(phi: Tensor) -> Tensor:
    """J_r (..., 3, 3): ``Exp(φ + δ) ≈ Exp(φ) Exp(J_r δ)``."""
    squared = (phi * phi).sum(-1)
    skew = hat(phi)
    b = _series(squared, 1)[..., None, None]
    c = _series(squared, 2)[..., None, None]
    return _identity_like(skew) - b * skew + c * product(skew, skew)


def exp_euler(angles: Tensor) -> Tensor:
    """Rotation (..., 3, 3) of angles (..., 3) about x, y, z in rad: ``Rz Ry Rx``."""
    (cx, cy, cz), (sx, sy, sz) = angles.cos().unbind(-1), angles.sin().unbind(-1)
    rows = [
        cz * cy,
        cz * sy * sx - sz * cx,
        cz * sy * cx + sz * sx,
        sz * cy,
        sz * sy * sx + cz * cx,
        sz * sy * cx - cz * sx,
        -sy,
        cy * sx,
        cy * cx,
    ]
    return torch.stack(rows, dim=-1).reshape(*angles.shape[:-1], 3, 3)


def log_euler(R: Tensor) -> Tensor:
    """Angles (..., 3) of (..., 3, 3), inverse of :func:`exp_euler` for a y angle within ±π/2."""
    level = (R[..., 2, 1] ** 2 + R[..., 2, 2] ** 2).clamp_min(torch.finfo(R.dtype).tiny).sqrt()
    x = torch.atan2(R[..., 2, 1], R[..., 2, 2])
    y = torch.atan2(-R[..., 2, 0], level)
    z = torch.atan2(R[..., 1, 0], R[..., 0, 0])
    return torch.stack([x, y, z], dim=-1)


def motion_from_vector(vector: Tensor, rotation: Rotation = "log") -> Tensor:
    """``T_prev_cur`` (..., 4, 4) of motion vectors (..., 6)."""
    R = exp_so3(vector[..., :3]) if rotation == "log" else exp_euler(vector[..., :3])
    return from_parts(R, vector[..., 3:])


def vector_from_motion(T_prev_cur: Tensor, rotation: Rotation = "log") -> Tensor:
    """Motion vectors (..., 6) of ``T_prev_cur`` (..., 4, 4)."""
    R = T_prev_cur[..., :3, :3]
    return torch.cat([log_so3(R) if rotation == "log" else log_euler(R), T_prev_cur[..., :3, 3]], dim=-1)


def from_parts(R: Tensor, p: Tensor) -> Tensor:
    """T (..., 4, 4) with rotation (..., 3, 3) and translation (..., 3)."""
    top = torch.cat([R, p[..., None]], dim=-1)
    bottom = torch.zeros_like(top[..., :1, :])
    bottom[..., 3] = 1.0
    return torch.cat([top, bottom], dim=-2)


def inverse(T: Tensor) -> Tensor:
    """T_b_a (..., 4, 4) of T_a_b."""
    Rt = T[..., :3, :3].transpose(-1, -2)
    return from_parts(Rt, -product(Rt, T[..., :3, 3:])[..., 0])


def compose(T_prev_cur: Tensor) -> Tensor:
    """The SE(3) composition layer: motions in a row to poses in the first camera.

    Args:
        T_prev_cur: (..., S, 4, 4).

    Returns:
        T_first_k (..., S + 1, 4, 4), the first the identity.
    """
    poses = [_identity_like(T_prev_cur[..., 0, :, :])]
    for step in T_prev_cur.unbind(-3):
        poses.append(product(poses[-1], step))
    return torch.stack(poses, dim=-3)


def relative(T_world_cam: Tensor) -> Tensor:
    """Motions ``T_prev_cur`` (..., S, 4, 4) between poses in a row (..., S + 1, 4, 4); undoes :func:`compose`."""
    return product(inverse(T_world_cam[..., :-1, :, :]), T_world_cam[..., 1:, :, :])


def covariance_from_log_variances(vector: Tensor, log_variances: Tensor) -> Tensor:
    """Covariance (..., 6, 6) of the motion in the tangent of the house, from variances of its vector.

    With independent errors δφ of the logarithm and δp of the translation, ``T_true = T Exp(ξ)`` has to first order
    ``ξ = (J_r(φ) δφ, Rᵀ δp)``.

    Args:
        vector: (..., 6), rotation as logarithm.
        log_variances: (..., 6), natural logarithms of rad² and of squared units of translation.
    """
    J = torch.zeros(*vector.shape, 6, dtype=vector.dtype, device=vector.device)
    J[..., :3, :3] = right_jacobian(vector[..., :3])
    J[..., 3:, 3:] = exp_so3(vector[..., :3]).transpose(-1, -2)
    return product(J * log_variances.exp()[..., None, :], J.transpose(-1, -2))


def product(a: Tensor, b: Tensor) -> Tensor:
    """Matrix product (..., I, K) of (..., I, J) and (..., J, K), in the precision of its factors."""
    return (a[..., :, :, None] * b[..., None, :, :]).sum(-2)


def _identity_like(matrix: Tensor) -> Tensor:
    size = matrix.shape[-1]
    return torch.eye(size, dtype=matrix.dtype, device=matrix.device).expand(*matrix.shape[:-2], size, size)


def _series(squared: Tensor, which: int) -> Tensor:
    """sin(x)/x, (1 − cos x)/x² or (x − sin x)/x³ of x², for ``which`` 0, 1, 2: Σ (−x²)ᵏ / (2k + 1 + which)!."""
    small = squared < _SERIES_BELOW
    # Each branch is given arguments at which it has a finite gradient, since where() passes on NaN from the other.
    near = torch.where(small, squared, torch.zeros_like(squared))
    factorials = [1.0]
    for n in range(1, 2 * _TERMS + which):
        factorials.append(factorials[-1] * n)
    total = torch.zeros_like(near)
    for k in reversed(range(_TERMS)):
        total = 1.0 / factorials[2 * k + 1 + which] - near * total
    far = torch.where(small, torch.ones_like(squared), squared)
    x = far.sqrt()
    if which == 0:
        closed = x.sin() / x
    elif which == 1:
        closed = 2.0 * (0.5 * x).sin() ** 2 / far
    else:
        closed = (x - x.sin()) / (far * x)
    return torch.where(small, total, closed)


def _quaternion(R: Tensor) -> Tensor:
    """Unit quaternions (..., 4), order wxyz and w ≥ 0, by Shepperd's method: the pivot chosen is never small."""
    d0, d1, d2 = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    trace = d0 + d1 + d2
    x, y, z = R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]
    xy, xz, yz = R[..., 0, 1] + R[..., 1, 0], R[..., 0, 2] + R[..., 2, 0], R[..., 1, 2] + R[..., 2, 1]
    rows = [
        torch.stack([1.0 + trace, x, y, z], dim=-1),
        torch.stack([x, 1.0 + d0 - d1 - d2, xy, xz], dim=-1),
        torch.stack([y, xy, 1.0 - d0 + d1 - d2, yz], dim=-1),
        torch.stack([z, xz, yz, 1.0 - d0 - d1 + d2], dim=-1),
    ]
    which = torch.stack([trace, d0, d1, d2], dim=-1).argmax(-1)
    candidates = torch.stack(rows, dim=-2)
    chosen = candidates.gather(-2, which[..., None, None].expand(*which.shape, 1, 4))[..., 0, :]
    chosen = chosen / (chosen * chosen).sum(-1, keepdim=True).sqrt()
    return torch.where(chosen[..., :1] < 0, -chosen, chosen)
