"""How fast pictures to learn from are made on one core, and sheets of them to look at.

python benchmarks/pictures.py OUT [--count 40] [--seed 0] [--size 320 240]
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from vioframe.pictures import RenderedPlaces, Textures, change_light, generated_pairs
from vioframe.pictures.patches import PAINTERS
from vioframe_superpoint.synthetic import KINDS, SyntheticShapes

COLUMNS = 8


def sheet(images: list[np.ndarray], path: Path) -> None:
    """Pictures side by side, the first 80."""
    images = [image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) for image in images[:80]]
    images += [np.zeros_like(images[0])] * (-len(images) % COLUMNS)
    rows = [np.concatenate(images[k : k + COLUMNS], axis=1) for k in range(0, len(images), COLUMNS)]
    cv2.imwrite(str(path), np.concatenate(rows))


def timed(name: str, make: Callable[[int], object], count: int) -> list:
    """Make pictures, and tell how many a second of CPU; the first round also builds what is kept."""
    start = time.process_time()
    made = [make(k) for k in range(count)]
    first = time.process_time() - start
    start = time.process_time()
    for k in range(count):
        make(k)
    again = time.process_time() - start
    print(f"{name:24} {count / first:8.1f} a second at first {count / again:8.1f} afterwards")
    return made


def with_corners(gray: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Twice as large, corners as rings."""
    large = cv2.resize(cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR), None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST)
    for x, y in 2.0 * corners + 0.5:
        cv2.circle(large, (round(x), round(y)), 3, (0, 255, 0), 1, cv2.LINE_AA)
    return large


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--size", type=int, nargs=2, default=(320, 240))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    cv2.setNumThreads(1)
    size, seed, count = tuple(options.size), options.seed, options.count

    shapes = SyntheticShapes(size_px=(160, 120), seed=seed)
    timed("shapes 160×120", shapes.picture, 5 * count)
    drawn = [SyntheticShapes(seed=seed, kinds=(kind,)).picture(k) for kind in KINDS for k in range(COLUMNS)]
    for part in range(0, len(drawn), 80):
        sheet([with_corners(*each) for each in drawn[part : part + 80]], options.out / f"shapes_{part // 80}.png")

    textures = Textures(size_px=size, count=count, seed=seed)
    pictures = timed("textures", textures.picture, count)
    sheet(pictures, options.out / "textures.png")
    places = RenderedPlaces(size_px=size, count=count, seed=seed)
    sheet(timed("places, one of them", places.picture, count), options.out / "places.png")
    rng = np.random.default_rng(seed)
    lit = timed("light", lambda k: change_light(pictures[k // COLUMNS % len(pictures)], rng), count)
    sheet([pictures[0], *lit], options.out / "light.png")
    for part in (0, 1):
        painted = [p(np.random.default_rng([seed, k]), size[::-1]) for p in PAINTERS[part::2] for k in range(COLUMNS)]
        sheet(painted[:88], options.out / f"surfaces_{part}.png")
    for split in ("illumination", "viewpoint"):
        pairs = list(generated_pairs(split, 16, size, seed))
        sheet([image for pair in pairs for image in (pair.first, pair.second)], options.out / f"pairs_{split}.png")


if __name__ == "__main__":
    main()
