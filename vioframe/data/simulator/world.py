"""A world of axis-aligned boxes: one shell seen from inside, any number of solids seen from outside."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from vioframe.checks import Array
from vioframe.data.simulator.texture import LEVELS, Texture

RANGE_M = 180.0
"""Solids further away are not drawn."""

# Axes along the columns and rows of a face's texture, by the axis of its normal.
_U_AXIS = np.array([1, 0, 0])
_V_AXIS = np.array([2, 2, 1])


@dataclass(frozen=True, slots=True, kw_only=True)
class Skin:
    """What a face looks like.

    Attributes:
        texture: index.
        origin: world coordinates (u, v) in m of the texture's top-left corner; None fits the texture into
            the face (its size must be the face's, and a texel more on each side).
        gain: brightness.
    """

    texture: int
    origin: tuple[float, float] | None = None
    gain: float = 1.0


@dataclass(slots=True, kw_only=True, eq=False)
class WorldPlan:
    """What a builder collects.

    Attributes:
        textures: pictures of surfaces.
        lows, highs: corners of the solids, the shell first.
        skins: six a solid: low x, high x, low y, high y, low z, high z.
        moving: solids at the end of the list that move, with amplitude (3,) m, period s and phase rad.
    """

    textures: list[Texture] = field(default_factory=list)
    lows: list[Array] = field(default_factory=list)
    highs: list[Array] = field(default_factory=list)
    skins: list[Skin] = field(default_factory=list)
    moving: list[tuple[Array, float, float]] = field(default_factory=list)

    def add_texture(self, texture: Texture) -> int:
        """Index of a new texture."""
        self.textures.append(texture)
        return len(self.textures) - 1

    def add_solid(self, low: Array, high: Array, skins: Sequence[Skin]) -> None:
        """A box between two corners (3,)."""
        self.lows.append(np.asarray(low, dtype=float))
        self.highs.append(np.asarray(high, dtype=float))
        self.skins.extend(skins)


def swing(amplitude: Array, period_s: float, phase: float, t_s: Array) -> Array:
    """Offset (..., 3) m at times (...) of what moves: an ellipse in the plane, never at rest."""
    angle = 2.0 * np.pi * t_s / period_s + phase
    offset: Array = amplitude * np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)
    return offset


class World:
    """Faces of all solids as arrays, ready to be drawn. Face ``6 s + 2 a + side`` is on solid s, normal to axis a.

    Args:
        plan: what stands where.
    """

    def __init__(self, plan: WorldPlan) -> None:
        solids = len(plan.lows)
        self._rest_low, self._rest_high = np.array(plan.lows), np.array(plan.highs)
        self._moving = plan.moving
        self.low, self.high = self._rest_low.copy(), self._rest_high.copy()
        self._axis = np.tile(np.repeat([0, 1, 2], 2), solids)
        self.face_axis = self._axis.astype(np.int8)
        self.face_texture = np.array([skin.texture for skin in plan.skins])
        self.face_copy = (self.face_texture * LEVELS).astype(np.int32)
        self.face_gain = np.array(
            [skin.gain * plan.textures[skin.texture].gain for skin in plan.skins], dtype=np.float32
        )
        size = np.array([plan.textures[skin.texture].size_m for skin in plan.skins])
        # Rows run down: against z on upright faces, against y on level ones.
        self.texture_scales = (1.0 / size[:, 0]).astype(np.float32), (-1.0 / size[:, 1]).astype(np.float32)
        self._texel = np.array(
            [plan.textures[k.texture].size_m[0] / plan.textures[k.texture].image.shape[1] for k in plan.skins]
        )
        self._fitted = np.array([skin.origin is None for skin in plan.skins])
        self._skin_origin = np.array([skin.origin or (0.0, 0.0) for skin in plan.skins], dtype=float)
        self._arrange()

    def _arrange(self) -> None:
        """Limits of every face from the corners of the solids."""
        solid = np.arange(len(self._axis)) // 6
        side = np.arange(len(self._axis)) % 2
        low, high = self.low[solid], self.high[solid]
        face = np.arange(len(self._axis))
        u, v = _U_AXIS[self._axis], _V_AXIS[self._axis]
        self._plane = np.where(side == 1, high[face, self._axis], low[face, self._axis])
        self._limits = low[face, u], high[face, u], low[face, v], high[face, v]
        u_low, _, _, v_high = self._limits
        self._origin_u = np.where(self._fitted, u_low - self._texel, self._skin_origin[:, 0])
        self._origin_v = np.where(self._fitted, v_high + self._texel, self._skin_origin[:, 1])
        self._u, self._v = u, v

    def move_to(self, t_s: float) -> None:
        """Put the moving solids where they are at a time in s."""
        if not self._moving:
            return
        offsets = self.offsets(t_s)
        self.low, self.high = self._rest_low + offsets, self._rest_high + offsets
        # Textures of moving solids go with them since they are fitted.
        self._arrange()

    def offsets(self, t_s: float) -> Array:
        """By how much each solid (S, 3) m is off its place of rest at a time in s."""
        offsets = np.zeros_like(self._rest_low)
        first = len(offsets) - len(self._moving)
        for index, (amplitude, period_s, phase) in enumerate(self._moving):
            offsets[first + index] = swing(amplitude, period_s, phase, np.array(t_s))
        return offsets

    def relative_limits(self, origin: Array) -> tuple[Array, Array, Array, Array, Array]:
        """Distance along the normal's axis, and limits u_low, u_high, v_low, v_high (F,), as seen from a point (3,)."""
        u_low, u_high, v_low, v_high = self._limits
        from_u, from_v = origin[self._u], origin[self._v]
        return (
            self._plane - origin[self._axis],
            u_low - from_u,
            u_high - from_u,
            v_low - from_v,
            v_high - from_v,
        )

    def relative_texture_origins(self, origin: Array) -> tuple[Array, Array]:
        """Top-left corners (F,) of the textures as seen from a point (3,)."""
        return self._origin_u - origin[self._u], self._origin_v - origin[self._v]

    def face_axes(self, number: int) -> tuple[int, int, int]:
        """Axes of normal, columns and rows of one face."""
        axis = (number % 6) // 2
        return axis, int(_U_AXIS[axis]), int(_V_AXIS[axis])

    def facing_corners(self, origin: Array) -> tuple[np.ndarray, Array]:
        """Numbers (K,) and corners (K, 4, 3) of the faces of solids, within range, turned towards a point (3,)."""
        low, high = self.low[1:], self.high[1:]
        nearest = np.clip(origin, low, high)
        close = np.linalg.norm(nearest - origin, axis=1) < RANGE_M
        facing = np.stack([origin < low, origin > high], axis=-1) & close[:, None, None]
        numbers = np.flatnonzero(facing.ravel()) + 6
        solid, axis, side = numbers // 6, (numbers % 6) // 2, numbers % 2
        corners = np.empty((len(numbers), 4, 3))
        u, v = _U_AXIS[axis], _V_AXIS[axis]
        row = np.arange(len(numbers))
        ends = self.low[solid], self.high[solid]
        level = np.where(side == 1, ends[1][row, axis], ends[0][row, axis])
        for corner, (along_u, along_v) in enumerate(((0, 0), (1, 0), (1, 1), (0, 1))):
            corners[row, corner, axis] = level
            corners[row, corner, u] = ends[along_u][row, u]
            corners[row, corner, v] = ends[along_v][row, v]
        return numbers, corners

    def clearance(self, points: Array) -> Array:
        """Distance (N,) m from points (N, 3) to the nearest surface; negative outside the shell or inside a solid."""
        nearest: Array = np.minimum(points - self.low[0], self.high[0] - points).min(axis=1)
        if len(self.low) == 1:
            return nearest
        for begin in range(0, len(points), 256):
            part = slice(begin, begin + 256)
            gap = np.maximum(self.low[None, 1:] - points[part, None], points[part, None] - self.high[None, 1:])
            outside = np.linalg.norm(np.maximum(gap, 0.0), axis=2)
            distance = np.where(gap.max(axis=2) > 0.0, outside, gap.max(axis=2))
            nearest[part] = np.minimum(nearest[part], distance.min(axis=1))
        return nearest
