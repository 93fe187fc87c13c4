"""A picture on which shapes are drawn with edges and corners exact to a tenth of a pixel, and what is seen of them.

Shapes are drawn on a sheet several times as fine and averaged, so that every pixel holds the share of each shape that
covers it. Coordinates are pixels of the picture: x right, y down, the centre of the top-left pixel is (0, 0).
"""

from collections.abc import Sequence

import cv2
import numpy as np

from vioframe.checks import Array
from vioframe.data.simulator.texture import fractal_noise, to_grey
from vioframe.pictures import LightingOptions, change_light
from vioframe.types import Image

_FINE = 4
_SHIFT = 4
# OpenCV paints every cell of the sheet that an outline touches: half a cell more on each side.
_OVERPAINT_PX = 0.115
# Grey values: a right angle of less contrast, or a flatter one that is as weak, is no corner.
_LEAST_CONTRAST = 9.0
_LEAST_LEFT = 2.5
_SAME_CORNER_PX = 2.0
_LIGHT = LightingOptions(
    shading=0.4,
    shadow=0.0,
    spotlight=0.1,
    exposure=0.6,
    exposure_stops=1.2,
    low_light=0.1,
    low_light_stops=4.0,
    blur=0.35,
    blur_sigma_px=1.2,
    motion_blur=0.1,
    motion_blur_px=4.0,
)


class Canvas:
    """What shapes are drawn on.

    Args:
        size_px: (width, height).
        rng: generator of everything on it.

    Attributes:
        size_px: the same.
        rng: the same.
        contrast: grey values by which neighbours differ at least.
    """

    def __init__(self, size_px: tuple[int, int], rng: np.random.Generator) -> None:
        self.size_px = size_px
        self.rng = rng
        self.contrast = float(np.exp(rng.uniform(np.log(16.0), np.log(90.0))))
        width, height = size_px
        ground = _paint_ground(rng, (height, width), self.contrast)
        self._sheet: Image = cv2.resize(ground, (_FINE * width, _FINE * height), interpolation=cv2.INTER_LINEAR)
        self._corners: list[Array] = []
        self._layers: list[Array] = []

    @property
    def side(self) -> float:
        """The shorter side, px."""
        return float(min(self.size_px))

    def somewhere(self, count: int, margin: float = 0.0) -> Array:
        """Random points (count, 2) px, at least ``margin`` px inside; a negative margin lets them lie outside."""
        width, height = self.size_px
        return self.rng.uniform((margin, margin), (width - 1 - margin, height - 1 - margin), (count, 2))

    def contrasting(self, points: Array, others: Sequence[float] = ()) -> int:
        """A grey value that stands out from what lies under some points (N, 2) px, and from other greys."""
        at = np.rint(_FINE * (np.concatenate([points, points.mean(axis=0, keepdims=True)]) + 0.5)).astype(int)
        rows, columns = self._sheet.shape
        under = self._sheet[np.clip(at[:, 1], 0, rows - 1), np.clip(at[:, 0], 0, columns - 1)].astype(float)
        return pick_grey(
            self.rng, [float(under.min()), float(under.mean()), float(under.max()), *others], self.contrast
        )

    def polygon(self, points: Array, grey: float, *, seamless: bool = False, textured: bool | None = None) -> None:
        """Fill a polygon.

        Args:
            points: (N, 2) px, in either order.
            grey: mean.
            seamless: it shares edges with others; else it is drawn exactly as large as it is.
            textured: with a gradient and grain of its own; None for sometimes.
        """
        if textured is None:
            textured = bool(self.rng.random() < 0.35)
        outline = points if seamless else _shrink(points, _OVERPAINT_PX)
        fixed = np.rint((_FINE * (outline + 0.5) - 0.5) * 2**_SHIFT).astype(np.int32)
        if not textured:
            cv2.fillPoly(self._sheet, [fixed], float(grey), cv2.LINE_8, _SHIFT)
            return
        rows, columns = self._sheet.shape
        low = np.maximum((fixed.min(axis=0) >> _SHIFT) - 1, 0)
        high = np.minimum((fixed.max(axis=0) >> _SHIFT) + 3, (columns, rows))
        if np.any(high <= low):
            return
        part = self._sheet[low[1] : high[1], low[0] : high[0]]
        mask = np.zeros(part.shape, np.uint8)
        cv2.fillPoly(mask, [fixed - (low << _SHIFT).astype(np.int32)], 255, cv2.LINE_8, _SHIFT)
        cv2.copyTo(_paint_face(self.rng, part.shape, grey, 0.35 * self.contrast), mask, part)

    def bar(self, start: Array, end: Array, width_px: float, grey: float) -> None:
        """A straight stroke with square ends at two points (2,) px."""
        along = (end - start) / max(float(np.linalg.norm(end - start)), 1e-6)
        across = 0.5 * width_px * np.array([-along[1], along[0]])
        corners = np.array([start + across, end + across, end - across, start - across])
        self.polygon(corners, grey, textured=False)

    def ellipse(self, centre: Array, radii: Array, angle: float, grey: float, width_px: float | None = None) -> None:
        """An ellipse, filled or as a ring of this width."""
        turn = np.linspace(0.0, 2.0 * np.pi, 72, endpoint=False)
        unit = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
        rotation = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        outline = centre + (unit * radii) @ rotation
        if width_px is None:
            self.polygon(outline, grey)
            return
        fixed = np.rint((_FINE * (outline + 0.5) - 0.5) * 2**_SHIFT).astype(np.int32)
        cv2.polylines(self._sheet, [fixed], True, float(grey), max(round(_FINE * width_px), 1), cv2.LINE_8, _SHIFT)

    def curve(self, points: Array, width_px: float, grey: float) -> None:
        """A stroke along points (N, 2) px that lie close together, with round ends."""
        fixed = np.rint((_FINE * (points + 0.5) - 0.5) * 2**_SHIFT).astype(np.int32)
        cv2.polylines(self._sheet, [fixed], False, float(grey), max(round(_FINE * width_px), 1), cv2.LINE_8, _SHIFT)

    def mark(self, points: Array) -> None:
        """Tell of corners (N, 2) px; those that cannot be seen in the end are dropped."""
        self._corners.append(np.asarray(points, dtype=np.float64).reshape(-1, 2))

    def cover(self, polygon: Array) -> None:
        """Tell of a shape (N, 2) px in front of all before.

        Corners behind it are hidden; where its outline crosses that of an earlier shape, still seen, is a new one.
        """
        earlier = np.concatenate(self._corners) if self._corners else np.zeros((0, 2))
        self._corners = [earlier[~_inside(earlier, polygon, 0.75)]]
        if self._layers:
            edges = np.concatenate([np.stack([other, following(other)], axis=1) for other in self._layers])
            layer = np.repeat(np.arange(len(self._layers)), [len(other) for other in self._layers])
            crossings, hit = _cross(np.stack([polygon, following(polygon)], axis=1), edges)
            seen = np.ones(len(crossings), dtype=bool)
            for number, later in enumerate(self._layers):
                behind = np.flatnonzero(seen & (layer[hit] < number))
                seen[behind] = ~_inside(crossings[behind], later, 0.75)
            self._corners.append(crossings[seen])
        self._layers.append(polygon)

    def outline(self, points: Array) -> None:
        """Tell of an edge (2, 2), or of a closed outline (N, 2) px, that hides nothing but ends behind what follows."""
        self._layers.append(points)

    def finish(self) -> tuple[Image, Array]:
        """The picture (H, W) uint8 in some light, and the corners (N, 2) px that can be seen in it."""
        width, height = self.size_px
        clean: Image = cv2.resize(self._sheet, (width, height), interpolation=cv2.INTER_AREA)
        corners = np.concatenate(self._corners) if self._corners else np.zeros((0, 2))
        corners = corners[np.all((corners >= 0.0) & (corners <= (width - 1, height - 1)), axis=1)]
        corners = _merge(corners[_stand_out(clean, corners, _LEAST_CONTRAST)])
        lit = change_light(clean, self.rng, _LIGHT)
        # What is burnt out, black or far below the noise is gone.
        return lit, corners[_stand_out(cv2.GaussianBlur(lit, (0, 0), 1.0), corners, _LEAST_LEFT)]


