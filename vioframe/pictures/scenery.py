"""Scenes made of flat pieces: a surface, cards in front of each other, a room, a street, things on a table."""

from collections.abc import Callable

import numpy as np

from vioframe.checks import Array
from vioframe.data.simulator.texture import to_grey
from vioframe.geometry import so3
from vioframe.pictures import patterns, surfaces
from vioframe.pictures.patches import Painter, Patch, PatchPainter, TextureBank, random_outline
from vioframe.pictures.surfaces import log_uniform
from vioframe.types import Image

_RIGHT, _DOWN, _AHEAD = np.eye(3)
_FRONTS = (patterns.paint_facade, patterns.paint_bricks, patterns.paint_furniture)
_GREEN = (surfaces.paint_foliage, surfaces.paint_leaves, surfaces.paint_grass, surfaces.paint_clouds)
_GROUND = (
    surfaces.paint_clouds,
    surfaces.paint_grit,
    surfaces.paint_cells,
    surfaces.paint_grass,
    surfaces.paint_patches,
    patterns.paint_bricks,
    patterns.paint_tiles,
)
_THINGS = (patterns.paint_furniture, patterns.paint_print, patterns.paint_cloth, patterns.paint_bars)


class SceneBuilder:
    """Makes pieces with textures of a bank.

    Args:
        bank: textures.
        rng: generator.
        focal_px: of the camera, to fit the scale of textures to that of the picture.
    """

    def __init__(self, bank: TextureBank, rng: np.random.Generator, focal_px: float) -> None:
        self.rng = rng
        self.focal_px = focal_px
        self._bank = bank
        # Pictures differ in how much contrast there is at all.
        self._contrast = log_uniform(rng, 0.5, 1.1)
        # A scene repeats some of its materials.
        self._materials = rng.integers(len(bank), size=int(rng.integers(3, 14)))

    def piece(
        self,
        origin: Array,
        u: Array,
        v: Array,
        outline: Array,
        *,
        fitted: bool = False,
        bulge: float = 0.0,
        shadow: float = 0.0,
        bare: float = 0.12,
        alpha: float = 1.0,
        painters: tuple[Painter, ...] = (),
        reference_m: float | None = None,
    ) -> Patch:
        """A piece whose surface is drawn at random.

        Args:
            origin: (3,) m.
            u, v: (3,) unit vectors.
            outline: (N, 2) m.
            fitted: the texture fills the piece once.
            bulge, shadow, alpha: as of :class:`Patch`.
            bare: probability of a surface without texture.
            painters: who mostly paint such a thing; anybody where none is named.
            reference_m: distance where the texture has about the resolution of the picture; that of the middle by
                default.
        """
        rng = self.rng
        middle = origin + outline.mean(axis=0) @ np.stack([u, v])
        depth = reference_m or max(float(np.linalg.norm(middle)), 0.2)
        texture = int(rng.choice(self._materials))
        if painters and rng.random() < 0.75:
            texture = int(rng.choice(self._bank.numbers(*painters)))
        plain = bool(rng.random() < bare)
        sign = -1.0 if rng.random() < 0.25 else 1.0
        return Patch(
            origin=origin,
            u=u,
            v=v,
            outline=outline,
            texture=None if plain else texture,
            pixels_per_metre=None if fitted else self.focal_px / depth * log_uniform(rng, 0.7, 3.0),
            grey=128.0 + self._contrast * rng.uniform(-105.0, 105.0),
            contrast=sign * self._contrast * log_uniform(rng, 0.25, 1.4),
            bulge=bulge,
            shadow=shadow,
            alpha=alpha,
        )

    def box(self, corner: Array, axes: Array, size: Array, painters: tuple[Painter, ...] = ()) -> list[Patch]:
        """The faces of a box that are turned to the camera.

        Args:
            corner: (3,) m, one of its corners.
            axes: (3, 3), rows are unit vectors along its sides.
            size: (3,) m along them.
            painters: as of :meth:`piece`.
        """
        faces = []
        alike = bool(self.rng.random() < 0.5)
        face: Patch | None = None
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            outline = np.array([[0, 0], [size[i], 0], [size[i], size[j]], [0, size[j]]], dtype=np.float64)
            for far in (0.0, size[k]):
                origin = corner + far * axes[k]
                outward = axes[k] if far else -axes[k]
                if float(outward @ (origin + 0.5 * size[i] * axes[i] + 0.5 * size[j] * axes[j])) >= 0.0:
                    continue
                made = self.piece(
                    origin, axes[i], axes[j], outline, fitted=bool(self.rng.random() < 0.3), painters=painters
                )
                if alike and face is not None:
                    made = Patch(
                        origin=origin,
                        u=axes[i],
                        v=axes[j],
                        outline=outline,
                        texture=face.texture,
                        pixels_per_metre=face.pixels_per_metre,
                        grey=face.grey * self.rng.uniform(0.6, 1.3),
                        contrast=face.contrast,
                    )
                face = made
                faces.append(made)
        return faces


