"""What people make: masonry, tiles, cloth, bars, print, boards, facades, scribbles, plates, and things of a house.

Painters as those of :mod:`vioframe.pictures.surfaces`: a generator and a shape (H, W) in, a picture (H, W) uint8 out.
"""

import string

import cv2
import numpy as np

from vioframe.data.simulator import materials
from vioframe.data.simulator.texture import fractal_noise, to_grey
from vioframe.pictures.surfaces import Shape, log_uniform, paint_clouds, two_greys, warped
from vioframe.types import Image

_LETTERS = string.ascii_letters + string.digits + "  ..,-&%!?#"
_FONTS = (
    cv2.FONT_HERSHEY_SIMPLEX,
    cv2.FONT_HERSHEY_PLAIN,
    cv2.FONT_HERSHEY_DUPLEX,
    cv2.FONT_HERSHEY_COMPLEX,
    cv2.FONT_HERSHEY_TRIPLEX,
    cv2.FONT_HERSHEY_SCRIPT_SIMPLEX,
)


def _weathered(field: np.ndarray, rng: np.random.Generator) -> Image:
    """Stains and grain of random strength on a field (H, W)."""
    shape = field.shape[0], field.shape[1]
    stains = np.float32(rng.uniform(0.0, 14.0)) * fractal_noise(rng, shape, rng.uniform(15.0, 120.0), 4, 0.6)
    return to_grey(field + stains + np.float32(rng.uniform(0.0, 7.0)) * fractal_noise(rng, shape, 3.0, 2))


def paint_bricks(rng: np.random.Generator, shape: Shape) -> Image:
    """Courses of bricks, slabs or shingles with joints, each of its own grey, lit from above."""
    height, width = shape
    ground, face = two_greys(rng, 15.0)
    field = np.full(shape, ground, np.float32)
    tall = log_uniform(rng, 6.0, 40.0)
    long, joint = tall * rng.uniform(1.0, 4.5), max(rng.uniform(0.04, 0.2) * tall, 0.8)
    offset, spread, bevel = rng.uniform(0.2, 0.5), rng.uniform(2.0, 30.0), rng.uniform(0.0, 40.0)
    raggedness = rng.choice([0.0, 0.06]) * tall
    for row in range(int(height / tall) + 2):
        for column in range(-1, int(width / long) + 2):
            shift = rng.normal(0.0, raggedness, 4)
            left, top = (column + (row % 2) * offset) * long + joint + shift[0], row * tall + joint + shift[1]
            right, bottom = left + long - joint + shift[2], top + tall - joint + shift[3]
            x0, y0, x1, y1 = (max(int(v + 0.5), 0) for v in (left, top, right, bottom))
            field[y0:y1, x0:x1] = face + rng.normal(0.0, spread)
            if bevel > 12.0:
                field[y0 : y0 + 1, x0:x1] += bevel
                field[max(y1 - 1, y0) : y1, x0:x1] -= bevel
    return _weathered(field, rng)


