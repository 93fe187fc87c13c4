"""What the local map holds: landmarks and the keyframes of the window, and how views are found in it and extend it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vioframe.checks import Array, Stamps
from vioframe.geometry import se3
from vioframe.types import Camera, Tracks
from vioframe_geometric.landmarks import Landmarks
from vioframe_geometric.pose import View
from vioframe_geometric.rays import Rays, observe
from vioframe_geometric.tracking import Fix, PixelNoise, locate

# Rejected observations in a row after which a point is dropped.
MAX_STRIKES = 2
# The unit of length is the median depth of the first points; none is taken to be further than a thousand of them.
_MIN_INVERSE_DEPTH = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Keyframe:
    """A located view: pose (4, 4), ids (M,) ascending, and their rays."""

    T_map_cam: Array
    ids: Stamps
    rays: Rays


def make_keyframe(tracks: Tracks, rays: Rays, T_map_cam: Array) -> Keyframe:
    """Make a keyframe of a view whose rays are in the order of its tracks."""
    order = np.argsort(tracks.ids, kind="stable")
    return Keyframe(T_map_cam=T_map_cam, ids=tracks.ids[order], rays=rays.select(order))


class LocalMap:
    """Landmarks and keyframes in one frame and one unit of length.

    Args:
        camera: camera 0, which sees the points.
        noise: of a pixel coordinate; shared with whoever learns it.
        min_points: fewer agreeing points do not locate a view.

    Attributes:
        landmarks: the points.
        keyframes: of the window, the oldest first.
        scale_held: the scale is tied to a keyframe that has left the window.
        focal_px: mean focal length.
    """

    def __init__(self, camera: Camera, noise: PixelNoise, *, min_points: int) -> None:
        self.camera = camera
        self.noise = noise
        self.min_points = min_points
        self.focal_px = float(np.mean(camera.intrinsics_px[:2]))
        self.landmarks = Landmarks(_MIN_INVERSE_DEPTH)
        self.keyframes: list[Keyframe] = []
        self.scale_held = False

    def view(self, tracks: Tracks) -> View:
        """Rays of all tracks."""
        return View(rays=observe(self.camera, tracks.bearings), seen=np.ones(len(tracks), dtype=bool))

    def locate(self, tracks: Tracks, starts: Sequence[Array]) -> Fix | None:
        """Find a view in the map, or None; ``starts`` (4, 4) are tried in order."""
        return locate(
            self.landmarks,
            tracks.ids,
            [self.view(tracks)],
            starts,
            sigma_px=self.noise.sigma_px,
            min_inliers=self.min_points,
        )

    def depths(self, T_map_cam: Array) -> Array:
        """Depths (M,) of the points that lie before the camera at a pose."""
        points = self.landmarks.points(np.arange(len(self.landmarks)))
        depth: Array = (points - T_map_cam[:3, 3]) @ T_map_cam[:3, 2]
        return depth[depth > 0.0]

    def add(self, ids: Stamps, T_map_cam: Array, rays: Rays, inverse_depth: Array, spread: float) -> None:
        """Add landmarks anchored at a view, with a standard deviation ``spread`` of their inverse depth."""
        depth = rays.axes[:, 2:]
        inverse_slope = np.linalg.inv(rays.rows[:, :, :2] * depth[..., None])
        covariance = np.zeros((len(ids), 3, 3))
        covariance[:, :2, :2] = self.noise.sigma_px**2 * inverse_slope @ np.swapaxes(inverse_slope, -1, -2)
        covariance[:, 2, 2] = spread**2
        inverse_depth = np.maximum(inverse_depth, _MIN_INVERSE_DEPTH)
        self.landmarks.add(ids, T_map_cam, rays.axes[:, :2] / depth, inverse_depth, covariance)

    def extend(self, tracks: Tracks, view: View, T_map_cam: Array, *, drift_px: float) -> None:
        """Drop what neither a view nor a keyframe sees, let patches slide, take new points at a typical depth.

        Args:
            tracks, view: what is seen.
            T_map_cam: (4, 4) from where.
            drift_px: how far the patch of a point slides over the scene from image to image.
        """
        landmarks = self.landmarks
        seen = [tracks.ids, *(keyframe.ids for keyframe in self.keyframes)]
        wanted = np.isin(landmarks.ids, np.concatenate(seen))
        landmarks.keep(wanted & (landmarks.strikes < MAX_STRIKES))
        slide = (drift_px / self.focal_px) ** 2
        landmarks.covariance[:, 0, 0] += slide
        landmarks.covariance[:, 1, 1] += slide
        depth = self.depths(T_map_cam)
        if len(depth) == 0:
            return
        typical = float(np.median(1.0 / depth))
        _, known = landmarks.find(tracks.ids)
        rows = np.flatnonzero(~known)
        self.add(tracks.ids[rows], T_map_cam, view.rays.select(rows), np.full(len(rows), typical), typical)

    def rescale(self, factor: float) -> None:
        """Multiply all lengths by ``factor``, about the oldest keyframe."""
        centre = self.keyframes[0].T_map_cam[:3, 3].copy()
        self.landmarks.rescale(factor, centre)
        self.keyframes = [
            replace(
                keyframe,
                T_map_cam=se3.from_parts(
                    keyframe.T_map_cam[:3, :3], centre + factor * (keyframe.T_map_cam[:3, 3] - centre)
                ),
            )
            for keyframe in self.keyframes
        ]
