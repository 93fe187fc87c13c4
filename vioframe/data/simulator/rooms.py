"""Rooms, halls and corridors, built around a motion so that nothing stands in its way."""

import logging
from collections.abc import Callable

import numpy as np

from vioframe.checks import Array
from vioframe.data.simulator import materials
from vioframe.data.simulator.texture import Texture
from vioframe.data.simulator.world import Skin, WorldPlan, swing

log = logging.getLogger(__name__)

PATH_STEP_S = 0.1
"""Time between the points of the path that a place is built around."""
CLEARANCE_M = 0.45
"""What furniture leaves free around the path of the body; walls leave more."""

Painter = Callable[[np.random.Generator, tuple[int, int], float], np.ndarray]


class RoomBuilder:
    """Furnishes a room around a path.

    Args:
        rng: generator.
        path: (N, 3) m, where the body is every ``PATH_STEP_S``.
        low, high: (3,) m, corners of the room.
        texels_per_metre: resolution of walls.
        contrast: 1 for full texture, towards 0 for bare surfaces.
    """

    def __init__(
        self,
        rng: np.random.Generator,
        path: Array,
        low: Array,
        high: Array,
        *,
        texels_per_metre: float,
        contrast: float = 1.0,
    ) -> None:
        self._rng = rng
        self._path = path
        self._low, self._high = low, high
        self._ppm = texels_per_metre
        self._contrast = contrast
        self.plan = WorldPlan()
        self._taken: list[tuple[Array, Array]] = []

    def _texture(self, image: np.ndarray, ppm: float, extent: tuple[float, float] | None = None) -> int:
        flat = image.astype(np.float32)
        image = np.clip(flat.mean() + self._contrast * (flat - flat.mean()) + 0.5, 0, 255).astype(np.uint8)
        size = (image.shape[1] / ppm, image.shape[0] / ppm)
        if extent is not None:
            # One more texel around a fitted picture, so that its border never shows the opposite one.
            size = (extent[0] * (1 + 2 / image.shape[1]), extent[1] * (1 + 2 / image.shape[0]))
        return self.plan.add_texture(Texture(image=image, size_m=size))

    def _fitted(self, painter: Painter, width_m: float, height_m: float, dark: float = 0.4) -> int:
        shape = max(round(height_m * self._ppm), 16), max(round(width_m * self._ppm), 16)
        image = materials.occlude_edges(painter(self._rng, shape, self._ppm), self._ppm, depth=dark)
        return self._texture(image, self._ppm, (width_m, height_m))

    def build_shell(self, *, floor: Painter, windows: bool) -> None:
        """Walls, floor and ceiling."""
        size = self._high - self._low
        base = float(self._rng.uniform(140, 175))

        def paint_wall(rng: np.random.Generator, shape: tuple[int, int], ppm: float) -> np.ndarray:
            return materials.wall(rng, shape, ppm, windows=windows, base=base + rng.uniform(-18, 12))

        skins = [Skin(texture=self._fitted(paint_wall, size[1], size[2])) for _ in range(2)]
        skins += [Skin(texture=self._fitted(paint_wall, size[0], size[2])) for _ in range(2)]
        skins.append(Skin(texture=self._fitted(floor, size[0], size[1])))
        skins.append(Skin(texture=self._fitted(materials.ceiling, size[0], size[1], 0.25)))
        self.plan.add_solid(self._low, self._high, skins)

    def add_block(self, low: Array, high: Array) -> None:
        """A block of masonry between two corners (3,), from floor to ceiling."""
        base = float(self._rng.uniform(125, 180))

        def paint_wall(rng: np.random.Generator, shape: tuple[int, int], ppm: float) -> np.ndarray:
            return materials.wall(rng, shape, ppm, windows=False, base=base)

        unseen = Skin(texture=0, origin=(0.0, 0.0))
        skins = []
        for axis in (0, 1):
            for corner, shell in ((low, self._low), (high, self._high)):
                against_shell = abs(corner[axis] - shell[axis]) < 1e-6
                size = (high - low)[1 - axis], (high - low)[2]
                skins.append(unseen if against_shell else Skin(texture=self._fitted(paint_wall, *size)))
        self.plan.add_solid(low, high, [*skins, unseen, unseen])
        self._taken.append((low, high))

    def prepare_furniture(self, variety: int = 1) -> None:
        """Paint what furniture is made of, ``variety`` times as many pictures of each kind."""
        ppm = 1.2 * self._ppm

        def shape(width: float, height: float) -> tuple[int, int]:
            return round(height * ppm), round(width * ppm)

        def many(count: int) -> range:
            return range(count * variety)

        rng = self._rng
        self._books = [self._texture(materials.books(rng, shape(1.6, 2.1), ppm), ppm) for _ in many(2)]
        self._fronts = [self._texture(materials.drawers(rng, shape(1.0, 1.2), ppm), ppm) for _ in many(2)]
        self._cartons = [self._texture(materials.carton(rng, shape(0.7, 0.6), ppm), ppm) for _ in many(3)]
        self._boards = [self._texture(materials.planks(rng, shape(1.2, 1.2), ppm, b, 0.2), ppm) for b in (85.0, 140.0)]
        self._cloth = self._texture(materials.fabric(rng, shape(1.2, 1.2), ppm), ppm)
        self._tiled = self._texture(materials.tiles(rng, shape(1.2, 1.2), ppm, 150.0, 0.2), ppm)
        self._posters = [self._texture(materials.picture(rng, shape(0.8, 1.1), ppm), ppm) for _ in many(4)]

    def _is_free(self, low: Array, high: Array, *, among: bool = True) -> bool:
        gap = np.maximum(low - self._path, self._path - high)
        if np.linalg.norm(np.maximum(gap, 0.0), axis=1).min() < CLEARANCE_M:
            return False
        if np.any(low < self._low - 1e-6) or np.any(high > self._high + 1e-6):
            return False
        return not among or all(np.any(low >= b - 0.02) or np.any(high <= a + 0.02) for a, b in self._taken)

    def _add(self, low: Array, high: Array, side: int | list[int], top: int) -> None:
        sides = side if isinstance(side, list) else [side] * 4
        light = self._rng.uniform(0.85, 1.1)
        gains = (0.82, 0.9, 1.0, 0.94, 0.5, 1.12)
        axes = ((1, 2), (1, 2), (0, 2), (0, 2), (0, 1), (0, 1))
        textures = [*sides, top, top]
        self.plan.add_solid(
            low,
            high,
            [
                Skin(texture=t, origin=(float(low[u]), float(high[v])), gain=light * g)
                for t, g, (u, v) in zip(textures, gains, axes, strict=True)
            ],
        )

    def _try(self, low: Array, high: Array, side: int | list[int], top: int) -> bool:
        if not self._is_free(low, high):
            return False
        self._add(low, high, side, top)
        self._taken.append((low, high))
        return True

    def furnish_walls(self, per_metre: float, *, deepest_m: float = 0.55) -> None:
        """Shelves, cabinets, cartons and crates along the four walls."""
        for axis in (0, 1):
            for inward, limit in ((1, self._low), (-1, self._high)):
                self.furnish_wall(
                    axis,
                    (self._low[axis], self._high[axis]),
                    limit[1 - axis],
                    inward,
                    per_metre=per_metre,
                    deepest_m=deepest_m,
                )

    def furnish_wall(
        self, axis: int, span: tuple[float, float], at: float, inward: int, *, per_metre: float, deepest_m: float
    ) -> None:
        """Shelves, cabinets, cartons and crates along one wall.

        Args:
            axis: 0 or 1, that the wall runs along.
            span: m, its ends on that axis.
            at: m, where it stands on the other.
            inward: 1 where the room lies on the side of larger coordinates, else -1.
            per_metre: pieces on a metre, as far as there is room.
            deepest_m: largest depth of a piece.
        """
        rng = self._rng
        length, other = span[1] - span[0], 1 - axis
        for _ in range(int(length * per_metre * 2)):
            width = rng.uniform(0.4, 1.3)
            depth = rng.uniform(0.25, 1.0) * deepest_m
            kind = rng.integers(4)
            shortest, tallest = ((1.5, 2.1), (0.7, 1.2), (0.3, 0.7), (0.4, 1.6))[kind]
            height = rng.uniform(shortest, tallest)
            low, high = np.zeros(3), np.zeros(3)
            low[axis] = span[0] + rng.uniform(0.0, max(length - width, 0.1))
            high[axis] = low[axis] + width
            low[other] = at if inward > 0 else at - depth
            high[other] = low[other] + depth
            low[2], high[2] = self._low[2], self._low[2] + height
            wood = int(rng.choice(self._boards))
            front = (
                int(rng.choice(self._books)),
                int(rng.choice(self._fronts)),
                int(rng.choice(self._cartons)),
                int(rng.choice([*self._boards, self._cloth])),
            )[kind]
            flank = front if kind >= 2 else wood
            # Shelves and cabinets have their front towards the room, and plain wood at the flanks.
            sides = [front, front, flank, flank] if axis == 1 else [flank, flank, front, front]
            if self._try(low, high, sides, wood) and kind in (1, 3):
                self._stack(low, high)

    def _stack(self, low: Array, high: Array) -> None:
        """Something small on top of a piece."""
        rng = self._rng
        size = np.array([rng.uniform(0.15, 0.4), rng.uniform(0.15, 0.4), rng.uniform(0.12, 0.4)])
        size[:2] = np.minimum(size[:2], 0.9 * (high - low)[:2])
        at = low + rng.uniform(0, 1, 3) * (high - low - size)
        at[2] = high[2]
        self._try(at, at + size, int(self._rng.choice([*self._cartons, *self._books])), int(rng.choice(self._cartons)))

    def furnish_floor(self, count: int) -> None:
        """Tables, crates, cartons and pillars that stand free."""
        rng = self._rng
        for attempt in range(12 * count):
            if count <= 0:
                return
            kind = rng.integers(4)
            if kind == 0:
                placed = self._table(np.array([rng.uniform(0.8, 1.5), rng.uniform(0.6, 0.9), rng.uniform(0.6, 0.78)]))
            elif kind == 1:
                size = np.array([0.3, 0.3, self._high[2] - self._low[2]]) * (*rng.uniform(0.8, 1.4, 2), 1.0)
                low = self._somewhere(size)
                placed = attempt % 2 == 0 and self._try(low, low + size, self._tiled, self._tiled)
            else:
                size = rng.uniform((0.3, 0.3, 0.3), (0.8, 0.8, 1.0))
                low = self._somewhere(size)
                wood = int(rng.choice([*self._cartons, *self._boards, self._cloth]))
                placed = self._try(low, low + size, wood, wood)
                if placed:
                    self._stack(low, low + size)
            count -= int(placed)

    def hang_lamps(self, count: int) -> None:
        """Lamps on cords."""
        for _ in range(4 * count):
            if count <= 0:
                return
            size = np.array([0.3, 0.3, 0.18])
            low = self._somewhere(size)
            low[2] = self._high[2] - self._rng.uniform(0.4, 0.7)
            if self._try(low, low + size, self._cloth, self._tiled):
                cord = np.array([0.015, 0.015, 0.0])
                middle = low + 0.5 * size
                top = np.array([middle[0], middle[1], self._high[2]])
                self._add(np.array([*(middle[:2] - cord[:2]), low[2] + size[2]]), top + cord, self._tiled, self._tiled)
                count -= 1

    def set_moving(self, count: int, speed: float = 0.8) -> None:
        """Boxes, as large as people, that circle through the room and cross the path before and after the body."""
        rng = self._rng
        elapsed = PATH_STEP_S * np.arange(len(self._path))
        placed = 0
        for attempt in range(200 * count):
            if placed == count:
                return
            size = np.array([*rng.uniform(0.35, 0.5, 2), rng.uniform(1.2, 1.8)])
            size[2] = min(size[2], 0.9 * (self._high - self._low)[2])
            reach = np.array([*rng.uniform(0.3, 1.2, 2), 0.0])
            room = self._high - self._low - size - 2.0 * reach
            if room.min() <= 0.0:
                continue
            low = self._low + reach + rng.uniform(0, 1, 3) * room
            low[2] = self._low[2]
            period_s, phase = 2.0 * np.pi * float(reach[:2].mean()) / speed, float(rng.uniform(0, 2.0 * np.pi))
            at = low + swing(reach, period_s, phase, elapsed)
            gap = np.maximum(np.maximum(at - self._path, self._path - at - size), 0.0)
            if np.linalg.norm(gap, axis=1).min() < CLEARANCE_M:
                continue
            # Through furniture only where there is no other way.
            swept = low - reach, low + size + reach
            if attempt < 100 * count and any(
                np.all(swept[0] < taken_high) and np.all(swept[1] > taken_low) for taken_low, taken_high in self._taken
            ):
                continue
            picture = self.plan.textures[int(rng.choice(self._posters))]
            extent = float(size[:2].max()), float(size[2])
            coat = self.plan.add_texture(Texture(image=picture.image, size_m=extent))
            self.plan.add_solid(low, low + size, [Skin(texture=coat, gain=g) for g in (0.9, 0.9, 1.0, 1.0, 0.5, 1.1)])
            self.plan.moving.append((reach, period_s, phase))
            placed += 1
        if placed < count:
            log.warning("dataset.degradations.moving_objects=%d: only %d find room to move here", count, placed)

    def _table(self, size: Array) -> bool:
        low = self._somewhere(size)
        high = low + size
        if not self._is_free(low, high):
            return False
        self._taken.append((low, high))
        wood, leg = int(self._rng.choice(self._boards)), 0.05
        self._add(np.array([low[0], low[1], high[2] - 0.04]), high, wood, wood)
        for x in (low[0] + 0.03, high[0] - 0.03 - leg):
            for y in (low[1] + 0.03, high[1] - 0.03 - leg):
                self._add(np.array([x, y, low[2]]), np.array([x + leg, y + leg, high[2] - 0.04]), wood, wood)
        self._stack(low, high)
        self._stack(low, high)
        return True

    def _somewhere(self, size: Array) -> Array:
        room = self._high - self._low - size
        low = self._low + self._rng.uniform(0, 1, 3) * np.maximum(room, 0.0)
        low[2] = self._low[2]
        return low


