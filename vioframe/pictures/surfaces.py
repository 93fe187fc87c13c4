"""Natural surfaces, painted from noise: clouds, veins, patches, cells, leaves, grass, wood, water, grit.

Each painter takes a generator and a shape (H, W) and returns a picture (H, W) uint8, seen from the front, whose scale,
contrast and make differ from draw to draw.
"""

import cv2
import numpy as np

from vioframe.data.simulator.texture import fractal_noise, to_grey
from vioframe.types import Image

Shape = tuple[int, int]


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """A number between two whose logarithm is uniform."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def two_greys(rng: np.random.Generator, least: float = 25.0) -> tuple[float, float]:
    """Two grey values at least this far apart, in either order."""
    gap = rng.uniform(least, 210.0)
    low = rng.uniform(5.0, 250.0 - gap)
    return (low, low + gap) if rng.random() < 0.5 else (low + gap, low)


def stretched(field: np.ndarray, rng: np.random.Generator) -> Image:
    """A field of any range brought to two random grey values, as its 2nd and 98th percentile."""
    sample = field[::4, ::4]
    low, high = np.percentile(sample, (2.0, 98.0))
    first, second = two_greys(rng, 40.0)
    return to_grey(first + (second - first) / max(float(high - low), 1e-6) * (field - low))


def warped(field: np.ndarray, rng: np.random.Generator, cell_px: float, by_px: float) -> np.ndarray:
    """A field with its coordinates shifted by smooth noise."""
    height, width = field.shape
    shift = [fractal_noise(rng, field.shape, cell_px, 2) * np.float32(by_px) for _ in range(2)]
    x = np.arange(width, dtype=np.float32)[None, :] + shift[0]
    y = np.arange(height, dtype=np.float32)[:, None] + shift[1]
    moved: np.ndarray = cv2.remap(field, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
    return moved


def _stretched_noise(rng: np.random.Generator, shape: Shape, cell_px: float, octaves: int, ratio: float) -> np.ndarray:
    """Noise whose blobs are longer along the rows by a ratio."""
    narrow = shape[0], max(int(shape[1] / ratio), 4)
    noise = fractal_noise(rng, narrow, cell_px, octaves, rng.uniform(0.5, 0.85))
    long: np.ndarray = cv2.resize(noise, shape[::-1], interpolation=cv2.INTER_CUBIC)
    return long


def paint_clouds(rng: np.random.Generator, shape: Shape) -> Image:
    """Noise of many octaves, from smooth to rough: plaster, clouds, concrete, asphalt."""
    field = fractal_noise(rng, shape, log_uniform(rng, 6.0, 160.0), 6, rng.uniform(0.35, 0.95))
    if rng.random() < 0.3:
        field = np.sign(field) * np.abs(field) ** np.float32(rng.uniform(0.5, 2.0))
    return stretched(field, rng)


def paint_veins(rng: np.random.Generator, shape: Shape) -> Image:
    """Ridges of noise: marble, cracks, lightning, roots."""
    field = fractal_noise(rng, shape, log_uniform(rng, 20.0, 120.0), 4, rng.uniform(0.4, 0.7))
    ridge = np.exp(-np.abs(field) * np.float32(rng.uniform(2.0, 14.0)))
    if rng.random() < 0.6:
        ridge = warped(ridge, rng, rng.uniform(15.0, 60.0), rng.uniform(2.0, 15.0))
    return stretched(ridge + 0.08 * rng.random() * fractal_noise(rng, shape, 6.0, 2), rng)


def paint_patches(rng: np.random.Generator, shape: Shape) -> Image:
    """Noise cut into levels with hard or soft rims: peeling paint, camouflage, islands, cow hide."""
    field = fractal_noise(rng, shape, log_uniform(rng, 15.0, 120.0), 5, rng.uniform(0.3, 0.75))
    levels = int(rng.integers(2, 6))
    steepness = np.float32(log_uniform(rng, 5.0, 60.0))
    total = np.full(shape, rng.uniform(40.0, 210.0), np.float32)
    for edge in np.sort(rng.normal(0.0, 0.8, levels - 1)):
        total += np.float32(rng.uniform(-110.0, 110.0)) / (1.0 + np.exp(np.clip(steepness * (edge - field), -30, 30)))
    return to_grey(total + np.float32(rng.uniform(0.0, 9.0)) * fractal_noise(rng, shape, rng.uniform(2.0, 12.0), 2))


def _cell_map(rng: np.random.Generator, shape: Shape, cell_px: float, jitter: float) -> tuple[np.ndarray, np.ndarray]:
    """Voronoi cells: number of the nearest seed and distance to it, px (H, W)."""
    rows, columns = max(round(shape[0] / cell_px), 2), max(round(shape[1] / cell_px), 2)
    y, x = np.mgrid[0:rows, 0:columns] + 0.5 + jitter * rng.uniform(-0.5, 0.5, (2, rows, columns))
    if rng.random() < 0.4:
        x[1::2] += 0.5
    seeds = np.ones(shape, np.uint8)
    row, column = (y * shape[0] / rows).astype(int), (x * shape[1] / columns).astype(int)
    seeds[row.ravel() % shape[0], column.ravel() % shape[1]] = 0
    distance, number = cv2.distanceTransformWithLabels(seeds, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    return number, distance


def paint_cells(rng: np.random.Generator, shape: Shape) -> Image:
    """Cells side by side: cobbles, pebbles, cracked earth, mosaic, hide, honeycombs."""
    cell = log_uniform(rng, 7.0, 70.0)
    number, distance = _cell_map(rng, shape, cell, rng.uniform(0.3, 1.0))
    greys = np.clip(rng.normal(rng.uniform(70, 190), rng.uniform(4.0, 55.0), int(number.max()) + 1), 8, 247)
    field = greys.astype(np.float32)[number]
    if rng.random() < 0.5:
        field *= 1.0 - np.float32(rng.uniform(0.1, 0.6)) * np.minimum((distance / np.float32(0.75 * cell)) ** 2, 1.0)
    if rng.random() < 0.7:
        rim = cv2.morphologyEx(number.astype(np.float32), cv2.MORPH_GRADIENT, np.ones((2, 2), np.uint8)) > 0
        width = max(int(rng.uniform(0.02, 0.16) * cell), 1)
        if width > 1:
            rim = cv2.dilate(rim.astype(np.uint8), np.ones((width, width), np.uint8)) > 0
        field[rim] = rng.uniform(10.0, 245.0)
        field = cv2.GaussianBlur(field, (0, 0), rng.uniform(0.4, 0.9))
    if rng.random() < 0.5:
        field = warped(field, rng, rng.uniform(10.0, 40.0), rng.uniform(1.0, 0.12 * cell + 1.0))
    return to_grey(
        field + np.float32(rng.uniform(0.0, 12.0)) * fractal_noise(rng, shape, rng.uniform(2.0, 15.0), 3, 0.7)
    )


def paint_leaves(rng: np.random.Generator, shape: Shape) -> Image:
    """Things of all sizes in front of each other, down to the smallest: the model of dead leaves.

    Radii follow a power law with exponent -3, as in natural images (Lee, Mumford, Huang, 2001).
    """
    height, width = shape
    image = np.full(shape, int(rng.uniform(20, 235)), np.uint8)
    smallest, largest = rng.uniform(2.0, 6.0), rng.uniform(20.0, 80.0)
    count = int(rng.integers(150, 500))
    draw = rng.random(count)
    radii = (smallest**-2.0 + draw * (largest**-2.0 - smallest**-2.0)) ** -0.5
    # Mostly large ones first, so that what is small is seen.
    radii = radii[np.argsort(-radii * np.exp(rng.normal(0.0, 0.7, count)))]
    middle, spread = rng.uniform(80, 170), rng.uniform(15.0, 80.0)
    greys = np.clip(rng.normal(middle, spread, count), 5, 250).astype(int).tolist()
    centres = rng.uniform((0, 0), (width, height), (count, 2))
    kind = int(rng.integers(4))
    for (x, y), radius, grey in zip(centres.tolist(), radii.tolist(), greys, strict=True):
        if kind == 0 or (kind == 3 and rng.random() < 0.5):
            axes = int(16 * radius), int(16 * radius * rng.uniform(0.3, 1.0))
            where = int(16 * x), int(16 * y)
            cv2.ellipse(image, where, axes, rng.uniform(0, 180), 0, 360, grey, -1, cv2.LINE_AA, 4)
        else:
            corners = int(rng.integers(3, 7))
            turn = 2 * np.pi * (np.arange(corners) + rng.uniform(-0.3, 0.3, corners)) / corners + rng.uniform(0, 6)
            if kind == 2:
                turn = np.pi * np.array([0.22, 0.78, 1.22, 1.78]) + rng.choice([0.0, 0.5]) * np.pi
            points = np.stack([x + radius * np.cos(turn), y + radius * np.sin(turn)], -1)
            cv2.fillPoly(image, [(16 * points).astype(np.int32)], grey, cv2.LINE_AA, 4)
    return to_grey(
        image + np.float32(rng.uniform(0.0, 14.0)) * fractal_noise(rng, shape, rng.uniform(2.0, 20.0), 3, 0.8)
    )


def paint_foliage(rng: np.random.Generator, shape: Shape) -> Image:
    """Lit leaves before dark ones, each with a vein."""
    height, width = shape
    shade = fractal_noise(rng, shape, rng.uniform(30.0, 90.0), 3)
    image = to_grey(35.0 + 14.0 * shade)
    count, size = int(rng.integers(200, 700)), rng.uniform(4.0, 14.0)
    lean, spread = rng.uniform(0, 180), rng.uniform(15, 90)
    for number in range(count):
        x, y = rng.uniform(0, width), rng.uniform(0, height)
        light = float(shade[int(y), int(x)])
        grey = int(np.clip(60 + 130 * number / count + 28 * light + rng.normal(0, 22), 8, 250))
        angle, length = rng.normal(lean, spread), size * rng.uniform(0.5, 1.3)
        where, axes = (int(16 * x), int(16 * y)), (int(16 * length), int(16 * length * rng.uniform(0.25, 0.55)))
        cv2.ellipse(image, where, axes, angle, 0, 360, grey, -1, cv2.LINE_AA, 4)
        if length > 7.0:
            tip = length * np.cos(np.deg2rad(angle)), length * np.sin(np.deg2rad(angle))
            ends = [(int(16 * (x + k * tip[0])), int(16 * (y + k * tip[1]))) for k in (-0.9, 0.9)]
            cv2.line(image, ends[0], ends[1], int(np.clip(grey + rng.choice([-35, 35]), 5, 250)), 1, cv2.LINE_AA, 4)
    return image


def paint_grass(rng: np.random.Generator, shape: Shape) -> Image:
    """Blades, straw, fur, needles: many short strokes that lean alike."""
    height, width = shape
    image = paint_clouds(rng, shape)
    count = int(rng.integers(400, 1600))
    lean, spread, length = rng.uniform(0, np.pi), rng.uniform(0.05, 1.2), log_uniform(rng, 10.0, 60.0)
    middle, deviation = rng.uniform(50, 200), rng.uniform(15, 60)
    start = rng.uniform((0, 0), (width, height), (count, 2))
    angle = rng.normal(lean, spread, count)
    reach = length * rng.uniform(0.4, 1.2, count)
    end = start + reach[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    greys = np.clip(rng.normal(middle, deviation, count), 4, 251).astype(int).tolist()
    thick = 1 if length < 25 else int(rng.integers(1, 4))
    for a, b, grey in zip((16 * start).astype(int).tolist(), (16 * end).astype(int).tolist(), greys, strict=True):
        cv2.line(image, a, b, grey, thick, cv2.LINE_AA, 4)
    return image


def paint_wood(rng: np.random.Generator, shape: Shape) -> Image:
    """Grain along one direction, with rings and knots."""
    height, width = shape
    y = np.arange(height, dtype=np.float32)[:, None]
    bend = _stretched_noise(rng, shape, rng.uniform(20.0, 60.0), 3, rng.uniform(3.0, 8.0))
    phase = y / np.float32(log_uniform(rng, 3.0, 16.0)) + np.float32(rng.uniform(0.5, 3.0)) * bend
    for _ in range(int(rng.integers(0, 4))):
        centre = rng.uniform(0, width), rng.uniform(0, height)
        x = np.arange(width, dtype=np.float32)[None, :]
        off = ((x - centre[0]) / 2.5) ** 2 + (y - centre[1]) ** 2
        phase += np.float32(rng.uniform(3.0, 9.0)) * np.exp(-off / np.float32(rng.uniform(8.0, 25.0) ** 2))
    field = np.sin(np.float32(2 * np.pi) * phase)
    field += np.float32(rng.uniform(0.2, 1.2)) * _stretched_noise(rng, shape, rng.uniform(2.0, 5.0), 2, 12.0)
    return stretched(field, rng)


def paint_waves(rng: np.random.Generator, shape: Shape) -> Image:
    """Waves that run through each other: water, sand, corduroy, ripples."""
    y, x = (v.astype(np.float32) for v in np.ogrid[0 : shape[0], 0 : shape[1]])
    field = np.zeros(shape, np.float32)
    main, spread = rng.uniform(0, np.pi), rng.uniform(0.05, 1.2)
    pitch = log_uniform(rng, 6.0, 40.0)
    for _ in range(int(rng.integers(2, 7))):
        angle, length = rng.normal(main, spread), pitch * log_uniform(rng, 0.5, 2.0)
        along = (np.cos(angle) * x + np.sin(angle) * y) * np.float32(2 * np.pi / length)
        field += np.sin(along + np.float32(rng.uniform(0, 6.28)))
    if rng.random() < 0.7:
        field = warped(field, rng, rng.uniform(20.0, 70.0), rng.uniform(2.0, 12.0))
    if rng.random() < 0.4:
        field = np.maximum(field, np.float32(rng.uniform(-0.5, 1.0)))
    return stretched(field, rng)


def paint_grit(rng: np.random.Generator, shape: Shape) -> Image:
    """Grains of a few pixels on a ground: granite, gravel, terrazzo, starry sky, splashes."""
    base = fractal_noise(rng, shape, rng.uniform(20.0, 100.0), 3) * np.float32(rng.uniform(0.0, 15.0))
    field = base + np.float32(rng.uniform(30.0, 220.0))
    for _ in range(int(rng.integers(1, 4))):
        spots = fractal_noise(rng, shape, log_uniform(rng, 2.5, 12.0), 2, 0.6)
        edge = np.float32(rng.uniform(0.7, 2.2))
        cover = np.clip(np.float32(rng.uniform(1.5, 6.0)) * (spots - edge) + 0.5, 0.0, 1.0)
        field += cover * (np.float32(rng.uniform(10.0, 245.0)) - field)
    return to_grey(field)


SURFACES = (
    paint_clouds,
    paint_veins,
    paint_patches,
    paint_cells,
    paint_leaves,
    paint_foliage,
    paint_grass,
    paint_wood,
    paint_waves,
    paint_grit,
)
"""All painters of this module."""
