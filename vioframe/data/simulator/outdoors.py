"""Pictures of outdoor surfaces, painted from noise: each takes a generator, a size in pixels and pixels a metre."""

import cv2
import numpy as np

from vioframe.data.simulator import materials
from vioframe.data.simulator.texture import fractal_noise, to_grey

Image = np.ndarray
Shape = tuple[int, int]


def asphalt(rng: np.random.Generator, shape: Shape, ppm: float) -> Image:
    """Worn asphalt: aggregate, patches, cracks, manholes, tyre marks."""
    height, width = shape
    field = 98.0 + 7.0 * fractal_noise(rng, shape, 3.0 * ppm, 4) + 9.0 * rng.standard_normal(shape, dtype=np.float32)
    field += 7.0 * fractal_noise(rng, shape, 0.25 * ppm, 3, 0.8)
    area = height * width / ppm**2
    for _ in range(int(0.05 * area)):
        x, y = int(rng.integers(width)), int(rng.integers(height))
        w, h = (int(v * ppm) for v in rng.uniform(0.4, 2.5, 2))
        field[y : y + h, x : x + w] += rng.choice([-1, 1]) * rng.uniform(8, 26)
    image = to_grey(field)
    for _ in range(int(0.12 * area)):
        start = rng.uniform(0, 1, 2) * shape[::-1]
        walk = np.cumsum(rng.normal(0, 0.15 * ppm, (14, 2)) + rng.normal(0, 0.12 * ppm, 2), axis=0)
        tone, thick = int(rng.uniform(35, 60)), int(rng.integers(1, 4))
        cv2.polylines(image, [(start + walk).astype(np.int32)], False, tone, thick, cv2.LINE_AA)
    for _ in range(int(0.012 * area)):
        centre = int(rng.integers(width)), int(rng.integers(height))
        cv2.circle(image, centre, int(0.33 * ppm), 55, -1, cv2.LINE_AA)
        cv2.circle(image, centre, int(0.28 * ppm), 90, 2, cv2.LINE_AA)
        for offset in range(-3, 4):
            y = centre[1] + int(offset * 0.07 * ppm)
            cv2.line(image, (centre[0] - int(0.2 * ppm), y), (centre[0] + int(0.2 * ppm), y), 95, 2)
    return image


def pavement(rng: np.random.Generator, shape: Shape, ppm: float) -> Image:
    """Paving slabs."""
    return materials.tiles(rng, shape, ppm, 150.0, 0.5)


def facade(rng: np.random.Generator, shape: Shape, ppm: float) -> Image:
    """A house front, 3 m a storey, with windows, sills, a door and shop windows below."""
    height, width = shape
    base = float(rng.uniform(105, 205))
    field = base + 6.0 * fractal_noise(rng, shape, 2.0 * ppm, 4) + 4.0 * fractal_noise(rng, shape, 0.1 * ppm, 2, 0.9)
    if rng.uniform() < 0.5:
        _lay_bricks(rng, field, ppm)
    image = to_grey(field)
    storey, bays = 3.0 * ppm, max(round(width / ppm / rng.uniform(2.0, 3.2)), 2)
    frame = int(rng.choice([235, 60, 215]))
    for floor in range(max(int(height / storey), 1)):
        bottom = height - int(floor * storey)
        ledge = bottom - int(storey)
        cv2.line(image, (0, ledge), (width, ledge), int(base * 0.7), max(int(0.08 * ppm), 1))
        for bay in range(bays):
            left, right = int((bay + 0.22) * width / bays), int((bay + 0.78) * width / bays)
            if floor == 0 and bay == bays // 2:
                top = bottom - int(2.3 * ppm)
                cv2.rectangle(image, (left, top), (right, bottom), int(rng.uniform(30, 90)), -1)
                cv2.rectangle(image, (left, top), (right, bottom), frame, max(int(0.07 * ppm), 1))
                continue
            top, sill = bottom - int(2.45 * ppm), bottom - int((0.9 if floor else 0.35) * ppm)
            _put_window(rng, image, (left, top, right, sill), ppm, frame, min(base + 40, 255))
    return image


