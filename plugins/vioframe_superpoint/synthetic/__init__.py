"""Drawn shapes whose corners are known: what a detector of corners learns first.

Source: DeTone, Malisiewicz, Rabinovich, "SuperPoint: Self-Supervised Interest Point Detection and Description", 2018,
section 4 (the kinds of shapes); the drawing is our own.
"""

from collections.abc import Callable

import numpy as np

from vioframe.checks import Array
from vioframe.errors import ConfigError
from vioframe.types import Image
from vioframe_superpoint.synthetic import flat, solids
from vioframe_superpoint.synthetic.canvas import Canvas


def _draw_scene(canvas: Canvas) -> None:
    """Boxes or polygons in front of a board, of stripes or of windows."""
    behind = (flat.draw_checkerboard, flat.draw_stripes, flat.draw_frames)
    before = (flat.draw_layers, solids.draw_boxes)
    behind[int(canvas.rng.integers(len(behind)))](canvas)
    before[int(canvas.rng.integers(len(before)))](canvas)


KINDS: dict[str, tuple[float, Callable[[Canvas], None]]] = {
    "strokes": (1.0, flat.draw_strokes),
    "polygons": (1.0, flat.draw_polygons),
    "layers": (1.5, flat.draw_layers),
    "ellipses": (0.8, flat.draw_ellipses),
    "curves": (0.6, flat.draw_curves),
    "star": (0.7, flat.draw_star),
    "stripes": (0.8, flat.draw_stripes),
    "checkerboard": (1.2, flat.draw_checkerboard),
    "frames": (1.2, flat.draw_frames),
    "boxes": (1.5, solids.draw_boxes),
    "scene": (2.0, _draw_scene),
    "nothing": (0.3, flat.draw_nothing),
}
"""Name → how often relative to the others, and what draws it."""


class SyntheticShapes:
    """Pictures of shapes without end, each a pure function of seed and index.

    Args:
        size_px: (width, height), at least 32 px each.
        seed: of all.
        kinds: names of :data:`KINDS` to draw; all where None.

    Raises:
        ConfigError: pictures too small, or a kind that is none.
    """

    def __init__(self, *, size_px: tuple[int, int] = (160, 120), seed: int = 0, kinds: tuple[str, ...] | None = None):
        if min(size_px) < 32:
            raise ConfigError(f"synthetic shapes need 32 px each way, got {size_px[0]}×{size_px[1]}")
        names = kinds or tuple(KINDS)
        unknown = [name for name in names if name not in KINDS]
        if unknown:
            raise ConfigError(f"{unknown[0]!r} is no kind of synthetic shape; choose from {', '.join(KINDS)}")
        self._size_px = (int(size_px[0]), int(size_px[1]))
        self._seed = seed
        self._names = names
        weights = np.array([KINDS[name][0] for name in names])
        self._bounds = np.cumsum(weights / weights.sum())

    def picture(self, index: int) -> tuple[Image, Array]:
        """Picture ``index`` of them.

        Returns:
            The picture (H, W) uint8 and its corners (N, 2) px: x right, y down, centre of the top-left pixel (0, 0);
            exact to about a tenth of a pixel; N may be 0.
        """
        rng = np.random.default_rng([self._seed, index, 61])
        name = self._names[min(int(np.searchsorted(self._bounds, rng.random())), len(self._names) - 1)]
        return draw_shapes(name, self._size_px, rng)


def draw_shapes(kind: str, size_px: tuple[int, int], rng: np.random.Generator) -> tuple[Image, Array]:
    """A picture (H, W) uint8 of one of :data:`KINDS`, and its corners (N, 2) px."""
    canvas = Canvas(size_px, rng)
    KINDS[kind][1](canvas)
    return canvas.finish()


__all__ = ["KINDS", "SyntheticShapes", "draw_shapes"]
