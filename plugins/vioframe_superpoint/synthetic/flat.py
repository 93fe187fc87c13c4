"""Flat shapes: strokes, polygons, ellipses, stars, stripes, checkerboards, frames, and none at all.

Each function draws one kind on a canvas and marks its corners: ends and crossings of thin strokes, vertices of
polygons, and wherever two outlines meet.
"""

import cv2
import numpy as np

from vioframe.checks import Array
from vioframe_superpoint.synthetic.canvas import Canvas, crossing_points, following, pick_grey

# A stroke up to this width has one corner at its end; a wider one two.
_THIN_PX = 3.0
_FLATTEST_COSINE = float(np.cos(np.deg2rad(155.0)))
_SHARPEST_COSINE = float(np.cos(np.deg2rad(22.0)))


def draw_strokes(canvas: Canvas) -> None:
    """Thin segments that may cross: corners at ends and crossings."""
    rng = canvas.rng
    segments: list[tuple[Array, Array]] = []
    marks: list[Array] = []
    for _ in range(int(rng.integers(1, 9))):
        start, end = canvas.somewhere(2, margin=2.0)
        length = float(np.linalg.norm(end - start))
        if length < 0.12 * canvas.side:
            continue
        if any(_too_close(start, end, *other) for other in segments):
            continue
        for other in segments:
            marks.append(crossing_points(np.array([start, end]), np.array(other))[:1])
        canvas.bar(start, end, _thin(rng), canvas.contrasting(np.linspace(start, end, 7)))
        segments.append((start, end))
        marks.append(np.array([start, end]))
    for points in marks:
        canvas.mark(points)


def _thin(rng: np.random.Generator) -> float:
    return float(rng.uniform(1.0, _THIN_PX))


def _too_close(start: Array, end: Array, other_start: Array, other_end: Array) -> bool:
    """Whether two segments cross at a sharp angle, or one's end almost touches the other."""
    first, second = end - start, other_end - other_start
    cosine = abs(float(first @ second)) / (np.linalg.norm(first) * np.linalg.norm(second))
    crosses = len(crossing_points(np.array([start, end]), np.array([other_start, other_end]))) > 0
    if crosses and cosine > np.cos(np.deg2rad(25.0)):
        return True
    gaps = [_distance(p, other_start, other_end) for p in (start, end)]
    gaps += [_distance(p, start, end) for p in (other_start, other_end)]
    return min(gaps) < 6.0


def _distance(point: Array, start: Array, end: Array) -> float:
    along = end - start
    share = np.clip((point - start) @ along / max(float(along @ along), 1e-9), 0.0, 1.0)
    return float(np.linalg.norm(start + share * along - point))


