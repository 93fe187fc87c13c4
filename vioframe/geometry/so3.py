"""Rotations as 3×3 matrices, batched over leading axes.

Formulas: Solà, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics", 2018, appendix B.
"""

import numpy as np

from vioframe.checks import Array

# Below this angle the closed forms lose digits to cancellation and the Taylor series are exact to 1e-16.
SMALL_ANGLE = 1e-4


def hat(phi: Array) -> Array:
    """Skew matrix (..., 3, 3) of vectors (..., 3): ``hat(a) @ b = a × b``."""
    out = np.zeros((*phi.shape, 3))
    out[..., 0, 1] = -phi[..., 2]
    out[..., 0, 2] = phi[..., 1]
    out[..., 1, 0] = phi[..., 2]
    out[..., 1, 2] = -phi[..., 0]
    out[..., 2, 0] = -phi[..., 1]
    out[..., 2, 1] = phi[..., 0]
    return out


def vee(skew: Array) -> Array:
    """Inverse of :func:`hat`; takes the skew part of (..., 3, 3)."""
    return 0.5 * np.stack(
        [
            skew[..., 2, 1] - skew[..., 1, 2],
            skew[..., 0, 2] - skew[..., 2, 0],
            skew[..., 1, 0] - skew[..., 0, 1],
        ],
        axis=-1,
    )


def _series(angle_squared: Array) -> tuple[Array, Array, Array]:
    """Return sin(x)/x, (1 − cos x)/x² and (x − sin x)/x³ for x² given."""
    x2 = angle_squared
    small = x2 < SMALL_ANGLE**2
    safe = np.where(small, 1.0, x2)
    x = np.sqrt(safe)
    sine, half_sine = np.sin(x), np.sin(0.5 * x)
    a = np.where(small, 1.0 - x2 / 6.0, sine / x)
    b = np.where(small, 0.5 - x2 / 24.0, 2.0 * half_sine * half_sine / safe)
    c = np.where(small, 1.0 / 6.0 - x2 / 120.0, (x - sine) / (safe * x))
    return a, b, c


def exp(phi: Array) -> Array:
    """Rotation (..., 3, 3) by the vector (..., 3) in rad (Rodrigues)."""
    a, b, _ = _series(np.sum(phi * phi, axis=-1))
    skew = hat(phi)
    return np.eye(3) + a[..., None, None] * skew + b[..., None, None] * (skew @ skew)


def log(R: Array) -> Array:
    """Rotation vector (..., 3) in rad of (..., 3, 3), of length in [0, π]; accurate up to π."""
    # The quaternion of Shepperd's method: the largest of four pivots is never small.
    trace = R[..., 0, 0] + R[..., 1, 1] + R[..., 2, 2]
    d0, d1, d2 = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    pivots = np.stack([trace, d0, d1, d2], axis=-1)
    which = np.argmax(pivots, axis=-1)
    m = R
    candidates = np.stack(
        [
            np.stack(
                [1 + trace, m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]], -1
            ),
            np.stack(
                [
                    m[..., 2, 1] - m[..., 1, 2],
                    1 + d0 - d1 - d2,
                    m[..., 0, 1] + m[..., 1, 0],
                    m[..., 0, 2] + m[..., 2, 0],
                ],
                -1,
            ),
            np.stack(
                [
                    m[..., 0, 2] - m[..., 2, 0],
                    m[..., 0, 1] + m[..., 1, 0],
                    1 - d0 + d1 - d2,
                    m[..., 1, 2] + m[..., 2, 1],
                ],
                -1,
            ),
            np.stack(
                [
                    m[..., 1, 0] - m[..., 0, 1],
                    m[..., 0, 2] + m[..., 2, 0],
                    m[..., 1, 2] + m[..., 2, 1],
                    1 - d0 - d1 + d2,
                ],
                -1,
            ),
        ],
        axis=-2,
    )
    quat_wxyz = np.take_along_axis(candidates, which[..., None, None], axis=-2)[..., 0, :]
    quat_wxyz = quat_wxyz / np.linalg.norm(quat_wxyz, axis=-1, keepdims=True)
    quat_wxyz = np.where(quat_wxyz[..., :1] < 0, -quat_wxyz, quat_wxyz)
    vector = quat_wxyz[..., 1:]
    sine = np.linalg.norm(vector, axis=-1)
    angle = 2.0 * np.arctan2(sine, quat_wxyz[..., 0])
    small = sine < SMALL_ANGLE
    factor = np.where(small, 2.0 + sine**2 / 3.0, angle / np.where(small, 1.0, sine))
    phi: Array = factor[..., None] * vector
    return phi


def left_jacobian(phi: Array) -> Array:
    """J_l (..., 3, 3): ``Exp(φ + δ) ≈ Exp(J_l δ) Exp(φ)``; also the V of the SE(3) exponential."""
    _, b, c = _series(np.sum(phi * phi, axis=-1))
    skew = hat(phi)
    return np.eye(3) + b[..., None, None] * skew + c[..., None, None] * (skew @ skew)


def right_jacobian(phi: Array) -> Array:
    """J_r (..., 3, 3): ``Exp(φ + δ) ≈ Exp(φ) Exp(J_r δ)``."""
    return left_jacobian(-phi)


def left_jacobian_inverse(phi: Array) -> Array:
    """Inverse of :func:`left_jacobian`, for angles below 2π."""
    x2 = np.sum(phi * phi, axis=-1)
    small = x2 < SMALL_ANGLE**2
    safe = np.where(small, 1.0, x2)
    x = np.sqrt(safe)
    half = 0.5 * x
    d = np.where(small, 1.0 / 12.0 + x2 / 720.0, (1.0 - half / np.tan(half)) / safe)
    skew = hat(phi)
    return np.eye(3) - 0.5 * skew + d[..., None, None] * (skew @ skew)


def right_jacobian_inverse(phi: Array) -> Array:
    """Inverse of :func:`right_jacobian`, for angles below 2π."""
    return left_jacobian_inverse(-phi)


def normalise(R: Array) -> Array:
    """Nearest rotation (..., 3, 3) in the Frobenius norm, for matrices that have drifted off the group."""
    u, _, vt = np.linalg.svd(R)
    sign = np.linalg.det(u @ vt)
    u = u.copy()
    u[..., :, 2] *= sign[..., None]
    nearest: Array = u @ vt
    return nearest


def angle(R: Array) -> Array:
    """Angle (...) in rad of rotations (..., 3, 3), in [0, π]."""
    angles: Array = np.linalg.norm(log(R), axis=-1)
    return angles


def from_two_vectors(start: Array, end: Array) -> Array:
    """Smallest rotation R (3, 3) with ``R @ start`` along ``end``; both (3,), of any length but zero."""
    a = start / np.linalg.norm(start)
    b = end / np.linalg.norm(end)
    axis = np.cross(a, b)
    sine, cosine = np.linalg.norm(axis), float(a @ b)
    if sine < 1e-12:
        if cosine > 0:
            return np.eye(3)
        other = np.cross(a, np.eye(3)[int(np.argmin(np.abs(a)))])
        return exp(np.pi * other / np.linalg.norm(other))
    return exp(axis / sine * np.arctan2(sine, cosine))


def rotation_z(yaw: Array | float) -> Array:
    """Rotation (..., 3, 3) about z by ``yaw`` rad."""
    yaw = np.asarray(yaw, dtype=float)
    return exp(np.stack([np.zeros_like(yaw), np.zeros_like(yaw), yaw], axis=-1))
