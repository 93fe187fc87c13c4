"""Gyro bias and the camera's rotation on the body that make the points of all pairs of images agree with the gyro.

The epipolar cost of :mod:`vioframe.tight.two_view_rotation` is summed over the pairs with few unknowns in common
(after He, Xu, Ouyang and Li, "A rotation-translation-decoupled solution for robust and efficient visual-inertial
initialization", CVPR 2023). A pair whose own rotation is poorly determined then counts only where it is not. With
R_cam = R_body_camᵀ ΔR(b_g) R_body_cam and small changes δb of the bias and φ of the camera's rotation,

    θ = −T R_body_camᵀ M δb + (I − R_camᵀ) φ,

M the mean of ΔRᵀ over the pair.
"""

from dataclasses import dataclass

import numpy as np

from vioframe.checks import Array, Mask
from vioframe.geometry import so3
from vioframe.tight.inertial_window import InertialWindow
from vioframe.tight.two_view_rotation import normal_equations

# Factors on sigma, one an iteration: further off, fewer points are outliers.
_LOOSENESS = (4.0, 2.0, 1.0, 1.0, 1.0, 1.0)
_BIAS_SIGMA = 0.3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PairedPoints:
    """What pairs of images have in common.

    Attributes:
        starts: (P,) s, instants of the first images; ends: (P,) s, of the second.
        first: (P, M, 3) unit vectors in the first camera; second: (P, M, 3) in the second.
        common: (P, M) which points both see.
        sigma: rad, of a bearing.
    """

    starts: Array
    ends: Array
    first: Array
    second: Array
    common: Mask
    sigma: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RotationFit:
    """Attributes: gyro_bias: (3,) rad/s; R_body_cam: (3, 3); rotation_sigma: rad, of its least certain axis."""

    gyro_bias: Array
    R_body_cam: Array
    rotation_sigma: float


def fit_rotations(
    inertial: InertialWindow, pairs: PairedPoints, R_body_cam: Array, bias: Array, rotation_sigma: float
) -> RotationFit:
    """Gauss–Newton from ``bias`` and ``R_body_cam``.

    Args:
        inertial: samples around all pairs.
        pairs: images and their points.
        R_body_cam: (3, 3) as known.
        bias: (3,) rad/s to begin with.
        rotation_sigma: rad an axis, of ``R_body_cam`` as known.
    """
    weight = pairs.common.astype(float)
    T = pairs.ends - pairs.starts
    start = R_body_cam
    prior = np.diag(np.repeat([1.0 / _BIAS_SIGMA**2, 1.0 / rotation_sigma**2], 3))
    trust = weight
    for looseness in _LOOSENESS:
        R_first, R_second = inertial.rotations(pairs.starts, bias), inertial.rotations(pairs.ends, bias)
        R_body = R_first.swapaxes(-1, -2) @ R_second
        R_cam = R_body_cam.T @ R_body @ R_body_cam
        equations = normal_equations(R_cam, pairs.first, pairs.second, weight, looseness * pairs.sigma, trust)
        H, trust = equations.H, equations.trust
        middle = so3.exp(0.5 * so3.log(R_body))
        by_bias = -T[:, None, None] * (R_body_cam.T @ middle.swapaxes(-1, -2))
        J = np.concatenate([by_bias, np.eye(3) - R_cam.swapaxes(-1, -2)], axis=-1)
        normal = (J.swapaxes(-1, -2) @ H @ J).sum(axis=0) + prior
        turned = so3.log(start.T @ R_body_cam)
        right = (J.swapaxes(-1, -2) @ equations.gradient[..., None])[..., 0].sum(axis=0)
        right[3:] += turned / rotation_sigma**2
        step = np.linalg.solve(normal, -right)
        bias, R_body_cam = bias + step[:3], R_body_cam @ so3.exp(step[3:])
    sigma = float(np.sqrt(np.linalg.eigvalsh(np.linalg.inv(normal)[3:, 3:])[-1]))
    return RotationFit(gyro_bias=bias, R_body_cam=R_body_cam, rotation_sigma=sigma)