def _turned(rng: np.random.Generator, most: float) -> Array:
    """A rotation (3, 3) about a random axis by up to ``most`` rad."""
    axis = rng.standard_normal(3)
    return so3.exp(rng.uniform(0.0, most) * axis / np.linalg.norm(axis))


def _rectangle(low: Array, high: Array) -> Array:
    return np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]], dtype=np.float64)


# Far enough to fill any view of a plane a few metres away.
_ALL = _rectangle(np.full(2, -40.0), np.full(2, 40.0))


def build_surface(make: SceneBuilder) -> list[Patch]:
    """One surface at a slant, with some things flat on it."""
    rng = make.rng
    R = _turned(rng, 0.9)
    origin = np.array([0.0, 0.0, 2.0])
    pieces = [make.piece(origin, R[0], R[1], _ALL, bare=0.03)]
    for _ in range(int(rng.choice([0, 0, 1, 3, 8, 20]))):
        outline, _round = random_outline(rng, log_uniform(rng, 0.15, 1.2))
        at = origin + rng.uniform(-1.0, 1.0) * R[0] + rng.uniform(-0.8, 0.8) * R[1]
        alpha = float(rng.choice([1.0, rng.uniform(0.3, 0.9)]))
        turn = rng.uniform(0.0, 2.0 * np.pi)
        u, v = np.cos(turn) * R[0] + np.sin(turn) * R[1], np.cos(turn) * R[1] - np.sin(turn) * R[0]
        pieces.append(make.piece(at, u, v, outline, fitted=bool(rng.random() < 0.5), alpha=alpha))
    return pieces


def build_cards(make: SceneBuilder) -> list[Patch]:
    """Things of all shapes and sizes in front of each other, at all slants."""
    rng = make.rng
    pieces = [make.piece(np.array([0.0, 0.0, 9.0]), _RIGHT, _DOWN, _ALL)]
    count = int(log_uniform(rng, 3.0, 70.0))
    depths = np.sort(rng.uniform(1.0, 8.0, count))[::-1]
    slant = rng.uniform(0.0, 1.1)
    for depth in depths:
        outline, is_round = random_outline(rng, depth * log_uniform(rng, 0.06, 0.8 if count < 25 else 0.35))
        R = _turned(rng, slant) @ so3.exp(rng.uniform(-np.pi, np.pi) * _AHEAD)
        at = depth * np.array([rng.uniform(-0.65, 0.65), rng.uniform(-0.5, 0.5), 1.0])
        pieces.append(
            make.piece(
                at,
                R[:, 0],
                R[:, 1],
                outline,
                fitted=bool(rng.random() < 0.3),
                bulge=float(rng.uniform(0.3, 1.0)) if is_round and rng.random() < 0.6 else 0.0,
                shadow=float(rng.uniform(0.2, 0.7)) if rng.random() < 0.5 else 0.0,
            )
        )
    return pieces


