"""Candidates for new points, chosen so that they cover the image."""

import numpy as np

from vioframe.checks import Array, Mask

_CELLS = (8, 5)
_CANDIDATES = 400


def choose_spread(
    points: np.ndarray, values: Array, taken: Array, *, size_px: tuple[int, int], distance: float, count: int
) -> np.ndarray:
    """Indices of at most ``count`` of the points, no two nearer than ``distance``, strong ones and empty cells first.

    The emptiest cells of an 8 × 5 grid choose in turn, each its strongest.

    Args:
        points: (M, 2) px.
        values: (M,) larger is better.
        taken: (K, 2) px already followed, which fill cells but are not kept at a distance here.
        size_px: (width, height) of the image.
        distance: px.
        count: most points wanted.
    """
    if len(points) == 0 or count <= 0:
        return np.zeros(0, dtype=np.int64)
    rows = _best_of_cells(points, values, 0.5 * distance)
    order = _by_need(points[rows], values[rows], taken, size_px)
    # More candidates than this change nothing but the time that the pairwise distances take.
    rows = rows[order[: max(_CANDIDATES, 2 * count)]]
    chosen: np.ndarray = rows[_spaced(points[rows], distance)[:count]]
    return chosen


def crowded(pixels: Array, ages: np.ndarray, ids: np.ndarray, distance: float) -> Mask:
    """Mark the younger of two points (M, 2) px that have run together (M,)."""
    count = len(ids)
    if count < 2:
        return np.zeros(count, dtype=bool)
    x, y = pixels[:, 0], pixels[:, 1]
    first, second = np.nonzero(np.triu((x[:, None] - x) ** 2 + (y[:, None] - y) ** 2 < distance * distance, k=1))
    younger = np.where(
        (ages[first] < ages[second]) | ((ages[first] == ages[second]) & (ids[first] > ids[second])), first, second
    )
    marked: Mask = np.zeros(count, dtype=bool)
    marked[younger] = True
    return marked


def _best_of_cells(points: np.ndarray, values: Array, side: float) -> np.ndarray:
    """The strongest candidate of every square cell."""
    cell = (points / side).astype(np.int64)
    key = cell[:, 1] * 65536 + cell[:, 0]
    order = np.lexsort((-values, key))
    _, first = np.unique(key[order], return_index=True)
    best: np.ndarray = order[first]
    return best


def _by_need(points: np.ndarray, values: Array, taken: Array, size_px: tuple[int, int]) -> np.ndarray:
    """Order in which the emptiest parts of the image come first, and strong before weak in each."""
    cells = np.array(size_px) / np.array(_CELLS)

    def cell_of(pixels: Array) -> np.ndarray:
        index = np.clip((pixels / cells).astype(int), 0, np.array(_CELLS) - 1)
        flat: np.ndarray = index[:, 1] * _CELLS[0] + index[:, 0]
        return flat

    occupied = np.bincount(cell_of(taken), minlength=_CELLS[0] * _CELLS[1])
    cell = cell_of(points)
    by_cell = np.lexsort((-values, cell))
    ordered = cell[by_cell]
    first = np.searchsorted(ordered, ordered)
    rank = np.empty(len(points), dtype=int)
    rank[by_cell] = np.arange(len(points)) - first
    order: np.ndarray = np.lexsort((-values, occupied[cell] + rank))
    return order


def _spaced(points: np.ndarray, distance: float) -> np.ndarray:
    """Indices of a greedy choice, in the order given, with a minimum distance; a round takes many at once."""
    count = len(points)
    x, y = points[:, 0].astype(np.float32), points[:, 1].astype(np.float32)
    near = ((x[:, None] - x) ** 2 + (y[:, None] - y) ** 2 < distance * distance).astype(np.float32)
    # Sums of 0 and 1 as matrix products, because reducing boolean arrays is slow.
    near_earlier = np.tril(near, k=-1)
    alive = np.ones(count, dtype=bool)
    kept = np.zeros(count, dtype=bool)
    while alive.any():
        winners = alive & (near_earlier @ alive.astype(np.float32) == 0.0)
        kept |= winners
        alive &= near @ winners.astype(np.float32) == 0.0
    return np.flatnonzero(kept)
