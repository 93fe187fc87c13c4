"""Pictures of indoor surfaces, painted from noise: each takes a generator, a size in pixels and pixels a metre."""

from itertools import pairwise

import cv2
import numpy as np

from vioframe.data.simulator.texture import fractal_noise, to_grey

Image = np.ndarray
Shape = tuple[int, int]


def plaster(rng: np.random.Generator, shape: Shape, ppm: float, base: float = 165.0) -> Image:
    """Painted wall: stains, roller grain, scratches and chips."""
    field = base + 7.0 * fractal_noise(rng, shape, 1.6 * ppm, 3)
    field += 5.0 * fractal_noise(rng, shape, 0.12 * ppm, 3, 0.7)
    image = to_grey(field + 2.0 * rng.standard_normal(shape, dtype=np.float32))
    area = shape[0] * shape[1] / ppm**2
    for _ in range(int(5 * area)):
        x, y = int(rng.integers(shape[1])), int(rng.integers(shape[0]))
        tone = int(base + rng.choice([-1, 1]) * rng.uniform(18, 60))
        size = rng.uniform(0.004, 0.03) * ppm
        axes = int(size) + 1, int(size * rng.uniform(0.3, 1)) + 1
        cv2.ellipse(image, (x, y), axes, rng.uniform(0, 180), 0, 360, tone, -1, cv2.LINE_AA)
    for _ in range(int(0.7 * area)):
        start = rng.uniform(0, 1, 2) * shape[::-1]
        walk = np.cumsum(rng.normal(0, 0.04 * ppm, (8, 2)) + rng.normal(0, 0.05 * ppm, 2), axis=0)
        cv2.polylines(image, [(start + walk).astype(np.int32)], False, int(base - rng.uniform(25, 60)), 1, cv2.LINE_AA)
    return image