def random_polygon(canvas: Canvas, centre: Array, reach_px: float) -> Array | None:
    """A polygon (N, 2) around a centre, star-shaped seen from it; None where a vertex would be flat or a spike."""
    rng = canvas.rng
    count = int(rng.integers(3, 8))
    turn = 2.0 * np.pi * (np.arange(count) + rng.uniform(-0.35, 0.35, count)) / count + rng.uniform(0.0, 2.0 * np.pi)
    # Mostly convex; some with deep notches.
    radius = reach_px * rng.uniform(0.35 if rng.random() < 0.3 else 0.75, 1.0, count)
    points: Array = centre + radius[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    forth = following(points) - points
    back = np.concatenate([-forth[-1:], -forth[:-1]])
    lengths = np.linalg.norm(back, axis=1), np.linalg.norm(forth, axis=1)
    cosine = np.sum(back * forth, axis=1) / (lengths[0] * lengths[1])
    if min(lengths[0].min(), reach_px) < 6.0 or cosine.min() < _FLATTEST_COSINE or cosine.max() > _SHARPEST_COSINE:
        return None
    return points


def draw_polygons(canvas: Canvas) -> None:
    """Polygons beside each other."""
    _draw_polygons(canvas, overlap=False)


def draw_layers(canvas: Canvas) -> None:
    """Polygons and ellipses in front of each other: corners also where one outline ends behind another."""
    _draw_polygons(canvas, overlap=True)


def _draw_polygons(canvas: Canvas, *, overlap: bool) -> None:
    rng = canvas.rng
    taken: list[tuple[Array, float]] = []
    most = int(rng.integers(1, 12))
    for _ in range(3 * most):
        reach = float(np.exp(rng.uniform(np.log(0.06), np.log(0.55)))) * canvas.side
        centre = canvas.somewhere(1)[0]
        if not overlap and any(np.linalg.norm(centre - other) < reach + far + 3.0 for other, far in taken):
            continue
        if overlap and rng.random() < 0.2:
            points: Array | None = _round_outline(rng, centre, reach)
            round_shape = True
        else:
            points, round_shape = random_polygon(canvas, centre, reach), False
        if points is None:
            continue
        canvas.polygon(points, canvas.contrasting(points))
        if overlap:
            canvas.cover(points)
        if not round_shape:
            canvas.mark(points)
        taken.append((centre, reach))
        if len(taken) >= most:
            return


def _round_outline(rng: np.random.Generator, centre: Array, reach_px: float) -> Array:
    turn = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
    radii = reach_px * rng.uniform(0.5, 1.0, 2)
    angle = rng.uniform(0.0, np.pi)
    rotation = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    outline: Array = centre + (radii * np.stack([np.cos(turn), np.sin(turn)], axis=-1)) @ rotation
    return outline


def draw_ellipses(canvas: Canvas) -> None:
    """Discs and rings beside each other, of any size: no corner at all."""
    rng = canvas.rng
    taken: list[tuple[Array, float]] = []
    for _ in range(int(rng.integers(3, 25))):
        reach = float(np.exp(rng.uniform(np.log(0.04), np.log(0.45)))) * canvas.side
        centre = canvas.somewhere(1)[0]
        if any(np.linalg.norm(centre - other) < reach + far + 3.0 for other, far in taken):
            continue
        radii = reach * np.array([1.0, rng.uniform(0.45, 1.0)])
        around = centre + reach * np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
        width = float(rng.uniform(1.0, 4.0)) if rng.random() < 0.35 and reach > 10.0 else None
        canvas.ellipse(centre, radii, rng.uniform(0.0, np.pi), canvas.contrasting(around), width)
        taken.append((centre, reach))


def draw_star(canvas: Canvas) -> None:
    """Strokes from one point: corners at the middle and at the ends."""
    rng = canvas.rng
    taken: list[tuple[Array, float]] = []
    for _ in range(int(rng.integers(1, 5))):
        centre = canvas.somewhere(1, margin=0.12 * canvas.side)[0]
        most = canvas.side * rng.uniform(0.12, 0.5)
        if any(np.linalg.norm(centre - other) < most + far + 4.0 for other, far in taken):
            continue
        count = int(rng.integers(3, 9))
        turn = 2.0 * np.pi * (np.arange(count) + rng.uniform(-0.3, 0.3, count)) / count + rng.uniform(0, np.pi)
        reach = most * rng.uniform(0.5, 1.0, count)
        ends = centre + reach[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
        grey = canvas.contrasting(np.concatenate([ends, 0.5 * (ends + centre)]))
        width = _thin(rng)
        for end in ends:
            canvas.bar(centre, end, width, grey)
        canvas.mark(np.concatenate([centre[None], ends]))
        taken.append((centre, most))


def draw_curves(canvas: Canvas) -> None:
    """Bent strokes beside each other, as cables and rims: corners at their ends alone."""
    rng = canvas.rng
    share = np.linspace(0.0, 1.0, 40)[:, None]
    drawn: list[Array] = []
    for _ in range(int(rng.integers(2, 10))):
        a, b, c = canvas.somewhere(3, margin=2.0)
        points = (1 - share) ** 2 * a + 2 * share * (1 - share) * b + share**2 * c
        if np.linalg.norm(a - c) < 0.15 * canvas.side or _sharpest_bend(points) > 0.5:
            continue
        if any(np.linalg.norm(points[:, None] - other[None], axis=-1).min() < 7.0 for other in drawn):
            continue
        canvas.curve(points, _thin(rng), canvas.contrasting(points[::4]))
        canvas.mark(np.array([a, c]))
        drawn.append(points)


def _sharpest_bend(points: Array) -> float:
    """Largest turn between two segments of a line (N, 2), rad."""
    along = np.diff(points, axis=0)
    turn = np.diff(np.unwrap(np.arctan2(along[:, 1], along[:, 0])))
    return float(np.abs(turn).max())


def quadrangle(canvas: Canvas, least: float, most: float) -> Array:
    """A rectangle seen at a slant (4, 2) px, in order; its sides relative to the picture's shorter side."""
    rng = canvas.rng
    half = 0.5 * canvas.side * rng.uniform(least, most, 2)
    corners = half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=np.float64)
    tilt, lean, roll = rng.uniform(-0.9, 0.9), rng.uniform(-0.9, 0.9), rng.uniform(-np.pi, np.pi)
    depth = 1.0 + (np.sin(tilt) * corners[:, 0] + np.sin(lean) * corners[:, 1]) / (2.5 * canvas.side)
    flat = np.stack([np.cos(tilt) * corners[:, 0], np.cos(lean) * corners[:, 1]], axis=-1) / depth[:, None]
    rotation = np.array([[np.cos(roll), np.sin(roll)], [-np.sin(roll), np.cos(roll)]])
    placed: Array = flat @ rotation + canvas.somewhere(1, margin=0.1 * canvas.side)[0]
    return placed


def onto(quad: Array, points: Array) -> Array:
    """Points (..., 2) of the unit square mapped to a quadrangle (4, 2) px by its homography."""
    unit = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=np.float32)
    H = cv2.getPerspectiveTransform(unit, quad.astype(np.float32))
    mapped = np.concatenate([points, np.ones((*points.shape[:-1], 1))], axis=-1) @ H.T
    placed: Array = mapped[..., :2] / mapped[..., 2:]
    return placed


