"""Points from bearings seen from known poses."""

import numpy as np

from vioframe.checks import Array


def triangulate(T_ref_cam: Array, bearings: Array, weights: Array | None = None) -> tuple[Array, Array]:
    """Least-squares intersection of rays, all points at once.

    Minimises Σ w ‖(I − b bᵀ)(x − c)‖² over the rays of a point (Hartley & Sturm's mid-point, many views).

    Args:
        T_ref_cam: (V, 4, 4) camera poses in a reference frame.
        bearings: (V, M, 3) unit vectors in each camera.
        weights: (V, M), 0 where a point was not seen; all ones by default.

    Returns:
        points (M, 3) in the reference frame, and depths (V, M) along each camera's z axis. Points whose
        rays are parallel come back as NaN.
    """
    rays = np.einsum("vij,vmj->vmi", T_ref_cam[:, :3, :3], bearings)
    projector = np.eye(3) - rays[..., :, None] * rays[..., None, :]
    if weights is not None:
        projector = projector * weights[..., None, None]
    normal = projector.sum(axis=0)
    right = np.einsum("vmij,vj->mi", projector, T_ref_cam[:, :3, 3])
    # The smallest eigenvalue of the normal matrix is about (views) · sin² of half the parallax.
    solvable = np.linalg.eigvalsh(normal)[:, 0] > 1e-10
    points = np.full((bearings.shape[1], 3), np.nan)
    points[solvable] = np.linalg.solve(normal[solvable], right[solvable][..., None])[..., 0]
    from_cam = points[None] - T_ref_cam[:, None, :3, 3]
    depths = np.einsum("vi,vmi->vm", T_ref_cam[:, :3, 2], from_cam)
    return points, depths
