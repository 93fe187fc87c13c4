"""New points: which tracks may enter the window, and where they are."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vioframe.checks import Array, Mask, Stamps
from vioframe.geometry import se3
from vioframe.geometry.triangulation import triangulate
from vioframe_window.keyframes import View
from vioframe_window.options import LandmarkOptions


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NewPoints:
    """Tracks that passed the gates.

    Attributes:
        ids: (N,).
        points_world: (N, 3) m.
        refused: how many had parallax enough but failed a gate.
    """

    ids: Stamps
    points_world: Array
    refused: int


def gather(views: Sequence[View], ids: Stamps) -> tuple[Array, Mask]:
    """Bearings (V, N, 3) of points in each view, and where they were seen (V, N)."""
    bearings = np.zeros((len(views), len(ids), 3))
    seen = np.zeros((len(views), len(ids)), dtype=bool)
    for index, view in enumerate(views):
        rows, found = view.find(ids)
        bearings[index, found] = view.bearings[rows[found]]
        seen[index] = found
    return bearings, seen


def find_new_points(
    T_world_cam: Array,
    views: Sequence[View],
    ids: Stamps,
    options: LandmarkOptions,
    *,
    most: int,
    focal_px: float,
    slack: float,
) -> NewPoints:
    """Triangulate tracks and keep those that are sure enough.

    Args:
        T_world_cam: (V, 4, 4) of the cameras that saw ``views``.
        views: (V) of any camera at any keyframe of the window.
        ids: (N,) candidates.
        options: gates.
        most: as many may enter.
        focal_px: pixels a unit of normalised coordinates.
        slack: factor on the reprojection gate.
    """
    bearings, seen = gather(views, ids)
    enough = np.flatnonzero(seen.sum(axis=0) >= options.min_views)
    bearings, seen = bearings[:, enough], seen[:, enough]
    parallax = _parallax(np.einsum("vij,vnj->vni", T_world_cam[:, :3, :3], bearings), seen)
    wide = parallax > np.radians(options.min_parallax_deg)
    enough, bearings, seen, parallax = enough[wide], bearings[:, wide], seen[:, wide], parallax[wide]
    if not len(enough):
        return NewPoints(ids=ids[:0], points_world=np.zeros((0, 3)), refused=0)
    points, depths = triangulate(T_world_cam, bearings, seen.astype(float))
    in_range = (depths > options.min_depth) & (depths < options.max_depth)
    good = np.isfinite(points).all(axis=1) & np.all(in_range | ~seen, axis=0)
    errors = reprojection_errors(T_world_cam, np.where(good[:, None], points, 0.0), bearings)
    worst = np.where(seen, errors, 0.0).max(axis=0) * focal_px
    good &= worst < slack * options.max_error_px
    chosen = np.flatnonzero(good)
    # Where more pass than may enter, the widest parallax knows its depth best.
    chosen = chosen[np.argsort(-parallax[chosen], kind="stable")[: max(most, 0)]]
    return NewPoints(ids=ids[enough[chosen]], points_world=points[chosen], refused=int((~good).sum()))


def reprojection_errors(T_world_cam: Array, points_world: Array, bearings: Array) -> Array:
    """Distances (V, N) between points (N, 3) and bearings (V, N, 3) on the image planes at depth 1."""
    T_cam_world = se3.inverse(T_world_cam)
    points = np.einsum("vij,nj->vni", T_cam_world[:, :3, :3], points_world) + T_cam_world[:, None, :3, 3]
    depth = np.maximum(points[..., 2:], 1e-6)
    measured = bearings[..., :2] / np.maximum(bearings[..., 2:], 1e-6)
    errors: Array = np.linalg.norm(points[..., :2] / depth - measured, axis=-1)
    return errors


def _parallax(rays: Array, seen: Mask) -> Array:
    """Largest angle (N,) rad between the ray of a point's last view and its others; rays (V, N, 3)."""
    count = len(rays)
    last = count - 1 - np.argmax(seen[::-1], axis=0)
    newest = rays[last, np.arange(rays.shape[1])]
    cosines = np.einsum("vni,ni->vn", rays, newest)
    lowest = np.where(seen, cosines, 1.0).min(axis=0)
    angles: Array = np.arccos(np.clip(lowest, -1.0, 1.0))
    return angles
