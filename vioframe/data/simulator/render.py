"""Draws a world of boxes as a camera sees it: one exact ray a pixel, four where surfaces meet.

For each pixel the ray through its centre is cut with the shell and with the faces of boxes that can be seen
there; the nearest hit gives depth and surface, and the surface's texture is looked up at the hit at the
resolution of the pixel's footprint. Rays come from the distorted pixel, so no image is ever resampled, and
depth is exact.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from vioframe.checks import Array
from vioframe.data.simulator.texture import LEVELS, Atlas
from vioframe.data.simulator.world import World
from vioframe.geometry import camera as camera_models
from vioframe.types import Camera

# Beyond this angle from the optical axis the plane at depth one runs off to infinity; such pixels stay black.
_WIDEST = np.tan(np.deg2rad(84.0))
_NEAR_M = 0.02
_BAND_ROWS = 48
# OpenCV looks up at most 32767 pixels in a row.
_SMOOTH_CHUNK = 16_384
# Four samples of a pixel, no two in one row or column.
_SUBSAMPLES = np.array([[-0.375, -0.125], [-0.125, 0.375], [0.125, -0.375], [0.375, 0.125]], dtype=np.float32)
# Below 1 the copy chosen is finer than the footprint: sharper, at the price of a little aliasing.
_SHARPNESS = 0.7


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """What the camera sees.

    Attributes:
        grey: (H, W) float32, 0 … 255, before the sensor; black outside the field of view.
        depth: (H, W) float32 m along the optical axis; 0 outside the field of view.
        face: (H, W) index of the surface seen.
    """

    grey: np.ndarray
    depth: np.ndarray
    face: np.ndarray


@dataclass(slots=True, kw_only=True, eq=False)
class _Tables:
    """Numbers of every face for one camera position, float32, indexed by face.

    ``plane``, ``low`` and ``high`` are relative to the camera: distance along the normal's axis, and limits
    along the other two.
    """

    plane: np.ndarray
    u_low: np.ndarray
    u_high: np.ndarray
    v_low: np.ndarray
    v_high: np.ndarray
    u_scale: np.ndarray
    u_shift: np.ndarray
    v_scale: np.ndarray
    v_shift: np.ndarray
    detail: np.ndarray


class Renderer:
    """Draws one world through one camera.

    Args:
        world: the place.
        atlas: its textures.
        camera: calibration; ``T_body_cam`` is not used.
    """

    def __init__(self, world: World, atlas: Atlas, camera: Camera) -> None:
        self._world = world
        self._atlas = atlas
        width, height = camera.size_px
        grid = np.stack(np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float)), axis=-1)
        ideal = camera_models.normalised(camera, grid)
        # Beyond a right angle the inverse of the distortion is meaningless, which the way back shows.
        again = camera_models.distort(camera, ideal) * camera.intrinsics_px[:2] + camera.intrinsics_px[2:]
        self._blind = (np.linalg.norm(ideal, axis=-1) > _WIDEST) | (np.abs(again - grid).max(axis=-1) > 0.01)
        ideal[self._blind] = 0.0
        self._x = np.ascontiguousarray(ideal[..., 0], dtype=np.float32)
        self._y = np.ascontiguousarray(ideal[..., 1], dtype=np.float32)
        self._length = np.sqrt(1.0 + self._x**2 + self._y**2)
        self._x_per_column = np.gradient(self._x, axis=1)
        self._x_per_row = np.gradient(self._x, axis=0)
        self._y_per_column = np.gradient(self._y, axis=1)
        self._y_per_row = np.gradient(self._y, axis=0)
        # A face that spans [a, b] at depth one can only be in columns whose rays reach into [a, b]; made
        # monotone so that a binary search finds them.
        self._column_high = np.maximum.accumulate(self._x.max(axis=0))
        self._column_low = np.minimum.accumulate(self._x.min(axis=0)[::-1])[::-1]
        self._row_high = np.maximum.accumulate(self._y.max(axis=1))
        self._row_low = np.minimum.accumulate(self._y.min(axis=1)[::-1])[::-1]
        self._focal_px = float(np.sqrt(camera.intrinsics_px[0] * camera.intrinsics_px[1]))
        self._shape = (height, width)
        # Light falls off towards the corners as in a common lens: to 0.8 at 40°, to 0.4 at 80°.
        self._falloff = np.cos(0.65 * np.arctan(np.hypot(self._x, self._y))).astype(np.float32) ** 2
        # Columns are rays: all world directions are one matrix product.
        self._rays = np.stack([self._x.ravel(), self._y.ravel(), np.ones(height * width, np.float32)])

    def render(self, T_world_cam: Array, *, smooth_edges: bool = True) -> View:
        """Draw the world.

        Args:
            T_world_cam: (4, 4) for all rows at once, or (H, 4, 4) for a shutter that rolls down the rows.
            smooth_edges: average four rays where surfaces meet.
        """
        rolling = T_world_cam.ndim == 3
        middle = T_world_cam[len(T_world_cam) // 2] if rolling else T_world_cam
        origin = middle[:3, 3]
        tables = self._tables(origin)
        shift: np.ndarray | None = None
        if rolling:
            rays = self._rays.reshape(3, *self._shape)
            directions = np.einsum("rij,jrc->irc", T_world_cam[:, :3, :3].astype(np.float32), rays)
            shift = (T_world_cam[:, :3, 3] - origin).astype(np.float32).T[:, :, None]
        else:
            directions = (middle[:3, :3].astype(np.float32) @ self._rays).reshape(3, *self._shape)
        with np.errstate(divide="ignore"):
            inverse = 1.0 / directions
        depth, face = self._cast(tables, T_world_cam, directions, inverse, shift)
        grey = self._shade_all(tables, depth, face, directions, shift)
        if smooth_edges:
            self._smooth(tables, T_world_cam, depth, face, grey, shift)
        grey *= self._falloff
        if self._blind.any():
            grey[self._blind] = 0.0
            depth[self._blind] = 0.0
        return View(grey=grey, depth=depth, face=face)

    def _tables(self, origin: Array) -> _Tables:
        world, atlas = self._world, self._atlas
        plane, u_low, u_high, v_low, v_high = world.relative_limits(origin)
        u_origin, v_origin = world.relative_texture_origins(origin)
        u_scale, v_scale = world.texture_scales
        density = atlas.texels_per_metre[world.face_texture]
        distance = np.maximum(np.abs(plane), 1e-3)
        single = np.float32
        return _Tables(
            plane=plane.astype(single),
            u_low=u_low.astype(single),
            u_high=u_high.astype(single),
            v_low=v_low.astype(single),
            v_high=v_high.astype(single),
            u_scale=u_scale,
            u_shift=np.mod(-u_origin * u_scale, 1.0).astype(single),
            v_scale=v_scale,
            v_shift=np.mod(-v_origin * v_scale, 1.0).astype(single),
            detail=(_SHARPNESS * np.sqrt(2.0) * (density / self._focal_px) ** 2 / distance).astype(single),
        )

    def _cast(
        self,
        tables: _Tables,
        T_world_cam: Array,
        directions: np.ndarray,
        inverse: np.ndarray,
        shift: np.ndarray | None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Depth (H, W) and face (H, W) of the nearest hit of every ray."""
        depth = np.empty(self._shape, np.float32)
        face = np.empty(self._shape, np.intp)
        for begin in range(0, self._shape[0], _BAND_ROWS):
            rows = slice(begin, begin + _BAND_ROWS)
            self._cast_shell(tables, directions[:, rows], inverse[:, rows], shift, rows, depth[rows], face[rows])
        for number, top, bottom, left, right, closest in self._candidates(T_world_cam):
            window = (slice(top, bottom), slice(left, right))
            near = depth[window]
            if closest > near.max():
                continue
            a, u, v = self._world.face_axes(number)
            plane = tables.plane[number]
            if shift is None:
                hit = plane * inverse[a][window]
                along_u = hit * directions[u][window]
                along_v = hit * directions[v][window]
            else:
                moved = shift[:, top:bottom]
                hit = (plane - moved[a]) * inverse[a][window]
                along_u = hit * directions[u][window] + moved[u]
                along_v = hit * directions[v][window] + moved[v]
            seen = hit < near
            seen &= hit > 0.0
            seen &= along_u >= tables.u_low[number]
            seen &= along_u <= tables.u_high[number]
            seen &= along_v >= tables.v_low[number]
            seen &= along_v <= tables.v_high[number]
            np.copyto(near, hit, where=seen)
            np.copyto(face[window], number, where=seen)
        return depth, face

    def _cast_shell(
        self,
        tables: _Tables,
        directions: np.ndarray,
        inverse: np.ndarray,
        shift: np.ndarray | None,
        rows: slice,
        depth: np.ndarray,
        face: np.ndarray,
    ) -> None:
        """Where rays leave the shell, from whose inside the world is seen; fills depth and face."""
        depth[...] = np.inf
        for axis in range(3):
            low, high = tables.plane[2 * axis], tables.plane[2 * axis + 1]
            if shift is None:
                behind, ahead = low * inverse[axis], high * inverse[axis]
            else:
                behind, ahead = (low - shift[axis, rows]) * inverse[axis], (high - shift[axis, rows]) * inverse[axis]
            # Of the two walls one is behind; which, also tells a ray along them (±∞) rightly.
            forward = ahead > behind
            leave = np.maximum(behind, ahead, out=ahead)
            nearer = leave < depth
            np.copyto(depth, leave, where=nearer)
            np.copyto(face, 2 * axis + forward, where=nearer)

    def _candidates(self, T_world_cam: Array) -> list[tuple[int, int, int, int, int, float]]:
        """Faces of boxes that may be seen, nearest first, with the rows and columns they lie within and least depth."""
        poses = T_world_cam[[0, len(T_world_cam) // 2, -1]] if T_world_cam.ndim == 3 else T_world_cam[None]
        numbers, corners = self._world.facing_corners(poses[len(poses) // 2][:3, 3])
        if len(numbers) == 0:
            return []
        bounds = []
        for pose in poses:
            local = (corners - pose[:3, 3]) @ pose[:3, :3]
            bounds.append(_bounds_at_depth_one(local))
        x0, y0 = (np.min([b[i] for b in bounds], axis=0) for i in (0, 1))
        x1, y1 = (np.max([b[i] for b in bounds], axis=0) for i in (2, 3))
        nearest = np.min([b[4] for b in bounds], axis=0)
        margin = 1 if len(poses) == 1 else 3
        height, width = self._shape
        left = np.maximum(np.searchsorted(self._column_high, x0) - margin, 0)
        right = np.minimum(np.searchsorted(self._column_low, x1, side="right") + margin, width)
        top = np.maximum(np.searchsorted(self._row_high, y0) - margin, 0)
        bottom = np.minimum(np.searchsorted(self._row_low, y1, side="right") + margin, height)
        shown = (right - left > 2 * margin) & (bottom - top > 2 * margin)
        order = np.flatnonzero(shown)[np.argsort(nearest[shown], kind="stable")]
        return [
            (int(numbers[i]), int(top[i]), int(bottom[i]), int(left[i]), int(right[i]), float(nearest[i]))
            for i in order
        ]

    def _shade_all(
        self,
        tables: _Tables,
        depth: np.ndarray,
        face: np.ndarray,
        directions: np.ndarray,
        shift: np.ndarray | None,
    ) -> np.ndarray:
        grey = np.empty(self._shape, np.float32)
        for begin in range(0, self._shape[0], _BAND_ROWS):
            rows = slice(begin, begin + _BAND_ROWS)
            moved = None if shift is None else shift[:, rows]
            grey[rows] = self._shade(tables, depth[rows], face[rows], directions[:, rows], self._length[rows], moved)
        return grey

    def _shade(
        self,
        tables: _Tables,
        depth: np.ndarray,
        face: np.ndarray,
        directions: np.ndarray,
        length: np.ndarray,
        shift: np.ndarray | None,
    ) -> np.ndarray:
        """Brightness of hits, all arrays of one two-dimensional shape."""
        world, atlas = self._world, self._atlas
        axis = world.face_axis.take(face)
        x, y, z = directions[0] * depth, directions[1] * depth, directions[2] * depth
        if shift is not None:
            x, y, z = x + shift[0], y + shift[1], z + shift[2]
        u = np.where(axis == 0, y, x)
        v = np.where(axis == 2, y, z)
        u *= tables.u_scale.take(face)
        u += tables.u_shift.take(face)
        u -= np.floor(u)
        v *= tables.v_scale.take(face)
        v += tables.v_shift.take(face)
        v -= np.floor(v)
        # Footprint² in texels: (depth/f)² · length·depth/distance, the last being 1/cos of the incidence;
        # its binary exponent counts half octaves.
        footprint = depth * depth
        footprint *= depth
        footprint *= length
        footprint *= tables.detail.take(face)
        level = (footprint.view(np.int32) >> 23) - 127
        np.clip(level, 0, LEVELS - 1, out=level)
        copy = level + world.face_copy.take(face)
        u *= atlas.width.take(copy)
        u += atlas.left.take(copy)
        u -= np.float32(0.5)
        v *= atlas.height.take(copy)
        v += atlas.top.take(copy)
        v -= np.float32(0.5)
        looked_up = cv2.remap(atlas.image, u, v, cv2.INTER_LINEAR)
        shaded: np.ndarray = looked_up * world.face_gain.take(face)
        return shaded

    def _smooth(
        self,
        tables: _Tables,
        T_world_cam: Array,
        depth: np.ndarray,
        face: np.ndarray,
        grey: np.ndarray,
        shift: np.ndarray | None,
    ) -> None:
        """Replace the pixels where two surfaces meet by the mean of four rays; each ray sees one of the two."""
        other = face.copy()
        for own, far in (
            (np.s_[:, 1:], np.s_[:, :-1]),
            (np.s_[:, :-1], np.s_[:, 1:]),
            (np.s_[1:], np.s_[:-1]),
            (np.s_[:-1], np.s_[1:]),
        ):
            np.copyto(other[own], face[far], where=face[own] != face[far])
        pixels = np.flatnonzero(other.ravel() != face.ravel())
        for begin in range(0, len(pixels), _SMOOTH_CHUNK):
            part = pixels[begin : begin + _SMOOTH_CHUNK]
            grey.ravel()[part] = self._mean_of_rays(tables, T_world_cam, depth, face, other, part, shift)

    def _mean_of_rays(
        self,
        tables: _Tables,
        T_world_cam: Array,
        depth: np.ndarray,
        face: np.ndarray,
        other: np.ndarray,
        pixels: np.ndarray,
        shift: np.ndarray | None,
    ) -> np.ndarray:
        """Brightness (N,) of pixels, given by flat index, each of which holds two surfaces."""
        pair = face.ravel()[pixels], other.ravel()[pixels]
        rows = pixels // self._shape[1]
        across, down = _SUBSAMPLES[:, :1], _SUBSAMPLES[:, 1:]
        ray_x, ray_y = (
            base.ravel()[pixels] + across * per_column.ravel()[pixels] + down * per_row.ravel()[pixels]
            for base, per_column, per_row in (
                (self._x, self._x_per_column, self._x_per_row),
                (self._y, self._y_per_column, self._y_per_row),
            )
        )
        rays = np.stack([ray_x, ray_y, np.ones_like(ray_x)])
        moved = None if shift is None else np.broadcast_to(shift[:, rows, 0][:, None], rays.shape)
        if shift is None:
            directions = (T_world_cam[:3, :3].astype(np.float32) @ rays.reshape(3, -1)).reshape(rays.shape)
        else:
            directions = np.einsum("nij,jkn->ikn", T_world_cam[rows, :3, :3].astype(np.float32), rays)
        hit_depth = np.full(ray_x.shape, np.inf, np.float32)
        hit_face = np.broadcast_to(pair[0], ray_x.shape).copy()
        for numbers in pair:
            self._try_faces(tables, numbers, directions, moved, hit_depth, hit_face)
        # A ray that just misses both sees the pixel's own surface.
        np.copyto(hit_depth, depth.ravel()[pixels], where=~np.isfinite(hit_depth))
        length = np.broadcast_to(self._length.ravel()[pixels], ray_x.shape)
        shaded: np.ndarray = self._shade(tables, hit_depth, hit_face, directions, length, moved).mean(axis=0)
        return shaded

    def _try_faces(
        self,
        tables: _Tables,
        numbers: np.ndarray,
        directions: np.ndarray,
        shift: np.ndarray | None,
        hit_depth: np.ndarray,
        hit_face: np.ndarray,
    ) -> None:
        """Cut rays (3, K, N) with one face each (N,); nearer hits replace those in ``hit_depth`` and ``hit_face``."""
        axis = self._world.face_axis.take(numbers)
        moved = np.zeros((3, 1, 1), np.float32) if shift is None else shift
        first, second, third = directions
        normal = np.where(axis == 0, first, np.where(axis == 1, second, third))
        with np.errstate(divide="ignore", invalid="ignore"):
            plane = tables.plane.take(numbers) - np.where(axis == 0, moved[0], np.where(axis == 1, moved[1], moved[2]))
            hit = plane / normal
            u = np.where(axis == 0, second * hit + moved[1], first * hit + moved[0])
            v = np.where(axis == 2, second * hit + moved[1], third * hit + moved[2])
        # A hair of tolerance, or rays along a shared edge would fall through it.
        slack = np.float32(1e-4) * np.abs(hit)
        seen = (
            (hit > 0.0)
            & (hit < hit_depth)
            & (u >= tables.u_low.take(numbers) - slack)
            & (u <= tables.u_high.take(numbers) + slack)
            & (v >= tables.v_low.take(numbers) - slack)
            & (v <= tables.v_high.take(numbers) + slack)
        )
        np.copyto(hit_depth, hit, where=seen)
        np.copyto(hit_face, numbers, where=seen)


def _bounds_at_depth_one(corners: Array) -> tuple[Array, Array, Array, Array, Array]:
    """Bounds x0, y0, x1, y1 (F,) at depth one, and least depth, of quadrangles (F, 4, 3) in the camera frame.

    They are cut at the near plane first.
    """
    following = np.roll(corners, -1, axis=1)
    z0, z1 = corners[..., 2], following[..., 2]
    crossing = (z0 > _NEAR_M) != (z1 > _NEAR_M)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(crossing, (_NEAR_M - z0) / (z1 - z0), 0.0)
    cut = corners + share[..., None] * (following - corners)
    points = np.concatenate([corners, cut], axis=1)
    valid = np.concatenate([z0 > _NEAR_M, crossing], axis=1)
    depth = np.where(valid, np.maximum(points[..., 2], _NEAR_M), 1.0)
    x, y = points[..., 0] / depth, points[..., 1] / depth
    return (
        np.where(valid, x, np.inf).min(axis=1),
        np.where(valid, y, np.inf).min(axis=1),
        np.where(valid, x, -np.inf).max(axis=1),
        np.where(valid, y, -np.inf).max(axis=1),
        np.where(valid, depth, np.inf).min(axis=1),
    )
