"""Observations as rays of a generalised camera, with their error in pixels.

A pixel z with unit ray b (camera frame) and the projection π of the full camera model have, to first order,
``π(p) − z = A p / (b · p)`` with ``A = ∂π/∂p`` at b, because π does not depend on the length of p and so A b = 0.
That is linear in p up to its depth along b, holds for every camera model, and needs no undistortion in the loop.
A second camera of the rig only moves the origin: ``A (p − c) / (b · (p − c))`` in the axes of camera 0.
"""

from dataclasses import dataclass

import numpy as np

from vioframe.checks import Array
from vioframe.geometry import camera as projection
from vioframe.types import Camera

_STEP = 1e-5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rays:
    """Observations in the axes of camera 0.

    Attributes:
        rows: (M, 2, 3) px: A above.
        axes: (M, 3) unit: b.
        origins: (M, 3): c, the centre of the camera that saw it; zero for camera 0.
    """

    rows: Array
    axes: Array
    origins: Array

    def __len__(self) -> int:
        return len(self.axes)

    def select(self, which: np.ndarray) -> "Rays":
        """The observations of a mask or of indices."""
        return Rays(rows=self.rows[which], axes=self.axes[which], origins=self.origins[which])


def distortion_slope(camera: Camera, ideal: Array) -> Array:
    """∂(pixel)/∂(ideal normalised coordinates) (M, 2, 2) at (M, 2), by central differences."""
    shifts = _STEP * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    bent = projection.distort(camera, ideal[None] + shifts[:, None])
    columns = np.stack([bent[0] - bent[1], bent[2] - bent[3]], axis=-1) / (2 * _STEP)
    return columns * camera.intrinsics_px[:2, None]


def observe(camera: Camera, bearings: Array, T_cam0_cam: Array | None = None) -> Rays:
    """Rays of points seen in directions ``bearings`` (M, 3) of ``camera``, which sits at ``T_cam0_cam``."""
    depth = np.maximum(bearings[:, 2], 1e-3)
    ideal = bearings[:, :2] / depth[:, None]
    slope = distortion_slope(camera, ideal)
    # ∂(x/z, y/z)/∂(x, y, z) = [I, −(x/z, y/z)ᵀ] / z
    rows = np.concatenate([slope, -(slope @ ideal[..., None])], axis=-1) / depth[:, None, None]
    if T_cam0_cam is None:
        return Rays(rows=rows, axes=bearings, origins=np.zeros_like(bearings))
    R_cam0_cam = T_cam0_cam[:3, :3]
    return Rays(
        rows=rows @ R_cam0_cam.T,
        axes=bearings @ R_cam0_cam.T,
        origins=np.broadcast_to(T_cam0_cam[:3, 3], bearings.shape),
    )


def residuals(rays: Rays, points_cam: Array) -> tuple[Array, Array, np.ndarray]:
    """Errors in px of points (M, 3) in camera 0.

    Returns:
        residual (M, 2), its Jacobian by the point (M, 2, 3), and ahead (M,): the point lies before the camera
        that saw it. Values of points behind are meaningless.
    """
    offset = points_cam - rays.origins
    depth = np.sum(rays.axes * offset, axis=-1)
    ahead = depth > 1e-9
    inverse = 1.0 / np.where(ahead, depth, 1.0)
    error = (rays.rows @ offset[..., None])[..., 0] * inverse[..., None]
    slope = (rays.rows - error[..., None] * rays.axes[..., None, :]) * inverse[..., None, None]
    return error, slope, ahead
