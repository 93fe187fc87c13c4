"""Flat pieces of textured surface in space, drawn as a pinhole camera sees them, far ones first.

Camera frame: x right, y down, z forward, metres. Each piece lies in a plane ``o + s u + t v`` with unit vectors u
and v; ``H = K [u v o]`` maps its coordinates (s, t) to pixels.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from vioframe.checks import Array
from vioframe.pictures.patterns import PATTERNS
from vioframe.pictures.surfaces import SURFACES, log_uniform
from vioframe.types import Image

Painter = Callable[[np.random.Generator, tuple[int, int]], Image]
PAINTERS: tuple[Painter, ...] = (*SURFACES, *PATTERNS)
_NEAR_M = 0.05
_LEVELS = 4


class TextureBank:
    """Painted textures, each made when it is first asked for; a function of seed and number.

    Args:
        seed: of all, one or more numbers.
        count: how many.
        side_px: of each.
    """

    def __init__(self, seed: Sequence[int], count: int, side_px: int = 320) -> None:
        self._seed = tuple(seed)
        self._side = side_px
        self._textures: list[tuple[Image, ...] | None] = [None] * count

    def __len__(self) -> int:
        return len(self._textures)

    def numbers(self, *painters: Painter) -> np.ndarray:
        """Numbers (N,) of the textures that some painters make."""
        wanted = [kind for kind, painter in enumerate(PAINTERS) if painter in painters]
        every = np.arange(len(self))
        return every[np.isin(every % len(PAINTERS), wanted)]

    def levels(self, number: int) -> tuple[Image, ...]:
        """Texture ``number``, each further copy half as large."""
        levels = self._textures[number]
        if levels is None:
            rng = np.random.default_rng([*self._seed, number])
            image = PAINTERS[number % len(PAINTERS)](rng, (self._side, self._side))
            copies = [image]
            for _ in range(_LEVELS - 1):
                copies.append(cv2.resize(copies[-1], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
            levels = self._textures[number] = tuple(copies)
        return levels


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Patch:
    """A flat piece of surface.

    Attributes:
        origin: (3,) m, where (s, t) = (0, 0).
        u, v: (3,) unit vectors of s and t.
        outline: (N, 2) m, its rim in (s, t).
        texture: number in the bank, or None for plain.
        pixels_per_metre: of the texture's finest copy; None stretches it over the piece.
        grey: mean grey value.
        contrast: factor on the texture's own, negative to invert it.
        bulge: 0…1, how far it is shaded as round.
        shadow: 0…1, depth of the shadow that it casts on what is behind.
        alpha: 0…1, opacity.
    """

    origin: Array
    u: Array
    v: Array
    outline: Array
    texture: int | None
    pixels_per_metre: float | None
    grey: float
    contrast: float
    bulge: float = 0.0
    shadow: float = 0.0
    alpha: float = 1.0


class PatchPainter:
    """A picture on which pieces are drawn in the order of the calls.

    Args:
        size_px: (width, height).
        focal_px: of the camera, whose axis is in the middle.
        bank: textures.
        rng: generator of what the pieces leave open.

    Attributes:
        canvas: (H, W) float32 grey values.
    """

    def __init__(self, size_px: tuple[int, int], focal_px: float, bank: TextureBank, rng: np.random.Generator) -> None:
        width, height = size_px
        self.canvas = np.full((height, width), 128.0, np.float32)
        self._focal_px = focal_px
        self._K = np.array([[focal_px, 0.0, 0.5 * (width - 1)], [0.0, focal_px, 0.5 * (height - 1)], [0.0, 0.0, 1.0]])
        self._bank = bank
        self._rng = rng
        light = rng.standard_normal(3) + np.array([0.0, -1.0, -1.0])
        self._light = light / np.linalg.norm(light)
        self._ambient = rng.uniform(0.45, 0.9)
        self._shadow_shift = rng.uniform(-1.0, 1.0, 2)
        self._shadow_blur = rng.uniform(0.5, 4.0)

    def draw_all(self, patches: Sequence[Patch]) -> None:
        """Draw pieces in this order."""
        for patch in patches:
            self.draw(patch)

    def draw(self, patch: Patch) -> None:
        """Draw one piece over what is there."""
        corners = patch.origin + patch.outline[:, :1] * patch.u + patch.outline[:, 1:] * patch.v
        seen = _cut_near(corners)
        if len(seen) < 3:
            return
        projected = seen @ self._K.T
        pixels = projected[:, :2] / projected[:, 2:]
        height, width = self.canvas.shape
        low = np.maximum(np.floor(pixels.min(axis=0)).astype(int) - 1, 0)
        high = np.minimum(np.ceil(pixels.max(axis=0)).astype(int) + 2, (width, height))
        if np.any(high - low < 2):
            return
        # Far outside OpenCV's fixed-point coordinates would overflow.
        fixed = np.clip(16.0 * (pixels - low), -5e7, 5e7).astype(np.int32)
        if patch.shadow > 0.0:
            self._cast_shadow(pixels, patch.shadow)
        mask = np.zeros((high[1] - low[1], high[0] - low[0]), np.uint8)
        cv2.fillPoly(mask, [fixed], 255, cv2.LINE_AA, 4)
        source = self._texture(patch, low, (mask.shape[1], mask.shape[0]), pixels)
        part = self.canvas[low[1] : high[1], low[0] : high[0]]
        weight = mask.astype(np.float32)
        weight *= np.float32(patch.alpha / 255.0)
        source -= part
        source *= weight
        part += source

    def _texture(self, patch: Patch, low: np.ndarray, size: tuple[int, int], pixels: Array) -> np.ndarray:
        """What the piece looks like on the part of the canvas that begins at ``low``, (h, w) float32."""
        normal = np.cross(patch.u, patch.v)
        lit = self._ambient + (1.0 - self._ambient) * abs(float(normal @ self._light))
        if patch.texture is None:
            source = np.full(size[::-1], np.float32(lit * patch.grey))
        else:
            levels = self._bank.levels(patch.texture)
            side = levels[0].shape[0]
            if patch.pixels_per_metre is None:
                start, extent = patch.outline.min(axis=0), np.ptp(patch.outline, axis=0)
                scale = side / np.maximum(extent, 1e-6)
                shift = -start * scale
            else:
                scale = np.full(2, patch.pixels_per_metre)
                # Somewhere on the texture, which goes on as in mirrors.
                shift = self._rng.uniform(0.0, side, 2)
            plane_to_canvas = self._K @ np.stack([patch.u, patch.v, patch.origin], axis=-1)
            texture_to_plane = np.array(
                [[1 / scale[0], 0, -shift[0] / scale[0]], [0, 1 / scale[1], -shift[1] / scale[1]], [0, 0, 1]]
            )
            H = plane_to_canvas @ texture_to_plane
            height, width = self.canvas.shape
            middle = np.clip(pixels, (0, 0), (width - 1, height - 1)).mean(axis=0)
            level = min(int(np.log2(max(1.3 * _texels_per_pixel(H, middle), 1.0))), _LEVELS - 1)
            shrink = np.diag([2.0**level, 2.0**level, 1.0])
            to_part = np.array([[1.0, 0.0, -low[0]], [0.0, 1.0, -low[1]], [0.0, 0.0, 1.0]])
            source = cv2.warpPerspective(
                levels[level], to_part @ H @ shrink, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101
            ).astype(np.float32)
            source -= np.float32(128.0)
            source *= np.float32(patch.contrast * lit)
            source += np.float32(patch.grey * lit)
        if patch.bulge > 0.0:
            y = np.linspace(-1.0, 1.0, size[1], dtype=np.float32)[:, None] - np.float32(0.5 * self._light[1])
            x = np.linspace(-1.0, 1.0, size[0], dtype=np.float32)[None, :] - np.float32(0.5 * self._light[0])
            source *= np.float32(1.15) - np.float32(0.5 * patch.bulge) * np.minimum(x**2 + y**2, 2.0)
        return source

    def _cast_shadow(self, pixels: Array, depth: float) -> None:
        extent = float(min(np.ptp(pixels, axis=0).max(), 200.0))
        if extent < 6.0:
            return
        moved = pixels + self._shadow_shift * 0.08 * extent
        height, width = self.canvas.shape
        reach = int(3.0 * self._shadow_blur) + 1
        low = np.maximum(np.floor(moved.min(axis=0)).astype(int) - reach, 0)
        high = np.minimum(np.ceil(moved.max(axis=0)).astype(int) + reach, (width, height))
        if np.any(high - low < 2):
            return
        mask = np.zeros((high[1] - low[1], high[0] - low[0]), np.uint8)
        cv2.fillPoly(mask, [np.clip(16.0 * (moved - low), -5e7, 5e7).astype(np.int32)], 255, cv2.LINE_AA, 4)
        mask = cv2.GaussianBlur(mask, (0, 0), self._shadow_blur)
        self.canvas[low[1] : high[1], low[0] : high[0]] *= 1.0 - np.float32(depth / 255.0) * mask


def _cut_near(corners: Array) -> Array:
    """The part of a polygon (N, 3) that lies before the camera."""
    kept: list[Array] = []
    inside = corners[:, 2] > _NEAR_M
    if inside.all():
        return corners
    for number in range(len(corners)):
        here, following = corners[number], corners[(number + 1) % len(corners)]
        if inside[number]:
            kept.append(here)
        if inside[number] != inside[(number + 1) % len(corners)]:
            share = (_NEAR_M - here[2]) / (following[2] - here[2])
            kept.append(here + share * (following - here))
    return np.array(kept).reshape(-1, 3)


def _texels_per_pixel(H: Array, pixel: Array) -> float:
    """How many texture pixels, along one side, lie on a pixel of the canvas; H maps the texture to the canvas."""
    back = np.linalg.inv(H + 1e-12 * np.eye(3))
    depth = float(back[2] @ np.array([*pixel, 1.0]))
    # Determinant of the Jacobian of a homography: det / depth³.
    return float(np.sqrt(abs(np.linalg.det(back)) / max(abs(depth) ** 3, 1e-12)))


def random_outline(rng: np.random.Generator, size_m: float) -> tuple[Array, bool]:
    """A rim (N, 2) m about (0, 0): rectangle, polygon, disc, blob, bar; and whether it is round."""
    kind = rng.choice(5, p=(0.34, 0.22, 0.16, 0.18, 0.10))
    if kind in (0, 4):
        ratio = log_uniform(rng, 0.4, 1.0) if kind == 0 else log_uniform(rng, 0.02, 0.15)
        half = 0.5 * size_m * np.array([1.0, ratio])
        return half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=np.float64), False
    count = int(rng.integers(3, 9)) if kind == 1 else 40
    turn = 2.0 * np.pi * np.arange(count) / count
    radius = np.full(count, 0.5 * size_m)
    if kind == 1:
        turn = turn + rng.uniform(-0.3, 0.3, count) * 2.0 * np.pi / count
        radius = radius * rng.uniform(0.5, 1.0, count)
    elif kind == 3:
        for wave in range(2, 6):
            radius = radius * (1.0 + rng.uniform(-0.5, 0.5) / wave * np.sin(wave * turn + rng.uniform(0, 6.28)))
    rim: Array = radius[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    if kind == 2:
        rim = rim * np.array([1.0, rng.uniform(0.5, 1.0)])
    return rim, kind in (2, 3)