def _lay_bricks(rng: np.random.Generator, field: np.ndarray, ppm: float) -> None:
    course, brick = max(round(0.09 * ppm), 3), max(round(0.26 * ppm), 6)
    field[::course] -= 26
    for row, y in enumerate(range(0, field.shape[0], course)):
        field[y : y + course, (row % 2) * brick // 2 :: brick] -= 26
        field[y : y + course] += rng.normal(0, 5)


def _put_window(
    rng: np.random.Generator, image: Image, box: tuple[int, int, int, int], ppm: float, frame: int, ledge: float
) -> None:
    """Dark panes, a blind half down, bars, frame and sill."""
    left, top, right, sill = box
    thin = max(int(0.05 * ppm), 1)
    cv2.rectangle(image, (left, top), (right, sill), int(rng.uniform(25, 80)), -1)
    if rng.uniform() < 0.6:
        drop = int(rng.uniform(0.2, 0.9) * (sill - top))
        cv2.rectangle(image, (left, top), (right, top + drop), int(rng.uniform(120, 210)), -1)
    middle, bar = (left + right) // 2, (2 * top + sill) // 3
    cv2.line(image, (middle, top), (middle, sill), frame, thin)
    cv2.line(image, (left, bar), (right, bar), frame, thin)
    cv2.rectangle(image, (left, top), (right, sill), frame, max(int(0.07 * ppm), 1))
    reach = int(0.1 * ppm)
    cv2.rectangle(image, (left - reach, sill), (right + reach, sill + reach), int(ledge), -1)


def foliage(rng: np.random.Generator, shape: Shape, ppm: float) -> Image:
    """Leaves in sun and shade."""
    leaves = fractal_noise(rng, shape, 0.5 * ppm, 5, 0.85)
    return to_grey(78.0 + 34.0 * leaves)


def roof(rng: np.random.Generator, shape: Shape, ppm: float) -> Image:
    """Tar paper or gravel."""
    return to_grey(95.0 + 12.0 * fractal_noise(rng, shape, 0.5 * ppm, 4, 0.8))


def car_side(rng: np.random.Generator, shape: Shape, ppm: float, colour: float = 140.0) -> Image:
    """Doors, sills and two wheels."""
    height, width = shape
    base = colour
    shade = np.linspace(1.1, 0.75, height, dtype=np.float32)[:, None]
    image = to_grey(base * shade + 2.0 * fractal_noise(rng, shape, 0.5 * ppm, 3))
    cv2.rectangle(image, (0, int(0.82 * height)), (width, height), 25, -1)
    for position in (0.2, 0.8):
        centre = int(position * width), int(0.7 * height)
        cv2.circle(image, centre, int(0.31 * ppm), 20, -1, cv2.LINE_AA)
        cv2.circle(image, centre, int(0.19 * ppm), 150, -1, cv2.LINE_AA)
        cv2.circle(image, centre, int(0.06 * ppm), 50, -1, cv2.LINE_AA)
    for position in (0.33, 0.53, 0.68):
        cv2.line(image, (int(position * width), 0), (int(position * width), int(0.8 * height)), int(base * 0.45), 2)
    for position in (0.47, 0.63):
        x = int(position * width)
        opposite = x + int(0.12 * ppm), int(0.26 * height)
        cv2.rectangle(image, (x, int(0.2 * height)), opposite, int(base * 0.3 + 60), -1)
    return image


def car_end(rng: np.random.Generator, shape: Shape, ppm: float, colour: float = 140.0) -> Image:
    """Lights, grille and number plate."""
    height, width = shape
    base = colour
    image = to_grey(base + 2.0 * fractal_noise(rng, shape, 0.5 * ppm, 3))
    cv2.rectangle(image, (0, int(0.8 * height)), (width, height), 25, -1)
    for left in (0.04, 0.76):
        lamp = (int(left * width), int(0.18 * height)), (int((left + 0.2) * width), int(0.4 * height))
        cv2.rectangle(image, *lamp, 250, -1)
        cv2.rectangle(image, *lamp, 40, 2)
    cv2.rectangle(image, (int(0.3 * width), int(0.22 * height)), (int(0.7 * width), int(0.42 * height)), 30, -1)
    cv2.rectangle(image, (int(0.35 * width), int(0.55 * height)), (int(0.65 * width), int(0.68 * height)), 240, -1)
    cv2.rectangle(image, (int(0.38 * width), int(0.58 * height)), (int(0.62 * width), int(0.65 * height)), 60, 2)
    return image


def car_glass(rng: np.random.Generator, shape: Shape, ppm: float, colour: float = 140.0) -> Image:
    """Windows between pillars, reflecting the sky."""
    height, width = shape
    reflection = np.linspace(95, 45, height, dtype=np.float32)[:, None]
    image = to_grey(reflection + 8.0 * fractal_noise(rng, shape, 0.4 * ppm, 3))
    paint = int(colour)
    for position in (0.0, 0.36, 0.68, 1.0):
        x = int(position * (width - 1))
        cv2.line(image, (x, 0), (x, height), paint, max(int(0.1 * ppm), 2))
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), paint, max(int(0.08 * ppm), 2))
    return image


def car_top(rng: np.random.Generator, shape: Shape, ppm: float, colour: float = 140.0) -> Image:
    """Roof and bonnet: paint, seams, the reflection of clouds."""
    image = to_grey(colour + 10.0 * fractal_noise(rng, shape, 0.8 * ppm, 2))
    height, width = shape
    for position in (0.08, 0.92):
        y = int(position * height)
        cv2.line(image, (0, y), (width, y), int(0.6 * colour), 2)
    cv2.line(image, (int(0.5 * width), int(0.4 * height)), (int(0.5 * width), int(0.6 * height)), int(0.4 * colour), 3)
    return image


def paint(rng: np.random.Generator, shape: Shape, ppm: float) -> Image:
    """Worn white paint."""
    worn = fractal_noise(rng, shape, 0.3 * ppm, 5, 0.8)
    return to_grey(np.where(worn > 1.3, 110.0, 222.0 + 8.0 * worn))


def sky(rng: np.random.Generator, shape: Shape, ppm: float) -> Image:
    """Clouds."""
    clouds = fractal_noise(rng, shape, 120.0 * ppm, 6, 0.55)
    return to_grey(214.0 + 22.0 * np.tanh(clouds))


def horizon(rng: np.random.Generator, shape: Shape, ppm: float) -> Image:
    """Hazy hills and roofs under the sky."""
    height, width = shape
    field = sky(rng, shape, ppm).astype(np.float32)
    for tone, level, rough in ((188.0, 42.0, 10.0), (166.0, 24.0, 8.0)):
        ridge = level + rough * fractal_noise(rng, (1, width), 90.0 * ppm, 6, 0.6)[0]
        rows = (height - np.arange(height))[:, None] / ppm
        field = np.where(rows < ridge[None, :], tone + 3.0 * fractal_noise(rng, shape, 8.0 * ppm, 3), field)
    return to_grey(field)
