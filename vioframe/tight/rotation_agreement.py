"""Whether gyro and camera turn alike: gyro bias, the camera's rotation on the body, its delay, swapped axes.

Over a pair of images T seconds apart, with rotation vectors φ of the camera and ψ of the integrated gyro,

    ψ = R_body_cam φ + b_g T.

The bias is projected out, the rotation is Kabsch's: with H = Σ w ψ φᵀ = U S Vᵀ, R = U diag(1, 1, det(U Vᵀ)) Vᵀ.
A delay of the camera shifts the instants between which the gyro is integrated. What explains the pairs best
says what is wrong: with det = −1 instead of +1 the axes of a sensor are swapped or mirrored.
"""

from dataclasses import dataclass

import numpy as np

from vioframe.checks import Array
from vioframe.geometry import so3
from vioframe.tight.inertial_window import InertialWindow
from vioframe.tight.two_view_rotation import TwoViewRotations

# How far the camera's stamps are searched, s; 200 ms happen where exposure or transport were not considered.
_DELAY_REACH_S = 0.3
_DELAY_STEP_S = 0.01
# Pairs whose residual is above this many medians do not vote.
_OUTLIER = 4.0
_GYRO_SIGMA = 2e-3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Agreement:
    """How gyro and camera agree over a window; residuals are rms over the pairs, rad/s.

    Attributes:
        gyro_bias: (3,) rad/s, with the calibrated rotation and no delay.
        gyro_bias_rotated: (3,) rad/s, with ``R_body_cam``.
        turning: rad/s, rms of the camera's rate apart from a constant.
        residual: with the calibration as it is.
        R_body_cam: (3, 3) that fits best without a delay.
        leverage: rad/s, rms rate about the second axis: a rotation between the frames needs two.
        residual_rotated: with that rotation.
        residual_mirrored: with the best mirrored axes.
        delay_s: extra delay of the camera that fits best with the calibrated rotation.
        delay_sigma_s: its standard deviation.
        residual_delayed: with that delay.
        residual_delayed_rotated: with the best pair of a rotation and a delay.
    """

    gyro_bias: Array
    gyro_bias_rotated: Array
    turning: float
    residual: float
    R_body_cam: Array
    leverage: float
    residual_rotated: float
    residual_mirrored: float
    delay_s: float
    delay_sigma_s: float
    residual_delayed: float
    residual_delayed_rotated: float


def compare_rotations(
    inertial: InertialWindow, starts: Array, ends: Array, seen: TwoViewRotations, R_body_cam: Array
) -> Agreement:
    """Compare the camera's rotations with the gyro's.

    Args:
        inertial: samples around all pairs.
        starts: (P,) s, instants of the first images of the pairs.
        ends: (P,) s, of the second ones.
        seen: rotations of the camera between them.
        R_body_cam: (3, 3) as calibrated.
    """
    T = ends - starts
    phi = so3.log(seen.R)
    variance = np.trace(np.linalg.inv(seen.information + 1e-3 * np.eye(3)), axis1=1, axis2=2)
    delays = np.arange(-_DELAY_REACH_S, _DELAY_REACH_S + 1e-9, _DELAY_STEP_S)
    zero = len(delays) // 2
    psi = _gyro_rotations(inertial, starts, ends, delays)
    # Below a tenth of a degree the gyro itself is no better.
    weight = _voters(psi[zero], phi, T) / (variance + _GYRO_SIGMA**2)
    # Shifted beyond the samples, a pair says nothing.
    earliest, latest = inertial.elapsed[0] - 1e-6, inertial.elapsed[-1] + 1e-6
    inside = (starts + delays[:, None] >= earliest) & (ends + delays[:, None] <= latest)
    weight = weight * inside

    phi_free, psi_free = _without_bias(phi, T, weight), _without_bias(psi, T, weight)
    calibrated = _rms(psi_free - phi_free @ R_body_cam.T, T, weight)
    rotations, mirrors, spread = _best_rotations(psi_free, phi_free, weight)
    rotated = _rms(psi_free - phi_free @ rotations.swapaxes(-1, -2), T, weight)
    mirrored = _rms(psi_free[zero] - phi_free[zero] @ mirrors[zero].T, T, weight[zero])

    trusted = weight.sum(axis=1) > 0.5 * weight[zero].sum()
    best = int(np.argmin(np.where(trusted, calibrated, np.inf)))
    delay, delay_sigma = _parabola(delays, calibrated**2, best, int(inside[best].sum()))
    return Agreement(
        gyro_bias=_rate(psi[zero] - phi @ R_body_cam.T, T, weight[zero]),
        gyro_bias_rotated=_rate(psi[zero] - phi @ rotations[zero].T, T, weight[zero]),
        turning=float(_rms(phi_free[zero], T, weight[zero])),
        residual=float(calibrated[zero]),
        R_body_cam=rotations[zero],
        leverage=float(np.sqrt(spread[zero] / np.maximum((weight[zero] * T**2).sum(), 1e-12))),
        residual_rotated=float(rotated[zero]),
        residual_mirrored=float(mirrored),
        delay_s=delay,
        delay_sigma_s=delay_sigma,
        residual_delayed=float(calibrated[best]),
        residual_delayed_rotated=float(rotated[trusted].min()),
    )


