"""Points in three dimensions from the rays of known cameras, all points at once."""

import numpy as np

from vioframe.checks import Array, Mask, Stamps

_STEPS = 3
# Added to the normal equations, relative to their scale, so that rays without parallax have an answer.
_RIDGE = 1e-9


def triangulate(R: Array, p: Array, points: Array, weights: Array, anchors: Stamps) -> tuple[Array, Array]:
    """Least squares of the reprojection error, in (x/z, y/z, 1/z) of one camera a point.

    It begins with the point nearest to all rays, ``Σ (I − b bᵀ)(f − p) = 0``, and takes three Gauss–Newton
    steps in inverse depth, in which the projection is almost linear (Civera et al., IEEE T-RO 2008).

    Args:
        R: (K, 3, 3) of the cameras, into the world.
        p: (K, 3) m, their places.
        points: (N, K, 2) on the normalised plane.
        weights: (N, K) 1/σ, zero where a camera did not see a point.
        anchors: (N,) the camera of each point's inverse depth; it must have seen the point.

    Returns:
        Points (N, 3) in the world and their depths (N,) in the anchors; a depth of zero is no answer.
    """
    count = len(points)
    mask = (weights > 0.0).astype(float)
    rays = _world_rays(R, points)
    rays /= np.sqrt((rays * rays).sum(axis=-1, keepdims=True))
    masked = rays * mask[..., None]
    normal = mask.sum(axis=1)[:, None, None] * np.eye(3) - masked.transpose(0, 2, 1) @ masked
    along = masked * (rays * p).sum(axis=-1, keepdims=True)
    right = mask @ p - along.sum(axis=1)
    normal[:, (0, 1, 2), (0, 1, 2)] += 1e-12 + _RIDGE * mask.sum(axis=1)[:, None]
    first = np.linalg.solve(normal, right[..., None])[..., 0]

    R_anchor, p_anchor = R[anchors], p[anchors]
    local = ((first - p_anchor)[:, None, :] @ R_anchor)[:, 0]
    row = np.arange(count)
    ahead = np.asarray(local[:, 2] > 1e-3)
    depth = np.where(ahead, local[:, 2], 1.0)
    x = np.empty((count, 3))
    x[:, :2] = np.where(ahead[:, None], local[:, :2] / depth[:, None], points[row, anchors])
    x[:, 2] = np.where(ahead, 1.0 / depth, 1e-2)

    # X_k = R_kᵀ (R_a (x, y, 1) + ρ (p_a − p_k)): linear in all three.
    R_rel = (R.transpose(0, 2, 1).reshape(-1, 3) @ R_anchor.transpose(1, 0, 2).reshape(3, -1)).reshape(
        len(R), 3, count, 3
    )
    R_rel = R_rel.transpose(2, 0, 1, 3)
    t_rel = ((p_anchor[:, None] - p)[:, :, None, :] * R.transpose(0, 2, 1)).sum(axis=-1)
    columns = np.stack([R_rel[..., 0], R_rel[..., 1], t_rel], axis=-1)
    for _ in range(_STEPS):
        X = (columns * x[:, None, None, :]).sum(axis=-1) + R_rel[..., 2]
        Z = X[..., 2]
        usable = np.abs(Z) > 1e-6
        inverse = np.where(usable, 1.0, 0.0) / np.where(usable, Z, 1.0)
        scale = weights * inverse
        uv = X[..., :2] * inverse[..., None]
        residual = weights[..., None] * (points - uv)
        H = scale[..., None, None] * (columns[..., :2, :] - uv[..., None] * columns[..., 2:, :])
        H = H.reshape(count, -1, 3)
        Ht = H.transpose(0, 2, 1)
        A = Ht @ H
        A[:, (0, 1, 2), (0, 1, 2)] += 1e-12 + _RIDGE * A[:, (0, 1, 2), (0, 1, 2)]
        x = x + np.linalg.solve(A, Ht @ residual.reshape(count, -1, 1))[..., 0]
    positive = x[:, 2] > 1e-6
    depth = np.where(positive, 1.0 / np.where(positive, x[:, 2], 1.0), 0.0)
    local = np.stack([x[:, 0] * depth, x[:, 1] * depth, depth], axis=-1)
    found: Array = p_anchor + (R_anchor @ local[..., None])[..., 0]
    return found, depth


def _world_rays(R: Array, points: Array) -> Array:
    """Directions (N, K, 3) in the world of points (N, K, 2) on the normalised planes; not of unit length."""
    rays: Array = points[..., :1] * R[:, :, 0] + points[..., 1:] * R[:, :, 1] + R[:, :, 2]
    return rays


def widest_parallax(R: Array, points: Array, weights: Array, anchors: Stamps) -> Array:
    """Largest angle (N,) in rad between a point's ray in its anchor and its other rays."""
    rays = _world_rays(R, points)
    rays /= np.sqrt((rays * rays).sum(axis=-1, keepdims=True))
    reference = rays[np.arange(len(points)), anchors]
    cosines = (rays * reference[:, None]).sum(axis=-1)
    smallest = np.where(weights > 0.0, cosines, 1.0).min(axis=1)
    widest: Array = np.arccos(np.clip(smallest, -1.0, 1.0))
    return widest


def in_front(R: Array, p: Array, found: Array, weights: Array, min_depth_m: float, max_depth_m: float) -> Mask:
    """Whether each point (N,) lies between two depths in every camera (K) that saw it."""
    Z = ((found[:, None] - p) * R[:, :, 2]).sum(axis=-1)
    good = (Z > min_depth_m) & (Z < max_depth_m)
    return np.asarray(np.isfinite(found).all(axis=-1) & (good | (weights <= 0.0)).all(axis=1))
