"""New points: which tracks may enter the window, and where they are."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vioframe.checks import Array, Mask, Stamps
from vioframe.geometry import se3
from vioframe.geometry.triangulation import triangulate
from vioframe_window.keyframes import View
from vioframe_window.options import LandmarkOptions

# Sigmas of the turn between two views above which their parallax is believed.
_SURE_TURN = 3.0


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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Doubts:
    """How far the attitudes of views may be off relative to each other.

    Attributes:
        times_s: (V,) of the views.
        rate_sigma: rad/s, by which the turn from one view to another may be off, a second between them.
    """

    times_s: Array
    rate_sigma: float


def find_new_points(
    T_world_cam: Array,
    views: Sequence[View],
    ids: Stamps,
    options: LandmarkOptions,
    *,
    most: int,
    focal_px: float,
    slack: float,
    doubts: Doubts | None = None,
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
        doubts: of the poses; None where they are sure.
    """
    bearings, seen = gather(views, ids)
    enough = np.flatnonzero(seen.sum(axis=0) >= options.min_views)
    bearings, seen = bearings[:, enough], seen[:, enough]
    parallax = _sure_parallax(T_world_cam, bearings, seen, doubts)
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


def _sure_parallax(T_world_cam: Array, bearings: Array, seen: Mask, doubts: Doubts | None) -> Array:
    """Largest angle (N,) rad between the ray of a point's last view and its others, as far as it is no error.

    A gyro whose bias is not known yet turns all rays, and points would enter close by that are far: an angle below a
    few sigmas of what such a bias makes of the time between two views does not count.
    """
    rays = np.einsum("vij,vnj->vni", T_world_cam[:, :3, :3], bearings)
    last = len(rays) - 1 - np.argmax(seen[::-1], axis=0)
    newest = rays[last, np.arange(rays.shape[1])]
    angles = np.arccos(np.clip(np.einsum("vni,ni->vn", rays, newest), -1.0, 1.0))
    if doubts is not None:
        elapsed = doubts.times_s[last] - doubts.times_s[:, None]
        seen = seen & (angles > _SURE_TURN * doubts.rate_sigma * elapsed)
    largest: Array = np.where(seen, angles, 0.0).max(axis=0)
    return largest
