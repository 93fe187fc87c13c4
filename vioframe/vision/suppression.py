"""The strongest of many candidates, none beside a stronger one."""

import numpy as np

from vioframe.checks import Array


def strongest(pixels: Array, scores: Array, *, radius_px: int, count: int) -> np.ndarray:
    """Indices of at most ``count`` points, strongest first, no two in a square of half side ``radius_px``.

    Greedy: a point is taken where no stronger one has been; of equals the first.

    Args:
        pixels: (M, 2) px, not negative; rounded to whole pixels for this.
        scores: (M,) larger is better.
        radius_px: 0 keeps one point a pixel.
        count: most points wanted.
    """
    order = np.argsort(-scores, kind="stable")
    cells = np.rint(pixels[order]).astype(np.int64)
    width, height = (cells.max(axis=0) + 1).tolist() if len(cells) else (0, 0)
    free = np.ones((height + radius_px, width + radius_px), dtype=bool)
    reach = radius_px + 1
    kept: list[int] = []
    for index, (x, y) in zip(order.tolist(), cells.tolist(), strict=True):
        if len(kept) == count:
            break
        if free[y, x]:
            kept.append(index)
            free[max(y - radius_px, 0) : y + reach, max(x - radius_px, 0) : x + reach] = False
    return np.array(kept, dtype=np.int64)
