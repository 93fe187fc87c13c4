"""Projection and back-projection for the camera models of :class:`vioframe.types.Camera`.

Radial-tangential: Brown 1966 as in OpenCV's ``calib3d``; equidistant: Kannala & Brandt 2006 as in OpenCV's
``fisheye``. The centre of the top-left pixel is (0, 0).
"""

import numpy as np

from vioframe.checks import Array, Mask
from vioframe.types import Camera

# Newton on the radius converges quadratically; twenty fixed-point steps are what OpenCV takes.
_UNDISTORT_STEPS = 20

# A fisheye lens sees past 90°, where a point at depth 1 does not exist; the tangent stops just before.
_WIDEST_NORMALISED = np.radians(89.9)


def intrinsic_matrix(camera: Camera) -> Array:
    """K (3, 3)."""
    fx, fy, cx, cy = camera.intrinsics_px
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def distort(camera: Camera, points: Array) -> Array:
    """Distorted normalised coordinates (..., 2) of ideal ones (..., 2) at depth 1."""
    x, y = points[..., 0], points[..., 1]
    r2 = x * x + y * y
    if camera.model == "radtan":
        k1, k2, p1, p2, k3 = np.pad(camera.distortion, (0, 5 - len(camera.distortion)))
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        return np.stack(
            [
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
            ],
            axis=-1,
        )
    if camera.model == "equidistant":
        k1, k2, k3, k4 = camera.distortion
        r = np.sqrt(r2)
        angle = np.arctan(r)
        a2 = angle * angle
        bent = angle * (1 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))))
        factor = np.where(r < 1e-8, 1.0, bent / np.where(r < 1e-8, 1.0, r))
        return points * factor[..., None]
    return points


def undistort(camera: Camera, points: Array) -> Array:
    """Ideal normalised coordinates (..., 2) of distorted ones (..., 2); inverse of :func:`distort`.

    Rays that a fisheye lens sees 89.9° or more off its axis come back at 89.9°: use :func:`bearings` there.
    """
    if camera.model == "radtan":
        k1, k2, p1, p2, k3 = np.pad(camera.distortion, (0, 5 - len(camera.distortion)))
        x, y = points[..., 0].copy(), points[..., 1].copy()
        for _ in range(_UNDISTORT_STEPS):
            r2 = x * x + y * y
            radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
            x, y = (
                (points[..., 0] - 2 * p1 * x * y - p2 * (r2 + 2 * x * x)) / radial,
                (points[..., 1] - p1 * (r2 + 2 * y * y) - 2 * p2 * x * y) / radial,
            )
        return np.stack([x, y], axis=-1)
    if camera.model == "equidistant":
        bent = np.linalg.norm(points, axis=-1)
        angle = np.minimum(_angle_off_axis(camera, bent), _WIDEST_NORMALISED)
        factor = np.where(bent < 1e-8, 1.0, np.tan(angle) / np.where(bent < 1e-8, 1.0, bent))
        return points * factor[..., None]
    return points


def _angle_off_axis(camera: Camera, bent: Array) -> Array:
    """Angle (...) in rad from the optical axis at distorted radii (...), of an equidistant camera."""
    k1, k2, k3, k4 = camera.distortion
    angle = np.minimum(bent, 0.5 * np.pi)
    for _ in range(_UNDISTORT_STEPS):
        a2 = angle * angle
        value = angle * (1 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4)))) - bent
        slope = 1 + a2 * (3 * k1 + a2 * (5 * k2 + a2 * (7 * k3 + 9 * a2 * k4)))
        angle = angle - value / slope
    return angle


def project(camera: Camera, points_cam: Array) -> tuple[Array, Mask]:
    """Pixels of points in the camera frame.

    Args:
        camera: calibration.
        points_cam: (..., 3) m.

    Returns:
        pixels (..., 2) and visible (...): in front of the camera and inside the image. Pixels of points
        behind the camera are meaningless.
    """
    depth = points_cam[..., 2]
    ahead = depth > 1e-6
    ideal = points_cam[..., :2] / np.where(ahead, depth, 1.0)[..., None]
    pixels = distort(camera, ideal) * camera.intrinsics_px[:2] + camera.intrinsics_px[2:]
    width, height = camera.size_px
    inside = (
        (pixels[..., 0] >= -0.5)
        & (pixels[..., 1] >= -0.5)
        & (pixels[..., 0] < width - 0.5)
        & (pixels[..., 1] < height - 0.5)
    )
    return pixels, ahead & inside


def normalised(camera: Camera, pixels: Array) -> Array:
    """Ideal normalised coordinates (..., 2), at depth 1, of pixels (..., 2)."""
    return undistort(camera, (pixels - camera.intrinsics_px[2:]) / camera.intrinsics_px[:2])


def bearings(camera: Camera, pixels: Array) -> Array:
    """Unit vectors (..., 3) in the camera frame through pixels (..., 2); behind the image plane past 90°."""
    if camera.model == "equidistant":
        points = (pixels - camera.intrinsics_px[2:]) / camera.intrinsics_px[:2]
        bent = np.linalg.norm(points, axis=-1)
        angle = _angle_off_axis(camera, bent)
        factor = np.where(bent < 1e-8, 1.0, np.sin(angle) / np.where(bent < 1e-8, 1.0, bent))
        return np.concatenate([points * factor[..., None], np.cos(angle)[..., None]], axis=-1)
    ideal = normalised(camera, pixels)
    rays = np.concatenate([ideal, np.ones((*ideal.shape[:-1], 1))], axis=-1)
    unit: Array = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    return unit