def _draw_cells(canvas: Canvas, quad: Array, u: Array, v: Array, greys: Array) -> None:
    """Cells between lines u (n + 1,) and v (m + 1,) of the unit square, with greys (m, n); corners at every node."""
    nodes = onto(quad, np.stack(np.meshgrid(u, v), axis=-1))
    for row in range(len(v) - 1):
        for column in range(len(u) - 1):
            cell = nodes[row : row + 2, column : column + 2]
            canvas.polygon(cell.reshape(4, 2)[[0, 1, 3, 2]], greys[row, column], seamless=True, textured=False)
    canvas.mark(nodes)
    for line in (*nodes, *nodes.swapaxes(0, 1)):
        canvas.outline(line[[0, -1]])


def _levels(canvas: Canvas, shape: tuple[int, int], quad: Array, *, two: bool) -> Array:
    """Greys (m, n) of which neighbours differ: two in turn, or each its own."""
    rng = canvas.rng
    dark = canvas.contrasting(quad)
    light = pick_grey(rng, [dark], canvas.contrast)
    greys = np.where(np.add.outer(np.arange(shape[0]), np.arange(shape[1])) % 2, dark, light).astype(float)
    if two:
        return greys + rng.normal(0.0, min(0.12 * abs(dark - light), 6.0), shape)
    for row in range(shape[0]):
        for column in range(shape[1]):
            near = [greys[row - 1, column]] * (row > 0) + [greys[row, column - 1]] * (column > 0)
            greys[row, column] = pick_grey(rng, near or [float(dark)], canvas.contrast)
    return greys


def draw_checkerboard(canvas: Canvas) -> None:
    """A board of two greys, or tiles of many, at a slant; corners at every node that shows."""
    rng = canvas.rng
    quad = quadrangle(canvas, 0.7, 1.6)
    rows, columns = int(rng.integers(2, 9)), int(rng.integers(2, 9))
    jitter = rng.choice([0.0, 0.25])
    u = _lines(rng, columns, jitter)
    v = _lines(rng, rows, jitter)
    _draw_cells(canvas, quad, u, v, _levels(canvas, (rows, columns), quad, two=bool(rng.random() < 0.7)))


def _lines(rng: np.random.Generator, count: int, jitter: float) -> Array:
    lines = (np.arange(count + 1) + rng.uniform(-jitter, jitter, count + 1)) / count
    lines[[0, -1]] = 0.0, 1.0
    return lines


def draw_stripes(canvas: Canvas) -> None:
    """Bands side by side: corners where the line between two meets the rim of all."""
    rng = canvas.rng
    quad = quadrangle(canvas, 0.6, 2.2)
    count = int(rng.integers(3, 14))
    u = _lines(rng, count, 0.35)
    _draw_cells(canvas, quad, u, np.array([0.0, 1.0]), _levels(canvas, (1, count), quad, two=bool(rng.random() < 0.5)))


def draw_frames(canvas: Canvas) -> None:
    """Windows, doors and posters: a rectangle at a slant with panes in it, beside others or nested."""
    rng = canvas.rng
    for _ in range(int(rng.integers(1, 5))):
        quad = quadrangle(canvas, 0.35, 1.3)
        canvas.cover(quad)
        outer = canvas.contrasting(quad)
        canvas.polygon(quad, outer)
        canvas.mark(quad)
        rows, columns = int(rng.integers(1, 4)), int(rng.integers(1, 4))
        # Wide enough that inner and outer corners are two.
        bar_u, bar_v = (min(max(rng.uniform(0.05, 0.14), 7.0 / _extent(quad, k)), 0.3) for k in (0, 1))
        pane = pick_grey(rng, [outer], canvas.contrast)
        for row in range(rows):
            for column in range(columns):
                low = np.array([bar_u + (1 - bar_u) * column / columns, bar_v + (1 - bar_v) * row / rows])
                high = low + np.array([(1 - bar_u) / columns - bar_u, (1 - bar_v) / rows - bar_v])
                if np.any(high - low < 0.06):
                    continue
                corners = onto(quad, np.array([low, [high[0], low[1]], high, [low[0], high[1]]]))
                canvas.polygon(corners, pane)
                canvas.mark(corners)
                canvas.outline(corners)


def _extent(quad: Array, side: int) -> float:
    """The shorter of two opposite sides of a quadrangle (4, 2), px."""
    a, b = ((0, 1), (3, 2)) if side == 0 else ((0, 3), (1, 2))
    return float(min(np.linalg.norm(quad[a[0]] - quad[a[1]]), np.linalg.norm(quad[b[0]] - quad[b[1]])))


def draw_nothing(canvas: Canvas) -> None:
    """The ground alone, which has no corner."""