def build_room(
    rng: np.random.Generator, path: Array, *, place: str, contrast: float = 1.0, moving: int = 0
) -> WorldPlan:
    """A room, hall or corridor around a path (N, 3) m."""
    low, high = path.min(axis=0), path.max(axis=0)
    floor = 0.0 if 0.35 < low[2] < 2.0 else low[2] - 0.7
    if place == "corridor":
        low = np.array([low[0] - 1.6, low[1] - 1.05, floor])
        high = np.array([high[0] + 1.6, high[1] + 1.05, max(floor + 2.7, high[2] + 0.6)])
    else:
        margin = (1.0, 1.6) if place == "room" else (1.2, 2.2)
        low = np.array([*(low[:2] - rng.uniform(*margin, 2)), floor])
        top = max(floor + (2.8 if place == "room" else 4.2), high[2] + (0.7 if place == "room" else 1.0))
        high = np.array([*(high[:2] + rng.uniform(*margin, 2)), top])
    area = float(np.prod((high - low)[:2]))
    # The finest copy of all walls should stay within some forty million texels.
    walls = 2 * area + 2 * (high - low)[2] * float((high - low)[:2].sum())
    ppm = float(np.clip(np.sqrt(2.4e7 / walls), 40.0, 256.0))
    builder = RoomBuilder(rng, path, low, high, texels_per_metre=ppm, contrast=contrast)
    wooden = rng.uniform() < 0.6
    builder.build_shell(floor=materials.planks if wooden else materials.tiles, windows=place != "corridor")
    builder.prepare_furniture()
    if place == "corridor":
        builder.furnish_walls(0.3, deepest_m=0.4)
    else:
        builder.furnish_walls(0.5)
        builder.furnish_floor(int(np.clip(area / 6.0, 4, 30)))
        builder.hang_lamps(int(np.clip(area / 12.0, 2, 12)))
    builder.set_moving(moving)
    return builder.plan