def _gyro_rotations(inertial: InertialWindow, starts: Array, ends: Array, delays: Array) -> Array:
    """Rotation vectors (D, P, 3) of the gyro between the instants, for each delay."""
    zero = np.zeros(3)
    times = np.stack([starts, ends]) + delays[:, None, None]
    R = inertial.rotations(times, zero)
    vectors: Array = so3.log(R[:, 0].swapaxes(-1, -2) @ R[:, 1])
    return vectors


def _voters(psi: Array, phi: Array, T: Array) -> Array:
    """Which pairs (P,) to keep: a two-view rotation that went astray is longer or shorter than the gyro's."""
    difference = (np.linalg.norm(phi, axis=1) - np.linalg.norm(psi, axis=1)) / T
    off = np.abs(difference - np.median(difference))
    keep: Array = (off <= _OUTLIER * np.median(off) + 0.02).astype(float)
    return keep if keep.sum() >= 4 else np.ones(len(T))


def _rate(vectors: Array, T: Array, weight: Array) -> Array:
    """Constant rate (..., 3) that fits rotation vectors (..., P, 3) best, by weights (..., P)."""
    total = np.maximum((weight * T**2).sum(axis=-1), 1e-12)
    rate: Array = (vectors * (weight * T)[..., None]).sum(axis=-2) / total[..., None]
    return rate


def _without_bias(vectors: Array, T: Array, weight: Array) -> Array:
    """Rotation vectors (..., P, 3) less the constant rate that fits them best."""
    return vectors - _rate(vectors, T, weight)[..., None, :] * T[:, None]


def _rms(vectors: Array, T: Array, weight: Array) -> Array:
    """Weighted rms (...) of the rates (..., P, 3), rad/s."""
    squares = ((vectors / T[:, None]) ** 2).sum(axis=-1)
    rms: Array = np.sqrt((squares * weight).sum(axis=-1) / np.maximum(weight.sum(axis=-1), 1e-12))
    return rms


def _best_rotations(psi: Array, phi: Array, weight: Array) -> tuple[Array, Array, Array]:
    """Kabsch's rotations (D, 3, 3), the best improper ones, and the second singular value (D,)."""
    U, S, Vt = np.linalg.svd((psi * weight[..., None]).swapaxes(-1, -2) @ phi)
    sign = np.linalg.det(U @ Vt)
    proper, improper = U.copy(), U.copy()
    proper[..., :, 2] *= sign[:, None]
    improper[..., :, 2] *= -sign[:, None]
    return proper @ Vt, improper @ Vt, S[:, 1]


def _parabola(grid: Array, squares: Array, best: int, pairs: int) -> tuple[float, float]:
    """Minimum between grid points, and its standard deviation if the pairs' residuals are independent."""
    at = int(np.clip(best, 1, len(grid) - 2))
    a, b, c = squares[at - 1 : at + 2]
    curvature, step = a - 2.0 * b + c, grid[1] - grid[0]
    if not curvature > 0.0:
        return float(grid[best]), np.inf
    shift = float(np.clip(0.5 * (a - c) / curvature, -1.0, 1.0))
    return float(grid[at] + shift * step), float(
        step * np.sqrt(2.0 * max(b, 1e-12) / (curvature * 3.0 * max(pairs, 1)))
    )
