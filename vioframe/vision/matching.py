"""Which points of two images are the same, by their descriptors, among pairs that geometry allows."""

import numpy as np

from vioframe.checks import Array

_BITS = np.array([value.bit_count() for value in range(256)], dtype=np.uint8)


def pairs_near(expected: Array, pixels: Array, radius: Array) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (rows, columns) of which ``pixels`` (K, 2) lies within ``radius`` (M,) px of ``expected`` (M, 2)."""
    # Expanded, the squared distance is one matrix product; single precision is good to a hundredth of a pixel here.
    a, b = expected.astype(np.float32), pixels.astype(np.float32)
    middle = a.mean(axis=0) if len(a) else np.zeros(2, np.float32)
    a, b = a - middle, b - middle
    excess = np.sum(a * a, axis=1)[:, None] + np.sum(b * b, axis=1) - 2.0 * (a @ b.T)
    rows, columns = np.nonzero(excess < (radius.astype(np.float32) ** 2)[:, None])
    return rows, columns


def descriptor_distances(first: np.ndarray, second: np.ndarray) -> Array:
    """Distances (P,) of descriptors (P, D): bits that differ for uint8, Euclidean otherwise."""
    if first.dtype != np.uint8:
        distance: Array = np.linalg.norm(first.astype(np.float32) - second, axis=-1).astype(float)
        return distance
    bits: Array = _BITS[first ^ second].sum(axis=-1, dtype=np.int64).astype(float)
    return bits


def match(
    first: np.ndarray,
    second: np.ndarray,
    rows: np.ndarray,
    columns: np.ndarray,
    *,
    max_distance: float,
    ratio: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Mutual nearest neighbours among the pairs given, clearly nearer than the second nearest.

    Args:
        first: (M, D) descriptors.
        second: (K, D) of the same kind.
        rows: (P,) of ``first`` and columns: (P,) of ``second``, the pairs that are possible.
        columns: see ``rows``.
        max_distance: of a match.
        ratio: a match's distance must be below this share of the second nearest's, on either side.

    Returns:
        rows (N,) ascending, and columns (N,), each at most once.
    """
    distance = descriptor_distances(first[rows], second[columns])
    best_of_row = _clearly_nearest(rows, distance, ratio)
    best_of_column = _clearly_nearest(columns, distance, ratio)
    chosen = np.intersect1d(best_of_row, best_of_column, assume_unique=True)
    chosen = chosen[distance[chosen] <= max_distance]
    chosen = chosen[np.argsort(rows[chosen])]
    return rows[chosen], columns[chosen]


def _clearly_nearest(group: np.ndarray, distance: Array, ratio: float) -> np.ndarray:
    """Of each group the nearest pair, where the second nearest is clearly further."""
    order = np.lexsort((distance, group))
    ordered = group[order]
    first = np.flatnonzero(np.concatenate([[True], ordered[1:] != ordered[:-1]])) if len(ordered) else order
    nearest = distance[order[first]]
    second = np.full(len(first), np.inf)
    follows = first + 1 < len(ordered)
    same = follows.copy()
    same[follows] = ordered[first[follows] + 1] == ordered[first[follows]]
    second[same] = distance[order[first[same] + 1]]
    clear: np.ndarray = order[first[nearest <= ratio * second]]
    return clear


def all_distances(first: np.ndarray, second: np.ndarray) -> Array:
    """Distances (M, K) of all pairs of descriptors (M, D) and (K, D): bits that differ for uint8, Euclidean otherwise.

    In double precision, where the difference of nearly equal vectors still is one.
    """
    bits = first.dtype == np.uint8
    a, b = (np.unpackbits(d, axis=1).astype(np.float32) if bits else d.astype(float) for d in (first, second))
    squared: Array = np.sum(a * a, axis=1)[:, None] + np.sum(b * b, axis=1) - 2.0 * (a @ b.T)
    # Zeros and ones differ by their squared distance; their sums are whole numbers.
    return squared.astype(float) if bits else np.sqrt(np.maximum(squared, 0.0))


def mutual_nearest(distance: Array, max_distance: float | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Rows (N,) ascending and columns (N,) that are each other's nearest in ``distance`` (M, K)."""
    if 0 in distance.shape:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    nearest = distance.argmin(axis=1)
    rows = np.flatnonzero(distance.argmin(axis=0)[nearest] == np.arange(len(distance)))
    columns = nearest[rows]
    if max_distance is not None:
        near = distance[rows, columns] <= max_distance
        rows, columns = rows[near], columns[near]
    return rows, columns