def planks(rng: np.random.Generator, shape: Shape, ppm: float, base: float = 120.0, width_m: float = 0.14) -> Image:
    """Boards along x, each of its own tone, with grain, knots and joints."""
    height, columns = shape
    rows = max(round(height / (width_m * ppm)), 1)
    edges = np.linspace(0, height, rows + 1).astype(int)
    grain = fractal_noise(rng, (height, max(columns // 12, 4)), 0.02 * ppm, 3, 0.8)
    field = base + 9.0 * cv2.resize(grain, (columns, height), interpolation=cv2.INTER_LINEAR)
    field += 5.0 * fractal_noise(rng, shape, 0.5 * ppm, 2)
    for top, bottom in pairwise(edges):
        x = -rng.uniform(0, 1.2) * ppm
        while x < columns:
            length = rng.uniform(0.7, 1.6) * ppm
            left, right = max(int(x), 0), min(int(x + length), columns)
            if right > left:
                field[top:bottom, left:right] += rng.normal(0, 16)
                field[top:bottom, left : left + 2] -= 55
            x += length
        field[top : top + max(int(0.006 * ppm), 1)] -= 50
    image = to_grey(field)
    for _ in range(int(2 * shape[0] * shape[1] / ppm**2)):
        centre = int(rng.integers(columns)), int(rng.integers(height))
        size = rng.uniform(0.008, 0.022) * ppm
        cv2.ellipse(image, centre, (int(1.6 * size) + 1, int(size) + 1), 0, 0, 360, int(base - 45), -1, cv2.LINE_AA)
    return image


def tiles(rng: np.random.Generator, shape: Shape, ppm: float, base: float = 170.0, size_m: float = 0.3) -> Image:
    """Square tiles, speckled, with dark joints; some darker ones."""
    height, width = shape
    field = base + 6.0 * fractal_noise(rng, shape, 0.1 * ppm, 3, 0.8) + 4.0 * fractal_noise(rng, shape, 1.0 * ppm, 2)
    rows, columns = max(round(height / (size_m * ppm)), 1), max(round(width / (size_m * ppm)), 1)
    tone = rng.normal(0, 8, (rows, columns)) - 45.0 * (rng.uniform(size=(rows, columns)) < 0.15)
    field += cv2.resize(tone.astype(np.float32), (width, height), interpolation=cv2.INTER_NEAREST)
    joint = max(int(0.008 * ppm), 1)
    for y in np.linspace(0, height, rows + 1).astype(int):
        field[y : y + joint] = base - 75
    for x in np.linspace(0, width, columns + 1).astype(int):
        field[:, x : x + joint] = base - 75
    return to_grey(field)


def ceiling(rng: np.random.Generator, shape: Shape, ppm: float) -> Image:
    """Hung panels with pinholes; some are lamps, some are vents."""
    height, width = shape
    field = 190.0 + 4.0 * fractal_noise(rng, shape, 0.08 * ppm, 2)
    rows, columns = max(round(height / (0.6 * ppm)), 1), max(round(width / (0.6 * ppm)), 1)
    holes = rng.uniform(size=(max(height // 6, 1), max(width // 6, 1))) < 0.06
    field -= 50.0 * cv2.resize(holes.astype(np.float32), (width, height), interpolation=cv2.INTER_NEAREST)
    ys, xs = np.linspace(0, height, rows + 1).astype(int), np.linspace(0, width, columns + 1).astype(int)
    for row in range(rows):
        for column in range(columns):
            panel = np.s_[ys[row] : ys[row + 1], xs[column] : xs[column + 1]]
            if row % 3 == 1 and column % 4 in (1, 2):
                field[panel] = 250.0
            elif rng.uniform() < 0.08:
                field[panel] = 150.0
                field[panel][:: max(int(0.05 * ppm), 2)] = 70.0
            else:
                field[panel] += rng.normal(0, 3)
    joint = max(int(0.012 * ppm), 1)
    for y in ys:
        field[y : y + joint] = 140
    for x in xs:
        field[:, x : x + joint] = 140
    return to_grey(field)


def fabric(rng: np.random.Generator, shape: Shape, ppm: float, base: float = 110.0) -> Image:
    """Woven pattern: stripes and diamonds with a border, as on a rug."""
    height, width = shape
    y, x = np.mgrid[0:height, 0:width].astype(np.float32) / ppm
    pitch = rng.uniform(0.12, 0.3)
    diamonds = np.sign(np.sin(2 * np.pi * (x + y) / pitch) * np.sin(2 * np.pi * (x - y) / pitch))
    stripes = np.sign(np.sin(2 * np.pi * x / rng.uniform(0.3, 0.6)))
    field = base + 28.0 * diamonds + 18.0 * stripes + 8.0 * fractal_noise(rng, shape, 0.03 * ppm, 2, 0.9)
    field += 10.0 * fractal_noise(rng, shape, 0.6 * ppm, 2)
    border = int(0.08 * ppm)
    if min(shape) > 6 * border > 0:
        for inset, tone in ((border, base + 80), (2 * border, base - 60)):
            cv2.rectangle(field, (inset, inset), (width - inset, height - inset), tone, max(border // 3, 1))
    return to_grey(field)


def picture(rng: np.random.Generator, shape: Shape, ppm: float) -> Image:
    """A framed picture: landscape, blots, bars or a printed sheet."""
    height, width = shape
    kind = rng.integers(4)
    if kind == 0:
        field = 140.0 + 55.0 * fractal_noise(rng, shape, 0.3 * ppm, 5, 0.6)
        image = to_grey(field)
    elif kind == 1:
        image = np.full(shape, 215, np.uint8)
        for _ in range(int(rng.integers(12, 30))):
            centre = int(rng.integers(width)), int(rng.integers(height))
            axes = int(rng.uniform(0.02, 0.16) * width) + 1, int(rng.uniform(0.02, 0.16) * height) + 1
            cv2.ellipse(image, centre, axes, rng.uniform(0, 180), 0, 360, int(rng.integers(20, 235)), -1, cv2.LINE_AA)
    elif kind == 2:
        image = np.full(shape, 60, np.uint8)
        for _ in range(int(rng.integers(10, 25))):
            x, y = int(rng.integers(width)), int(rng.integers(height))
            far = x + int(rng.uniform(0.05, 0.4) * width), y + int(rng.uniform(0.05, 0.4) * height)
            cv2.rectangle(image, (x, y), far, int(rng.integers(30, 245)), -1)
    else:
        image = np.full(shape, 232, np.uint8)
        line, y = max(int(0.02 * ppm), 2), int(0.06 * ppm)
        while y < height - line:
            x = int(0.05 * ppm)
            while x < width - int(0.06 * ppm):
                word = int(rng.uniform(0.01, 0.05) * ppm) + 1
                cv2.rectangle(image, (x, y), (x + word, y + line // 2), int(rng.integers(20, 90)), -1)
                x += word + max(line // 2, 1)
            y += int(1.6 * line) + 1
    frame = max(int(0.025 * ppm), 1)
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), int(rng.choice([35, 60, 225])), 2 * frame)
    return image


def window(rng: np.random.Generator, shape: Shape, ppm: float) -> Image:
    """A window with glazing bars; sky, houses and bushes behind."""
    height, width = shape
    field = np.linspace(250, 215, height, dtype=np.float32)[:, None] + 6.0 * fractal_noise(rng, shape, 0.5 * ppm, 3)
    x = 0
    while x < width:
        house = int(rng.uniform(0.15, 0.4) * width)
        top = int(rng.uniform(0.35, 0.7) * height)
        field[top:, x : x + house] = rng.uniform(95, 175)
        for y in range(top + int(0.06 * ppm), height, max(int(0.14 * ppm), 2)):
            for left in range(x + int(0.04 * ppm), min(x + house, width) - int(0.05 * ppm), max(int(0.12 * ppm), 2)):
                field[y : y + int(0.07 * ppm), left : left + int(0.05 * ppm)] = rng.uniform(40, 90)
        x += house
    bushes = fractal_noise(rng, shape, 0.3 * ppm, 5, 0.7)
    low = np.linspace(-4, 1.4, height)[:, None] + 0.6 * bushes > 0.3
    field = np.where(low, 70 + 28 * bushes, field)
    image = to_grey(field)
    bar = max(int(0.035 * ppm), 2)
    cv2.line(image, (width // 2, 0), (width // 2, height), 235, bar)
    cv2.line(image, (0, int(0.35 * height)), (width, int(0.35 * height)), 235, bar)
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), 240, 2 * bar)
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), 110, max(bar // 3, 1))
    return image


def door(rng: np.random.Generator, shape: Shape, ppm: float) -> Image:
    """A panelled door with frame, handle and sign."""
    height, width = shape
    base = float(rng.uniform(85, 200))
    image = to_grey(base + 5.0 * fractal_noise(rng, shape, 0.3 * ppm, 4, 0.7))
    frame = max(int(0.07 * ppm), 2)
    cv2.rectangle(image, (0, 0), (width - 1, height + frame), int(np.clip(base + 45, 0, 255)), 2 * frame)
    cv2.rectangle(image, (frame, frame), (width - frame, height + frame), int(base * 0.5), 2)
    inset = int(0.2 * width)
    for top, bottom in ((0.12, 0.45), (0.55, 0.92)):
        for off, tone in ((0, base * 0.6), (4, min(base * 1.2, 255))):
            corner = inset + off, int(top * height) + off
            cv2.rectangle(image, corner, (width - inset - off, int(bottom * height) - off), int(tone), 3 - off // 4)
    for left, top, right, bottom, tone in (
        (0.82, 0.49, 0.92, 0.51, 30),
        (0.40, 0.20, 0.60, 0.25, 240),
        (0.43, 0.215, 0.57, 0.225, 40),
    ):
        corner = int(left * width), int(top * height)
        cv2.rectangle(image, corner, (int(right * width), int(bottom * height)), tone, -1)
    return image


def books(rng: np.random.Generator, shape: Shape, ppm: float) -> Image:
    """Shelves full of books and boxes, seen from the front."""
    height, width = shape
    image = np.full(shape, 32, np.uint8)
    board = max(int(0.025 * ppm), 2)
    shelves = max(round(height / (0.34 * ppm)), 1)
    edges = np.linspace(0, height, shelves + 1).astype(int)
    for top, bottom in pairwise(edges):
        x = board
        while x < width - board:
            if rng.uniform() < 0.08:
                x += int(rng.uniform(0.04, 0.15) * ppm)
                continue
            thick = max(int(rng.uniform(0.018, 0.06) * ppm), 2)
            tall = int(rng.uniform(0.55, 0.92) * (bottom - top))
            tone = int(rng.integers(45, 230))
            cv2.rectangle(image, (x, bottom - tall), (x + thick - 2, bottom), tone, -1)
            label = int(bottom - tall * rng.uniform(0.5, 0.9))
            cv2.rectangle(image, (x + 1, label), (x + thick - 3, label + int(0.03 * ppm)), (tone + 110) % 256, -1)
            x += thick
        cv2.rectangle(image, (0, bottom - board), (width, bottom), 140, -1)
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), 140, 2 * board)
    return to_grey(image + 4.0 * fractal_noise(rng, shape, 0.05 * ppm, 2))


def drawers(rng: np.random.Generator, shape: Shape, ppm: float) -> Image:
    """The front of a cabinet: wood grain, drawers, handles, labels."""
    height, width = shape
    base = float(rng.uniform(90, 175))
    image = planks(rng, shape, ppm, base, 0.4)
    rows, columns = max(round(height / (0.24 * ppm)), 1), max(round(width / (0.5 * ppm)), 1)
    for row in range(rows):
        for column in range(columns):
            top, left = row * height // rows, column * width // columns
            bottom, right = (row + 1) * height // rows, (column + 1) * width // columns
            cv2.rectangle(image, (left, top), (right, bottom), int(base * 0.35), max(int(0.008 * ppm), 1))
            middle, level = (left + right) // 2, (top + bottom) // 2
            half = int(0.06 * ppm)
            cv2.rectangle(image, (middle - half, level - 2), (middle + half, level + 2), 235, -1)
            if rng.uniform() < 0.5:
                cv2.rectangle(image, (left + half // 2, top + half // 2), (left + 2 * half, top + half), 225, -1)
    return image


def carton(rng: np.random.Generator, shape: Shape, ppm: float) -> Image:
    """Cardboard with tape, print and a label."""
    height, width = shape
    base = float(rng.uniform(120, 160))
    ribs = np.sin(np.arange(width) * (2 * np.pi / max(0.008 * ppm, 2.5)))[None, :]
    image = to_grey(base + 3.0 * ribs + 7.0 * fractal_noise(rng, shape, 0.2 * ppm, 4, 0.7))
    tape = int(0.05 * ppm)
    cv2.rectangle(image, (0, height // 2 - tape // 2), (width, height // 2 + tape // 2), int(base + 45), -1)
    for _ in range(4):
        x, y = int(rng.uniform(0, 0.75) * width), int(rng.uniform(0, 0.75) * height)
        w, h = int(rng.uniform(0.08, 0.22) * ppm), int(rng.uniform(0.05, 0.15) * ppm)
        light = int(rng.choice([235, 40]))
        cv2.rectangle(image, (x, y), (x + w, y + h), light, -1 if rng.uniform() < 0.6 else 3)
        for line in range(y + 4, y + h - 4, max(int(0.018 * ppm), 3)):
            cv2.line(image, (x + 4, line), (x + int(w * rng.uniform(0.4, 0.9)), line), 255 - light, 1)
    return image


def wall(rng: np.random.Generator, shape: Shape, ppm: float, *, windows: bool, base: float) -> Image:
    """A whole wall: plaster, skirting board, and a door, windows, pictures and sockets in a row."""
    height, width = shape
    image = plaster(rng, shape, ppm, base)
    skirting = int(0.1 * ppm)
    image[height - skirting :] = to_grey(np.full((skirting, width), base * 0.55, np.float32))
    image[height - skirting : height - skirting + max(int(0.012 * ppm), 1)] = 225
    x = int(rng.uniform(0.2, 0.6) * ppm)
    door_at = rng.uniform(0.1, 0.8) * width
    had_door = False
    while True:
        gap = int(rng.uniform(0.12, 0.45) * ppm)
        if not had_door and x > door_at and height > 2.15 * ppm:
            w, h, bottom = int(0.95 * ppm), int(2.05 * ppm), height
            painter = door
            had_door = True
        elif windows and rng.uniform() < 0.45:
            w, h = int(rng.uniform(1.0, 1.6) * ppm), int(min(rng.uniform(1.1, 1.4) * ppm, 0.55 * height))
            bottom = height - int(0.9 * ppm)
            painter = window
        else:
            w, h = int(rng.uniform(0.4, 1.1) * ppm), int(rng.uniform(0.4, 0.9) * ppm)
            bottom = height - int(rng.uniform(0.85, 1.25) * ppm)
            painter = picture
        if x + w + int(0.15 * ppm) > width:
            break
        top = max(bottom - h, 0)
        if bottom > top:
            # A soft shadow lifts the thing off the wall.
            shade = image[top : min(bottom + int(0.03 * ppm), height), x : x + w + int(0.03 * ppm)]
            shade[...] = (shade * 0.75).astype(np.uint8)
            image[top:bottom, x : x + w] = painter(rng, (bottom - top, w), ppm)
        # High walls get more rows: pictures, and a band of windows near the top.
        while painter is not door and top > 0.9 * ppm:
            high_up = height - top > 3.0 * ppm
            tall = int(rng.uniform(0.4, 0.8) * ppm)
            upper = int(rng.uniform(0.15, 0.5) * ppm)
            if top - upper - tall < int(0.1 * ppm):
                break
            above = window if high_up and windows else picture
            image[top - upper - tall : top - upper, x : x + w] = above(rng, (tall, w), ppm)
            top -= upper + tall
        x += w + gap
    for _ in range(max(int(width / ppm / 2.5), 1)):
        left, top = int(rng.uniform(0, width - 0.1 * ppm)), height - int(0.38 * ppm)
        size = int(0.08 * ppm)
        cv2.rectangle(image, (left, top), (left + size, top + size), 235, -1)
        cv2.circle(image, (left + size // 2, top + size // 2), max(size // 3, 1), 130, -1, cv2.LINE_AA)
    return image


def occlude_edges(image: Image, ppm: float, reach_m: float = 0.5, depth: float = 0.45) -> Image:
    """Darken towards the borders, as where two walls keep the light from each other."""
    height, width = image.shape
    y = np.minimum(np.arange(height), np.arange(height)[::-1]) / ppm
    x = np.minimum(np.arange(width), np.arange(width)[::-1]) / ppm
    darker_y, darker_x = 1.0 - depth * np.exp(-y / reach_m * 2.5), 1.0 - depth * np.exp(-x / reach_m * 2.5)
    return to_grey(image * darker_y[:, None].astype(np.float32) * darker_x[None, :].astype(np.float32))
