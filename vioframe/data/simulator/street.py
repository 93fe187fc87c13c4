"""Streets, built along a path: houses, parked cars, trees, lamp posts, pavements and paint on the road."""

from collections.abc import Callable
from functools import partial

import numpy as np

from vioframe.checks import Array
from vioframe.data.simulator import outdoors
from vioframe.data.simulator.texture import Texture, to_grey
from vioframe.data.simulator.world import Skin, WorldPlan

LANE_M = 1.75
"""From the middle of the road to the path of who drives on its right."""
_KERB_M = 5.6
_FRONTAGE_M = 8.6
_STATION_M = 2.0
_CAR_M = np.array([4.2, 1.7])
# A path is along an axis where its heading is within this of it.
_STRAIGHT_RAD = 0.02


Painter = Callable[[np.random.Generator, tuple[int, int], float], np.ndarray]


class StreetBuilder:
    """Lines a path with a street.

    Args:
        rng: generator.
        path: (N, 3) m, where the body goes, in steps of about a metre.
        ground: height of the road, m.
        contrast: 1 for full texture, towards 0 for bare surfaces.
    """

    def __init__(self, rng: np.random.Generator, path: Array, ground: float, contrast: float = 1.0) -> None:
        self._rng = rng
        self._path = path
        self._ground = ground
        self._contrast = contrast
        self.plan = WorldPlan()
        self._lows: list[Array] = []
        self._highs: list[Array] = []
        # A coarse map of where the path runs, so that a thousand houses are checked against few points each.
        self._corner = path[:, :2].min(axis=0) - 32.0
        self._cells: dict[tuple[int, int], Array] = {}
        keys = ((path[:, :2] - self._corner) // 16.0).astype(int)
        for key in {(int(a), int(b)) for a, b in keys}:
            self._cells[key] = path[(keys[:, 0] == key[0]) & (keys[:, 1] == key[1]), :2]
        self._built: dict[tuple[int, int], list[int]] = {}
        texture = self._texture
        self._asphalt = texture(outdoors.asphalt, 24.0, 24.0, 56.0)
        self._pavement = texture(outdoors.pavement, 4.0, 4.0, 64.0)
        self._facades = [texture(outdoors.facade, 15.0, 15.0, 56.0) for _ in range(7)]
        self._roof = texture(outdoors.roof, 6.0, 6.0, 24.0)
        self._leaves = [texture(outdoors.foliage, 3.0, 3.0, 64.0) for _ in range(2)]
        self._cars = [
            tuple(
                texture(partial(painter, colour=colour), width, height, 90.0)
                for painter, width, height in (
                    (outdoors.car_side, float(_CAR_M[0]), 0.85),
                    (outdoors.car_end, float(_CAR_M[1]), 0.85),
                    (outdoors.car_glass, 2.3, 0.6),
                    (outdoors.car_top, 2.3, 1.5),
                )
            )
            for colour in (40.0, 85.0, 140.0, 190.0, 228.0)
        ]
        self._kiosks = [texture(outdoors.facade, 2.0, 2.4, 90.0), texture(outdoors.car_glass, 1.2, 1.6, 90.0)]
        self._paint = texture(outdoors.paint, 3.0, 3.0, 64.0)

    def _texture(self, painter: Painter, width_m: float, height_m: float, ppm: float) -> int:
        shape = round(height_m * ppm), round(width_m * ppm)
        image = painter(self._rng, shape, ppm).astype(np.float32)
        image = image.mean() + self._contrast * (image - image.mean())
        return self.plan.add_texture(Texture(image=to_grey(image), size_m=(width_m, height_m)))

    def _path_distance(self, low: Array, high: Array, reach: float) -> float:
        """Distance (m) in the plane from a box to the path, or more than ``reach`` where it is further."""
        first = ((low[:2] - reach - self._corner) // 16.0).astype(int)
        last = ((high[:2] + reach - self._corner) // 16.0).astype(int)
        nearest = np.inf
        for column in range(first[0], last[0] + 1):
            for row in range(first[1], last[1] + 1):
                points = self._cells.get((column, row))
                if points is not None:
                    gap = np.maximum(np.maximum(low[:2] - points, points - high[:2]), 0.0)
                    nearest = min(nearest, float(np.linalg.norm(gap, axis=1).min()))
        return nearest

    def _try(self, low: Array, high: Array, skins: list[Skin], clearance: float) -> bool:
        if self._path_distance(low, high, clearance) < clearance:
            return False
        first = ((low[:2] - self._corner) // 16.0).astype(int)
        last = ((high[:2] - self._corner) // 16.0).astype(int)
        cells = [(a, b) for a in range(first[0], last[0] + 1) for b in range(first[1], last[1] + 1)]
        for index in {i for cell in cells for i in self._built.get(cell, ())}:
            if np.all(low < self._highs[index]) and np.all(high > self._lows[index]):
                return False
        for cell in cells:
            self._built.setdefault(cell, []).append(len(self._lows))
        self._lows.append(low)
        self._highs.append(high)
        self.plan.add_solid(low, high, skins)
        return True

    def _skins(
        self, low: Array, high: Array, x_side: int, y_side: int, top: int, foot: float | None = None
    ) -> list[Skin]:
        """Textures of a box, counted from its top, or from ``foot`` where a picture has a ground floor."""
        light = self._rng.uniform(0.85, 1.1)
        gains = (0.78, 0.88, 1.05, 0.95, 0.5, 1.1)
        textures = (x_side, x_side, y_side, y_side, top, top)
        axes = ((1, 2), (1, 2), (0, 2), (0, 2), (0, 1), (0, 1))
        return [
            Skin(
                texture=t,
                origin=(float(low[u]), float(high[v]) if foot is None or v != 2 else foot),
                gain=light * g,
            )
            for t, g, (u, v) in zip(textures, gains, axes, strict=True)
        ]

    def build(self, moving: int = 0) -> WorldPlan:
        """Lay the road, then line it."""
        low, high = self._path.min(axis=0) - 500.0, self._path.max(axis=0) + 500.0
        low[2], high[2] = self._ground, self._ground + 400.0
        haze = Skin(texture=self._texture(outdoors.horizon, 1000.0, 400.0, 1.6), origin=(0.0, float(high[2])))
        clouds = Skin(texture=self._texture(outdoors.sky, 800.0, 800.0, 0.8), origin=(0.0, 0.0))
        road = Skin(texture=self._asphalt, origin=(0.0, 0.0))
        self.plan.add_solid(low, high, [haze, haze, haze, haze, road, clouds])
        steps = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self._path[:, :2], axis=0), axis=1))])
        along = np.arange(0.0, steps[-1], _STATION_M)
        at = np.stack([np.interp(along, steps, self._path[:, axis]) for axis in range(3)], axis=-1)
        ahead = np.stack([np.interp(along + 1.0, steps, self._path[:, axis]) for axis in range(3)], axis=-1)
        behind = np.stack([np.interp(along - 1.0, steps, self._path[:, axis]) for axis in range(3)], axis=-1)
        heading = np.arctan2(ahead[:, 1] - behind[:, 1], ahead[:, 0] - behind[:, 0])
        self._line_road(at, heading)
        self._line_houses(at, heading)
        self._line_furniture(at, heading)
        self._set_moving(at, heading, moving)
        return self.plan

    def _axis(self, heading: float) -> int | None:
        """The axis that a heading is along, or None."""
        quarter = heading / (0.5 * np.pi)
        if abs(quarter - round(quarter)) * 0.5 * np.pi > _STRAIGHT_RAD:
            return None
        return round(quarter) % 2

    def _span(
        self, point: Array, heading: float, forward: tuple[float, float], left: tuple[float, float]
    ) -> tuple[Array, Array]:
        """Corners in the plane of a rectangle given along and left of a heading; its bounds where that is askew."""
        direction = np.array([np.cos(heading), np.sin(heading)])
        sideways = np.array([-direction[1], direction[0]])
        corners = [point[:2] + f * direction + s * sideways for f in forward for s in left]
        return np.min(corners, axis=0), np.max(corners, axis=0)

    def _line_road(self, at: Array, heading: Array) -> None:
        """Dashes in the middle and pavements at the sides, wherever the road is straight."""
        for index in range(0, len(at), 4):
            if self._axis(heading[index]) is not None:
                low, high = self._span(at[index], heading[index], (-1.5, 1.5), (LANE_M - 0.08, LANE_M + 0.08))
                self._flat(low, high, 0.012, self._paint)
        for side in (-1.0, 1.0):
            # Slabs in a row become one, since every border drawn costs time.
            low, high, last = np.zeros(2), np.zeros(2), -2
            for index in range(len(at) + 1):
                slab = self._slab(at[index], heading[index], side) if index < len(at) else None
                fits = slab is not None and last == index - 1 and self._continues(low, high, slab)
                if slab is not None and fits:
                    low, high = np.minimum(low, slab[0]), np.maximum(high, slab[1])
                    last = index
                    continue
                if last >= 0:
                    self._flat(low, high, 0.13, self._pavement)
                    last = -2
                if slab is not None:
                    (low, high), last = slab, index

    def _slab(self, point: Array, angle: float, side: float) -> tuple[Array, Array] | None:
        """Corners in the plane of two metres of pavement, or None where there is none."""
        if self._axis(angle) is None:
            return None
        near, far = LANE_M + side * _KERB_M, LANE_M + side * (_FRONTAGE_M - 0.1)
        low, high = self._span(point, angle, (-0.5 * _STATION_M, 0.5 * _STATION_M), (near, far))
        return (low, high) if self._path_distance(low, high, 3.2) > 3.2 else None

    def _continues(self, low: Array, high: Array, slab: tuple[Array, Array]) -> bool:
        """Whether a slab prolongs another, to at most forty metres."""
        together = np.maximum(high, slab[1]) - np.minimum(low, slab[0])
        return bool(together.min() < _FRONTAGE_M - 0.1 - _KERB_M + 0.01 and together.max() < 40.0)

    def _flat(self, low: Array, high: Array, thick: float, texture: int) -> None:
        corner = np.array([*low, self._ground])
        opposite = np.array([*high, self._ground + thick])
        skins = [Skin(texture=texture, origin=(0.0, 0.0), gain=g) for g in (0.7, 0.8, 0.9, 0.85, 0.5, 1.0)]
        self.plan.add_solid(corner, opposite, skins)

    def _line_houses(self, at: Array, heading: Array) -> None:
        rng = self._rng
        free_from = {-1.0: 0.0, 1.0: 0.0}
        for index in range(len(at)):
            for side in (-1.0, 1.0):
                if index * _STATION_M < free_from[side]:
                    continue
                width = rng.uniform(8.0, 17.0)
                setback = 0.0 if rng.uniform() < 0.7 else rng.uniform(0.5, 4.0)
                if self._house(at[index], heading[index], width, LANE_M + side * (_FRONTAGE_M + setback), side):
                    gap = 0.0 if rng.uniform() < 0.6 else rng.uniform(2.0, 9.0)
                    free_from[side] = index * _STATION_M + width + gap
        # Houses in the second and third row close the view where the street turns away.
        for index in range(0, len(at), 4):
            side = rng.choice([-1.0, 1.0])
            self._house(at[index], heading[index], rng.uniform(10.0, 20.0), side * rng.uniform(14.0, 60.0), side)

    def _house(self, point: Array, angle: float, width: float, near: float, side: float) -> bool:
        rng = self._rng
        low, high = self._span(point, angle, (0.0, width), (near, near + side * rng.uniform(8.0, 12.0)))
        base = self._base(point)
        corner = np.array([*low, self._ground])
        opposite = np.array([*high, base + 3.0 * int(rng.integers(2, 6)) + rng.uniform(0.2, 1.5)])
        front, flank = int(rng.choice(self._facades)), int(rng.choice(self._facades))
        sides = (flank, front) if abs(np.cos(angle)) > 0.7 else (front, flank)
        return self._try(corner, opposite, self._skins(corner, opposite, *sides, self._roof, foot=base), 6.0)

    def _line_furniture(self, at: Array, heading: Array) -> None:
        """Parked cars, trees, lamp posts, boxes at the kerb."""
        rng = self._rng
        for index in range(1, len(at) - 1):
            point, angle = at[index], heading[index]
            base = self._base(point)
            for side in (-1.0, 1.0):
                if index % 3 == 0 and rng.uniform() < 0.5 and self._axis(angle) is not None:
                    self._park(point, angle, LANE_M + side * (_KERB_M - 1.05))
                if rng.uniform() < 0.1:
                    self._post(point, angle, LANE_M + side * (_KERB_M + 0.35), 0.16, base + rng.uniform(4.0, 7.0))
                elif rng.uniform() < 0.07:
                    self._tree(point, angle, LANE_M + side * (_KERB_M + 0.9), base)
                elif rng.uniform() < 0.05:
                    size = rng.uniform(0.5, 1.2)
                    low, high = self._span(point, angle, (0.0, size), (0.0, 0.0))
                    offset = np.array([-np.sin(angle), np.cos(angle)]) * (LANE_M + side * (_KERB_M + 2.0))
                    corner = np.array([*(low + offset - 0.25), self._ground])
                    opposite = np.array([*(high + offset + 0.25), base + rng.uniform(0.8, 2.1)])
                    box = int(rng.choice(self._kiosks))
                    self._try(corner, opposite, self._skins(corner, opposite, box, box, self._roof), 3.0)

    def _base(self, point: Array) -> float:
        """Height of the road at a point of the path: on hilly paths things stand on plinths."""
        return max(self._ground, float(point[2] - self._path[:, 2].min()) + self._ground)

    def _park(self, point: Array, angle: float, left: float) -> None:
        rng = self._rng
        angle = float(np.round(angle / (0.5 * np.pi)) * 0.5 * np.pi)
        half = 0.5 * _CAR_M
        low, high = self._span(point, angle, (-half[0], half[0]), (left - half[1], left + half[1]))
        base = self._base(point)
        corner, opposite = np.array([*low, base]), np.array([*high, base + 0.85])
        side, end, glass, top = self._cars[int(rng.integers(len(self._cars)))]
        along_x = abs(np.cos(angle)) > 0.7
        skins = self._skins(corner, opposite, *((end, side) if along_x else (side, end)), top)
        if not self._try(corner, opposite, skins, 1.1):
            return
        if base > self._ground:
            foot = np.array([*low, self._ground]), np.array([*high, base])
            self.plan.add_solid(*foot, self._skins(*foot, self._pavement, self._pavement, self._pavement))
        low, high = self._span(point, angle, (-1.3, 1.0), (left - 0.72, left + 0.72))
        corner, opposite = np.array([*low, base + 0.85]), np.array([*high, base + 1.45])
        self.plan.add_solid(corner, opposite, self._skins(corner, opposite, glass, glass, top))

    def _post(self, point: Array, angle: float, left: float, thick: float, top: float) -> None:
        low, high = self._span(point, angle, (0.0, 0.0), (left, left))
        corner, opposite = np.array([*(low - 0.5 * thick), self._ground]), np.array([*(high + 0.5 * thick), top])
        skins = [Skin(texture=self._roof, origin=(0.0, 0.0), gain=g) for g in (0.5, 0.8, 1.3, 0.9, 0.5, 1.0)]
        if self._try(corner, opposite, skins, 2.0):
            sign = np.array([0.35, 0.35, 0.6])
            middle = np.array([*(0.5 * (low + high)), top - 0.8])
            face = self._cars[int(self._rng.integers(len(self._cars)))][1]
            corner, opposite = middle - 0.5 * sign, middle + 0.5 * sign
            self.plan.add_solid(corner, opposite, self._skins(corner, opposite, face, face, self._paint))

    def _tree(self, point: Array, angle: float, left: float, base: float) -> None:
        rng = self._rng
        low, high = self._span(point, angle, (0.0, 0.0), (left, left))
        corner, opposite = np.array([*(low - 0.15), self._ground]), np.array([*(high + 0.15), base + 2.6])
        leaves = int(rng.choice(self._leaves))
        if not self._try(corner, opposite, self._skins(corner, opposite, leaves, leaves, leaves), 2.0):
            return
        middle = np.array([*(0.5 * (low + high)), base + 3.3])
        # Three blocks across each other look less like a block.
        for size in (rng.uniform((1.2, 1.2, 1.4), (2.0, 2.0, 2.2)) for _ in range(3)):
            centre = middle + rng.uniform(-0.4, 0.4, 3)
            corner, opposite = centre - 0.5 * size, centre + 0.5 * size
            self.plan.add_solid(corner, opposite, self._skins(corner, opposite, leaves, leaves, leaves))

    def _set_moving(self, at: Array, heading: Array, count: int) -> None:
        """People on the pavements, to and fro."""
        rng = self._rng
        if len(at) <= 5:
            # So short a street has no place where who walks would not be stepped on.
            return
        for index in rng.choice(np.arange(5, len(at)), size=min(count, len(at) - 5), replace=False):
            left = LANE_M + rng.choice([-1.0, 1.0]) * (_KERB_M + 1.4)
            low, high = self._span(at[index], heading[index], (0.0, 0.0), (left, left))
            base = self._base(at[index])
            corner, opposite = np.array([*(low - 0.22), base + 0.13]), np.array([*(high + 0.22), base + 1.85])
            texture = int(rng.choice(self._kiosks))
            forward = np.array([abs(np.cos(heading[index])), abs(np.sin(heading[index])), 0.0])
            if self._path_distance(corner - 2.0 * forward, opposite + 2.0 * forward, 2.0) < 2.0:
                continue
            self.plan.add_solid(corner, opposite, [Skin(texture=texture) for _ in range(6)])
            self.plan.moving.append((2.0 * forward, float(rng.uniform(7.0, 11.0)), float(rng.uniform(0, 6.28))))


def build_street(
    rng: np.random.Generator, path: Array, *, camera_height_m: float, contrast: float = 1.0, moving: int = 0
) -> WorldPlan:
    """A street along a path (N, 3) m; the road lies ``camera_height_m`` below its lowest point."""
    return StreetBuilder(rng, path, float(path[:, 2].min() - camera_height_m), contrast).build(moving)