def build_room(make: SceneBuilder) -> list[Patch]:
    """A room from inside: walls with pictures, doors and lights, boxes on the floor."""
    rng = make.rng
    half_x, half_y, length = rng.uniform(1.2, 4.0), rng.uniform(1.1, 2.0), rng.uniform(2.5, 12.0)
    R = so3.exp(np.array([rng.uniform(-0.25, 0.25), rng.uniform(-0.7, 0.7), rng.uniform(-0.2, 0.2)]))
    off = np.array([rng.uniform(-0.7, 0.7) * half_x, rng.uniform(-0.4, 0.3) * half_y, 0.0])
    behind, width, height = 3.0, 2.0 * half_x, 2.0 * half_y
    depth = length + behind
    low = np.array([-half_x, -half_y, -behind]) - off
    x, y, z = R.T
    walls: list[tuple[Array, Array, Array, float, float]] = [
        (np.array([0.0, 0.0, depth]), x, y, width, height),
        (np.zeros(3), z, y, depth, height),
        (np.array([width, 0.0, 0.0]), z, y, depth, height),
        (np.zeros(3), x, z, width, depth),
        (np.array([0.0, height, 0.0]), x, z, width, depth),
    ]
    pieces = []
    for number, (corner, u, v, reach_u, reach_v) in enumerate(walls):
        origin = R @ (low + corner)
        outline = _rectangle(np.zeros(2), np.array([reach_u, reach_v]))
        pieces.append(make.piece(origin, u, v, outline, bare=0.25))
        for _ in range(int(rng.integers(0, 9)) if number < 3 else int(rng.integers(0, 4))):
            size = np.minimum(rng.uniform(0.25, 1.6, 2), 0.8 * np.array([reach_u, reach_v]))
            at = rng.uniform(0.0, 1.0, 2) * (np.array([reach_u, reach_v]) - size)
            frame = rng.uniform(0.02, 0.1)
            if rng.random() < 0.6:
                pieces.append(make.piece(origin, u, v, _rectangle(at - frame, at + size + frame), bare=1.0, shadow=0.3))
            pieces.append(make.piece(origin, u, v, _rectangle(at, at + size), fitted=True, bare=0.05, painters=_THINGS))
    things = []
    for _ in range(int(rng.integers(0, 10))):
        size = rng.uniform((0.3, 0.2, 0.3), (1.4, 1.3, 1.2))
        at = low + np.array(
            [rng.uniform(0, width - size[0]), height - size[1], behind + rng.uniform(0.8, length - 1.3)]
        )
        yaw = so3.exp(np.array([0.0, rng.choice([0.0, rng.uniform(-0.8, 0.8)]), 0.0]))
        things.append((float((R @ at)[2]), make.box(R @ at, (R @ yaw).T, size, _THINGS)))
    for _depth, faces in sorted(things, key=lambda thing: -thing[0]):
        pieces.extend(faces)
    return pieces


def build_street(make: SceneBuilder) -> list[Patch]:
    """Outdoors: sky, ground, fronts of houses, trees, poles, boxes."""
    rng = make.rng
    R = so3.exp(np.array([rng.uniform(-0.3, 0.2), 0.0, rng.uniform(-0.15, 0.15)])) @ so3.exp(
        np.array([0.0, rng.uniform(-0.9, 0.9), 0.0])
    )
    eye = rng.uniform(1.0, 6.0)
    x, y, z = R.T
    sky = make.piece(
        np.array([0.0, 0.0, 200.0]), _RIGHT, _DOWN, 8.0 * _ALL, bare=0.4, painters=(surfaces.paint_clouds,)
    )
    bright = 128.0 + abs(sky.grey - 128.0) + 30.0
    pieces = [
        Patch(
            origin=sky.origin,
            u=sky.u,
            v=sky.v,
            outline=sky.outline,
            texture=sky.texture,
            pixels_per_metre=sky.pixels_per_metre,
            grey=bright,
            contrast=0.4 * sky.contrast,
        ),
        make.piece(R @ np.array([0.0, eye, 0.0]), x, z, 2.0 * _ALL, bare=0.1, painters=_GROUND, reference_m=4 * eye),
    ]
    things: list[tuple[float, list[Patch]]] = []
    for _ in range(int(rng.integers(0, 16))):
        side, far = float(rng.choice([-1.0, 1.0])), rng.uniform(5.0, 70.0)
        size = np.array([rng.uniform(4.0, 14.0), rng.uniform(4.0, 22.0), rng.uniform(5.0, 20.0)])
        near_side = rng.uniform(2.5, 9.0) if rng.random() < 0.7 else rng.uniform(-20.0, 20.0)
        left = side * near_side - (size[0] if side < 0 else 0.0)
        things.append((far, make.box(R @ np.array([left, eye - size[1], far]), R.T, size, _FRONTS)))
    for _ in range(int(rng.integers(2, 24))):
        far = log_uniform(rng, 4.0, 60.0)
        at = np.array([rng.uniform(-0.8, 0.8) * far, eye, far])
        kind = rng.integers(3)
        if kind == 0:
            tall, thin = rng.uniform(2.0, 8.0), rng.uniform(0.05, 0.3)
            rim = _rectangle(np.array([-thin, -tall]), np.array([thin, 0.0]))
            things.append((far, [make.piece(R @ at, x, y, rim, bulge=0.8)]))
        elif kind == 1:
            outline, _ = random_outline(rng, min(rng.uniform(1.5, 7.0), 0.5 * far))
            trunk = make.piece(R @ at, x, y, _rectangle(np.array([-0.15, -3.0]), np.array([0.15, 0.0])))
            middle = R @ (at - np.array([0.0, rng.uniform(2.5, 4.5), 0.0]))
            crown = make.piece(middle, x, y, outline, bulge=0.6, bare=0.0, painters=_GREEN)
            things.append((far, [trunk, crown]))
        else:
            size = rng.uniform((0.4, 0.4, 0.4), (4.5, 1.8, 2.2))
            things.append((far, make.box(R @ (at - np.array([0.0, size[1], 0.0])), R.T, size)))
    for _far, parts in sorted(things, key=lambda thing: -thing[0]):
        pieces.extend(parts)
    return pieces