def paint_tiles(rng: np.random.Generator, shape: Shape) -> Image:
    """A grid of tiles: plain, chequered, or each with the same ornament turned about."""
    cell = int(log_uniform(rng, 10.0, 70.0))
    rows, columns = shape[0] // cell + 1, shape[1] // cell + 1
    first, second = two_greys(rng)
    kind = rng.integers(3)
    if kind == 2:
        motif = np.full((cell, cell), first, np.float32)
        for _ in range(int(rng.integers(1, 5))):
            centre = tuple(int(16 * v) for v in rng.uniform(0, cell, 2))
            axes = tuple(int(16 * v) for v in rng.uniform(0.1, 0.7, 2) * cell)
            grey, thick = rng.uniform(5, 250), int(rng.choice([-1, 1, 2]))
            cv2.ellipse(motif, centre, axes, rng.choice([0, 45, 90]), 0, 360, grey, thick, cv2.LINE_AA, 4)
        turned = np.concatenate([motif, motif[:, ::-1]], axis=1)
        field = np.tile(np.concatenate([turned, turned[::-1]]), (rows // 2 + 1, columns // 2 + 1))
    else:
        chequered = np.add.outer(np.arange(rows), np.arange(columns)) % 2 if kind else np.zeros((rows, columns))
        greys = np.where(chequered, first, second) + rng.normal(0.0, rng.uniform(0.0, 20.0), (rows, columns))
        field = np.repeat(np.repeat(greys.astype(np.float32), cell, axis=0), cell, axis=1)
    field = np.ascontiguousarray(field[: shape[0], : shape[1]], dtype=np.float32)
    joint = int(rng.integers(0, max(cell // 8, 2)))
    if joint:
        grey = rng.uniform(5, 250)
        for part in range(joint):
            field[part::cell] = grey
            field[:, part::cell] = grey
    return _weathered(field, rng)


def paint_cloth(rng: np.random.Generator, shape: Shape) -> Image:
    """Weave, tartan, knitwear: bands both ways, and threads over and under."""
    threads = []
    for length in shape:
        bands = np.full(length, rng.uniform(40, 210), np.float32)
        pitch, reach = log_uniform(rng, 10.0, 90.0), int(rng.integers(1, 6))
        for _ in range(reach):
            start, width, grey = rng.uniform(0, pitch), rng.uniform(0.05, 0.5) * pitch, rng.uniform(5, 250)
            bands[(np.arange(length) - start) % pitch < width] = grey
        threads.append(bands)
    y, x = np.ogrid[0 : shape[0], 0 : shape[1]]
    pitch = log_uniform(rng, 2.0, 14.0)
    over = np.sin((x + y) * np.float32(np.pi / pitch)) > 0 if rng.random() < 0.5 else np.float32(rng.uniform(0.3, 0.7))
    field = threads[0][:, None] * over + threads[1][None, :] * (1.0 - over)
    ribs = (
        np.float32(rng.uniform(0.0, 18.0))
        * np.sin(x * np.float32(np.pi / pitch))
        * np.sin(y * np.float32(np.pi / pitch))
    )
    field = (field + ribs).astype(np.float32)
    if rng.random() < 0.5:
        # It hangs in folds.
        folds = fractal_noise(rng, (max(shape[0] // 8, 4), shape[1]), rng.uniform(20.0, 60.0), 2)
        folds = cv2.resize(folds, shape[::-1], interpolation=cv2.INTER_LINEAR)
        field = field * (1.0 + np.float32(0.22) * folds)
        field = warped(field, rng, rng.uniform(40.0, 90.0), rng.uniform(2.0, 14.0))
    return to_grey(field)


def paint_bars(rng: np.random.Generator, shape: Shape) -> Image:
    """Bars side by side: fences, shutters, bar codes, corrugated sheet, radiators; or rays from a point."""
    x = np.arange(shape[1], dtype=np.float32)[None, :]
    y = np.arange(shape[0], dtype=np.float32)[:, None]
    first, second = two_greys(rng, 15.0)
    kind = rng.integers(4)
    if kind == 0:
        edges = np.cumsum(rng.uniform(0.2, 1.8, 200) * log_uniform(rng, 2.5, 25.0))
        greys = rng.uniform(5, 250, 201) if rng.random() < 0.5 else np.resize([first, second], 201)
        row = greys[np.searchsorted(edges, x[0])].astype(np.float32)[None, :]
        field = np.repeat(row, shape[0], axis=0)
    elif kind == 1:
        wave = np.sin(x * np.float32(2 * np.pi / log_uniform(rng, 4.0, 40.0)))
        field = np.repeat(first + (second - first) * (0.5 + 0.5 * wave), shape[0], axis=0)
    elif kind == 2:
        pitch = log_uniform(rng, 6.0, 50.0)
        saw = (x % pitch) / pitch
        field = np.repeat(first + (second - first) * saw ** np.float32(rng.uniform(0.3, 3.0)), shape[0], axis=0)
    else:
        centre = rng.uniform(0.0, 1.0, 2) * shape
        angle = np.arctan2(y - centre[0], x - centre[1])
        rays = np.sin(angle * int(rng.integers(4, 24)) + np.hypot(y - centre[0], x - centre[1]) * rng.uniform(0, 0.1))
        field = np.where(rays > 0, first, second)
    return _weathered(np.asarray(field, dtype=np.float32), rng)


def paint_print(rng: np.random.Generator, shape: Shape) -> Image:
    """Lines of letters: pages, signs, labels, screens."""
    height, width = shape
    ink, paper = two_greys(rng, 50.0)
    image = to_grey(paper + np.float32(rng.uniform(0.0, 6.0)) * fractal_noise(rng, shape, 40.0, 3))
    size = log_uniform(rng, 7.0, 60.0)
    font, slack = int(rng.choice(_FONTS)), rng.uniform(1.15, 2.2)
    y = rng.uniform(0.5, 1.5) * size
    while y < height + size:
        tall = size * (rng.uniform(1.5, 2.5) if rng.random() < 0.12 else 1.0)
        scale = cv2.getFontScaleFromHeight(font, max(int(0.7 * tall), 4))
        thick = max(int(tall / rng.uniform(7.0, 18.0)), 1)
        count = int(rng.uniform(0.3, 1.3) * width / (0.55 * tall)) + 2
        words = "".join(rng.choice(list(_LETTERS), count))
        start = int(rng.uniform(-0.02, 0.15) * width), int(y)
        cv2.putText(image, words, start, font, scale, int(ink), thick, cv2.LINE_AA)
        y += slack * tall
    if rng.random() < 0.35:
        corner = rng.uniform(0.0, 0.7, 2) * (width, height)
        far = corner + rng.uniform(0.1, 0.5, 2) * (width, height)
        grey, fill = int(rng.uniform(5, 250)), -1 if rng.random() < 0.5 else 2
        cv2.rectangle(image, [int(v) for v in corner], [int(v) for v in far], grey, fill)
    return image


def paint_blocks(rng: np.random.Generator, shape: Shape) -> Image:
    """Rectangles at random: codes of black and white, collages, city plans."""
    height, width = shape
    if rng.random() < 0.5:
        cell = int(log_uniform(rng, 3.0, 24.0))
        first, second = two_greys(rng, 40.0)
        bits = rng.random((height // cell + 1, width // cell + 1)) < rng.uniform(0.3, 0.7)
        field = np.where(np.repeat(np.repeat(bits, cell, axis=0), cell, axis=1)[:height, :width], first, second)
        return _weathered(field.astype(np.float32), rng)
    field = np.full(shape, rng.uniform(20, 235), np.float32)
    spread, small = rng.uniform(15, 70), rng.random() < 0.5
    for _ in range(int(rng.integers(30, 160))):
        size = log_uniform(rng, 3.0, 40.0 if small else 140.0), log_uniform(rng, 3.0, 40.0 if small else 140.0)
        x, y = int(rng.uniform(-20, width)), int(rng.uniform(-20, height))
        grey = float(np.clip(rng.normal(128, spread), 3, 252))
        fill = -1 if rng.random() < 0.8 else int(rng.integers(1, 4))
        cv2.rectangle(field, (x, y), (x + int(size[0]), y + int(size[1])), grey, fill)
    return _weathered(field, rng)


def paint_circuit(rng: np.random.Generator, shape: Shape) -> Image:
    """Lines that turn at right or half right angles, with pads: circuit boards, pipes, maps of lines."""
    height, width = shape
    ground, line = two_greys(rng, 30.0)
    image = to_grey(ground + np.float32(rng.uniform(0.0, 8.0)) * fractal_noise(rng, shape, 50.0, 3))
    grid, thick = log_uniform(rng, 6.0, 25.0), int(rng.integers(1, 5))
    turns = np.pi / 4 * np.arange(8) if rng.random() < 0.5 else np.pi / 2 * np.arange(4)
    for _ in range(int(rng.integers(15, 70))):
        at = np.round(rng.uniform((0, 0), (width, height)) / grid) * grid
        heading = int(rng.integers(len(turns)))
        points = [at]
        for _ in range(int(rng.integers(1, 7))):
            at = at + grid * rng.integers(1, 7) * np.array([np.cos(turns[heading]), np.sin(turns[heading])])
            points.append(at)
            heading = (heading + int(rng.choice([-1, 1]))) % len(turns)
        path = (16 * np.array(points)).astype(np.int32)
        cv2.polylines(image, [path], False, int(np.clip(line + rng.normal(0, 12), 3, 252)), thick, cv2.LINE_AA, 4)
        pad = int(rng.uniform(0.15, 0.45) * grid * 16)
        for end in (path[0], path[-1]):
            cv2.circle(image, [int(v) for v in end], pad, int(line), -1, cv2.LINE_AA, 4)
            if pad > 40:
                cv2.circle(image, [int(v) for v in end], pad // 2, int(ground), -1, cv2.LINE_AA, 4)
    return image


def paint_facade(rng: np.random.Generator, shape: Shape) -> Image:
    """A wall with rows of windows, each with frame, sill and what is behind."""
    height, width = shape
    painter = paint_bricks if rng.random() < 0.4 else paint_clouds
    image = to_grey(rng.uniform(60, 200) + 0.35 * (painter(rng, shape).astype(np.float32) - 128.0))
    tall, wide = log_uniform(rng, 28.0, 110.0), log_uniform(rng, 22.0, 100.0)
    share = rng.uniform(0.35, 0.8, 2)
    frame, glass = two_greys(rng, 40.0)
    thick, bars = max(int(0.05 * min(tall, wide)), 1), rng.integers(0, 3, 2)
    for row in range(int(height / tall) + 1):
        for column in range(int(width / wide) + 1):
            x0, y0 = int((column + 0.5 - 0.5 * share[0]) * wide), int((row + 0.5 - 0.5 * share[1]) * tall)
            x1, y1 = int(x0 + share[0] * wide), int(y0 + share[1] * tall)
            pane = float(np.clip(glass + rng.normal(0, 25), 3, 252))
            cv2.rectangle(image, (x0, y0), (x1, y1), int(pane), -1)
            if rng.random() < 0.3:
                blind = int(y0 + rng.uniform(0.1, 0.9) * (y1 - y0))
                cv2.rectangle(image, (x0, y0), (x1, blind), int(np.clip(pane + rng.choice([-60, 70]), 3, 252)), -1)
            for k in range(1, int(bars[0]) + 1):
                x = x0 + k * (x1 - x0) // (int(bars[0]) + 1)
                cv2.line(image, (x, y0), (x, y1), int(frame), thick)
            for k in range(1, int(bars[1]) + 1):
                y = y0 + k * (y1 - y0) // (int(bars[1]) + 1)
                cv2.line(image, (x0, y), (x1, y), int(frame), thick)
            cv2.rectangle(image, (x0, y0), (x1, y1), int(frame), thick)
            cv2.rectangle(image, (x0 - thick, y1), (x1 + thick, y1 + thick), int(np.clip(frame + 30, 0, 255)), -1)
    return image


def paint_scribbles(rng: np.random.Generator, shape: Shape) -> Image:
    """Lines of any course: drawings, cables, graffiti, contour maps, scratches."""
    height, width = shape
    ground, ink = two_greys(rng, 40.0)
    image = to_grey(ground + np.float32(rng.uniform(0.0, 15.0)) * fractal_noise(rng, shape, 60.0, 4))
    roughness, thick = rng.uniform(0.0, 1.2), int(rng.integers(1, 5))
    for _ in range(int(rng.integers(8, 60))):
        steps = int(rng.integers(5, 60))
        heading = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.normal(rng.normal(0, 0.15), 0.1 + roughness, steps))
        along = np.stack([np.cos(heading), np.sin(heading)], -1) * log_uniform(rng, 2.0, 14.0)
        points = np.cumsum(along, axis=0) + rng.uniform((0, 0), (width, height))
        grey = int(np.clip(ink + rng.normal(0, 25), 2, 253))
        closed = bool(rng.random() < 0.2)
        cv2.polylines(image, [(16 * points).astype(np.int32)], closed, grey, thick, cv2.LINE_AA, 4)
    return image


def paint_plate(rng: np.random.Generator, shape: Shape) -> Image:
    """Dots, holes, studs and rings in rows: perforated plates, buttons, rivets, egg boxes."""
    height, width = shape
    ground, dot = two_greys(rng, 20.0)
    field = to_grey(ground + np.float32(rng.uniform(0.0, 10.0)) * fractal_noise(rng, shape, 50.0, 4))
    pitch = rng.uniform(0.8, 1.3, 2) * log_uniform(rng, 7.0, 45.0)
    radius, shifted = rng.uniform(0.15, 0.45) * float(pitch.min()), 0.5 * float(rng.integers(2))
    kind, jitter, light = rng.integers(3), rng.choice([0.0, 0.12]), rng.uniform(0, 2 * np.pi)
    for row in range(int(height / pitch[0]) + 2):
        for column in range(-1, int(width / pitch[1]) + 2):
            x = (column + (row % 2) * shifted + rng.normal(0, jitter)) * pitch[1]
            y = (row + rng.normal(0, jitter)) * pitch[0]
            centre, size = (int(16 * x), int(16 * y)), int(16 * radius)
            if kind == 2:
                lift = int(0.25 * size * np.cos(light)), int(0.25 * size * np.sin(light))
                cv2.circle(field, (centre[0] - lift[0], centre[1] - lift[1]), size, 25, -1, cv2.LINE_AA, 4)
                cv2.circle(field, (centre[0] + lift[0], centre[1] + lift[1]), size, 235, -1, cv2.LINE_AA, 4)
            cv2.circle(field, centre, size, int(dot), -1 if kind else 2, cv2.LINE_AA, 4)
    return field


def paint_furniture(rng: np.random.Generator, shape: Shape) -> Image:
    """Books, drawers, cartons, pictures, doors, windows, planks, ceilings, as in simulated rooms."""
    painters = (
        materials.books,
        materials.drawers,
        materials.carton,
        materials.picture,
        materials.door,
        materials.window,
        materials.ceiling,
        materials.tiles,
    )
    painter = painters[int(rng.integers(len(painters)))]
    # Pixels in a metre: from an arm's length to across a hall.
    return np.ascontiguousarray(painter(rng, shape, log_uniform(rng, 60.0, 300.0)))


PATTERNS = (
    paint_bricks,
    paint_tiles,
    paint_cloth,
    paint_bars,
    paint_print,
    paint_blocks,
    paint_circuit,
    paint_facade,
    paint_scribbles,
    paint_plate,
    paint_furniture,
)
"""All painters of this module."""
