"""Exact optical flow of a simulated camera: the oracle of every flow estimate, and what a network can learn from.

A pixel's depth and surface are known at the first instant; the point there is carried along with its surface and
seen again from the pose of the second instant. With a rolling shutter every row has an instant of its own: the row
in which a point appears is found by fixed-point steps, which contract since a row takes far less time than a point
needs to cross it.
"""

from dataclasses import dataclass

import numpy as np

from vioframe.checks import Array, Mask
from vioframe.geometry import camera as camera_models
from vioframe.geometry import se3
from vioframe.types import Camera

# Each step shrinks the error by pixels a readout over rows, a tenth at most in any plausible motion.
_ROW_STEPS = 8


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sight:
    """What one camera sees at one instant, by exact rays through the centres of its pixels.

    Attributes:
        depth: (H, W) m along the optical axis of the pixel's own pose; 0 where the camera is blind.
        face: (H, W) index of the surface.
        T_world_cam: (4, 4), or (H, 4, 4) with one pose for each row.
    """

    depth: np.ndarray
    face: np.ndarray
    T_world_cam: Array


def exact_flow(camera: Camera, first: Sight, second: Sight, moved: Array) -> tuple[Array, Mask]:
    """Where the pixels of one image are in another.

    A surface is flat and convex, so a point of it is seen exactly if the ray towards it meets that surface first;
    which surface a ray meets is known at pixel centres, so ``seen`` is decided to half a pixel.

    Args:
        camera: calibration of both.
        first, second: what it sees.
        moved: (S, 3) m in the world by which each solid has moved from the first instant to the second.

    Returns:
        displacement (H, W, 2) px on the grid of the first image, and seen (H, W): False where the point leaves the
        image, is hidden in the second, or the camera is blind. What is not seen may have any displacement.
    """
    width, height = camera.size_px
    grid = np.stack(np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float)), axis=-1)
    known = first.depth > 0.0
    ideal = np.where(known[..., None], camera_models.normalised(camera, grid), 0.0)
    local = np.concatenate([ideal, np.ones((height, width, 1))], axis=-1) * first.depth[..., None]
    world = _into_world(first.T_world_cam, local) + moved[first.face // 6]
    pixels, inside = _project(camera, second.T_world_cam, world, grid)
    columns, rows = np.moveaxis(np.round(np.where(inside[..., None], pixels, 0.0)).astype(int), -1, 0)
    columns, rows = columns.clip(0, width - 1), rows.clip(0, height - 1)
    same = (second.face[rows, columns] == first.face) & (second.depth[rows, columns] > 0.0)
    return pixels - grid, known & inside & same


def _into_world(T_world_cam: Array, local: Array) -> Array:
    """Points (H, W, 3) of the pixels' own cameras in the world."""
    rotation, position = T_world_cam[..., :3, :3], T_world_cam[..., :3, 3]
    if T_world_cam.ndim == 2:
        points: Array = local @ rotation.T + position
        return points
    points = np.einsum("rij,rcj->rci", rotation, local) + position[:, None]
    return points


def _project(camera: Camera, T_world_cam: Array, world: Array, grid: Array) -> tuple[Array, Mask]:
    """Pixels (H, W, 2) of points (H, W, 3), and whether they are in the image (H, W)."""
    T_cam_world = se3.inverse(T_world_cam)
    if T_world_cam.ndim == 2:
        return camera_models.project(camera, world @ T_cam_world[:3, :3].T + T_cam_world[:3, 3])
    last = len(T_cam_world) - 1
    row = grid[..., 1]
    for _ in range(_ROW_STEPS):
        # Between two rows the camera moves so little that its points move along straight lines.
        below = np.floor(row).clip(0, max(last - 1, 0)).astype(int)
        share = (row - below)[..., None]
        local = (1.0 - share) * _see(T_cam_world[below], world)
        local += share * _see(T_cam_world[np.minimum(below + 1, last)], world)
        pixels, inside = camera_models.project(camera, local)
        row = np.where(inside, pixels[..., 1], row).clip(0.0, last)
    return pixels, inside


def _see(T_cam_world: Array, world: Array) -> Array:
    """Points (H, W, 3) from poses (H, W, 4, 4)."""
    points: Array = np.einsum("hwij,hwj->hwi", T_cam_world[..., :3, :3], world) + T_cam_world[..., :3, 3]
    return points