def build_table(make: SceneBuilder) -> list[Patch]:
    """Boxes and flat things on a plane seen from above."""
    rng = make.rng
    tilt = rng.uniform(0.25, 1.4)
    R = so3.exp(np.array([tilt, 0.0, 0.0])) @ so3.exp(np.array([0.0, 0.0, rng.uniform(-0.3, 0.3)]))
    across, up = R @ _RIGHT, R @ -_DOWN
    # Along the plane, twice, and off it.
    axes = np.stack([across, np.cross(up, across), up])
    middle = np.array([0.0, 0.0, 2.2])
    pieces = [make.piece(middle, axes[0], axes[1], 0.5 * _ALL)]
    things = []
    for _ in range(int(rng.integers(3, 30))):
        at = middle + rng.uniform(-1.2, 1.2) * axes[0] + rng.uniform(-1.2, 1.2) * axes[1]
        turn = rng.uniform(0.0, 2.0 * np.pi)
        first = np.cos(turn) * axes[0] + np.sin(turn) * axes[1]
        second = np.cross(axes[2], first)
        if rng.random() < 0.45:
            outline, is_round = random_outline(rng, log_uniform(rng, 0.1, 0.7))
            bulge = 0.7 if is_round and rng.random() < 0.5 else 0.0
            piece = make.piece(at, first, second, outline, fitted=bool(rng.random() < 0.5), bulge=bulge, shadow=0.4)
            things.append((1e3 + float(at[2]), [piece]))
        else:
            size = np.array([log_uniform(rng, 0.1, 0.6), log_uniform(rng, 0.1, 0.6), log_uniform(rng, 0.03, 0.5)])
            things.append((float(at[2]), make.box(at, np.stack([first, second, axes[2]]), size, _THINGS)))
    for _depth, parts in sorted(things, key=lambda thing: -thing[0]):
        pieces.extend(parts)
    return pieces


SCENES: dict[str, tuple[float, Callable[[SceneBuilder], list[Patch]]]] = {
    "surface": (0.25, build_surface),
    "cards": (0.25, build_cards),
    "room": (0.2, build_room),
    "street": (0.15, build_street),
    "table": (0.15, build_table),
}
"""Name → how often, and what lists its pieces, far ones first."""


def paint_scene(name: str, size_px: tuple[int, int], bank: TextureBank, rng: np.random.Generator) -> Image:
    """A scene of :data:`SCENES` (H, W) uint8, brought to a random range of grey values, most often a wide one."""
    focal_px = max(size_px) * log_uniform(rng, 0.6, 1.6)
    painter = PatchPainter(size_px, focal_px, bank, rng)
    painter.draw_all(SCENES[name][1](SceneBuilder(bank, rng, focal_px)))
    low, high = np.percentile(painter.canvas[::3, ::3], (1.0, 99.0))
    wide = min(log_uniform(rng, 110.0, 700.0), 250.0)
    bottom = rng.uniform(0.0, 255.0 - wide)
    return to_grey(bottom + np.float32(wide / max(float(high - low), 12.0)) * (painter.canvas - np.float32(low)))