def pick_grey(rng: np.random.Generator, others: Sequence[float], contrast: float) -> int:
    """A grey value at least ``contrast`` from all others, as far as there is one; else the furthest from them."""
    greys = np.arange(8.0, 248.0)
    gap = np.abs(greys[:, None] - np.asarray(others, dtype=float)).min(axis=1)
    fitting = greys[gap >= min(contrast, float(gap.max()))]
    return int(rng.choice(fitting))


def following(points: Array) -> Array:
    """The next point (N, 2) of each on a closed line."""
    return np.concatenate([points[1:], points[:1]])


def crossing_points(first: Array, second: Array) -> Array:
    """Points (N, 2) px where the outlines of two closed polygons (·, 2) cross."""
    return _cross(np.stack([first, following(first)], axis=1), np.stack([second, following(second)], axis=1))[0]


def _cross(first: Array, second: Array) -> tuple[Array, np.ndarray]:
    """Crossings (K, 2) px of segments (N, 2, 2) with segments (M, 2, 2), and which of the latter each lies on."""
    a, b = first[:, 0], first[:, 1] - first[:, 0]
    c, d = second[:, 0], second[:, 1] - second[:, 0]
    determinant = b[:, None, 0] * d[None, :, 1] - b[:, None, 1] * d[None, :, 0]
    off = c[None] - a[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        s = (off[..., 0] * d[None, :, 1] - off[..., 1] * d[None, :, 0]) / determinant
        t = (off[..., 0] * b[:, None, 1] - off[..., 1] * b[:, None, 0]) / determinant
    row, column = np.nonzero((s > 0.0) & (s < 1.0) & (t > 0.0) & (t < 1.0))
    points: Array = a[row] + s[row, column][:, None] * b[row]
    return points, column


def _inside(points: Array, polygon: Array, margin_px: float) -> np.ndarray:
    """Which points (N,) lie deeper than a margin in a polygon."""
    outline = polygon.astype(np.float32)
    depth = [cv2.pointPolygonTest(outline, (float(x), float(y)), True) for x, y in points]
    return np.asarray(depth, dtype=float) > margin_px


def _shrink(points: Array, by_px: float) -> Array:
    """A polygon (N, 2) with every side moved inwards; corners sharper than 30° move no further than at 30°."""
    after = following(points)
    along = after - points
    area = float(points[:, 0] @ after[:, 1] - points[:, 1] @ after[:, 0])
    along = along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    inward = np.sign(area) * np.stack([-along[:, 1], along[:, 0]], axis=-1)
    both = inward + np.concatenate([inward[-1:], inward[:-1]])
    # |n1 + n2|² = 2 (1 + cos) and the corner moves by (n1 + n2) / (1 + cos).
    moved: Array = points + by_px * both / np.maximum(0.5 * np.sum(both**2, axis=1, keepdims=True), 0.13)
    return moved


def _stand_out(image: Image, corners: Array, contrast: float) -> np.ndarray:
    """Which corners (N,) differ from their surroundings in both directions, as a right angle of this contrast."""
    strength = cv2.cornerMinEigenVal(image.astype(np.float32), 5, ksize=3)
    strength = cv2.dilate(strength, np.ones((3, 3), np.uint8))
    at = np.rint(corners).astype(int)
    # Measured: a quarter of the square of the contrast at a right angle.
    seen: np.ndarray = strength[at[:, 1], at[:, 0]] >= 0.25 * contrast**2
    return seen


def _merge(corners: Array) -> Array:
    """Corners of which no two are closer than ``_SAME_CORNER_PX``: each group becomes one between them."""
    while len(corners) > 1:
        near = np.abs(corners[:, None] - corners[None]).max(axis=-1) < _SAME_CORNER_PX
        row, column = np.nonzero(np.triu(near, 1))
        apart = np.linalg.norm(corners[row] - corners[column], axis=1)
        if not len(apart) or apart.min() >= _SAME_CORNER_PX:
            break
        # Means may lie closer to others than what they are the means of, so only one pair at a time.
        closest = int(np.argmin(apart))
        middle = 0.5 * (corners[row[closest]] + corners[column[closest]])
        kept = np.ones(len(corners), dtype=bool)
        kept[[row[closest], column[closest]]] = False
        corners = np.concatenate([corners[kept], middle[None]])
    return corners


def _ramp(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    """A plane (H, W) float32 within [-1, 1] in a random direction."""
    angle = rng.uniform(0.0, 2.0 * np.pi)
    y = np.linspace(-1.0, 1.0, shape[0], dtype=np.float32)[:, None]
    x = np.linspace(-1.0, 1.0, shape[1], dtype=np.float32)[None, :]
    plane: np.ndarray = (np.cos(angle) * x + np.sin(angle) * y) / (abs(np.cos(angle)) + abs(np.sin(angle)))
    return plane.astype(np.float32)


def _paint_ground(rng: np.random.Generator, shape: tuple[int, int], contrast: float) -> Image:
    """What is behind all shapes: a level, a ramp, soft blots, smooth noise; nothing on it is a corner."""
    field = np.full(shape, rng.uniform(20.0, 235.0), np.float32)
    field += rng.uniform(0.0, 45.0) * _ramp(rng, shape)
    kind = rng.integers(4)
    if kind == 1:
        field += rng.uniform(0.0, 30.0) * fractal_noise(rng, shape, 0.5 * min(shape), 2)
    elif kind == 2:
        field += min(0.22 * contrast, 14.0) * rng.random() * fractal_noise(rng, shape, rng.uniform(3.0, 30.0), 3, 0.6)
    elif kind == 3:
        blots = np.full((max(shape[0] // 4, 4), max(shape[1] // 4, 4)), 0.0, np.float32)
        for _ in range(int(rng.integers(4, 20))):
            centre = int(rng.integers(blots.shape[1])), int(rng.integers(blots.shape[0]))
            cv2.circle(blots, centre, int(rng.integers(2, 12)), rng.uniform(-50.0, 50.0), -1)
        blots = cv2.GaussianBlur(blots, (0, 0), rng.uniform(2.0, 5.0))
        field += cv2.resize(blots, shape[::-1], interpolation=cv2.INTER_LINEAR)
    return to_grey(field)


def _paint_face(rng: np.random.Generator, shape: tuple[int, ...], grey: float, range_dn: float) -> Image:
    """A face (H, W) of the fine sheet with a gradient and grain that stay within about ``range_dn`` of its grey."""
    small = max(shape[0] // _FINE, 2), max(shape[1] // _FINE, 2)
    field = grey + 0.6 * range_dn * rng.uniform(0.0, 1.0) * _ramp(rng, small)
    if rng.random() < 0.6:
        field += 0.3 * range_dn * rng.random() * fractal_noise(rng, small, rng.uniform(2.0, 16.0), 2, 0.6)
    face: Image = cv2.resize(to_grey(field), (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR)
    return face
