"""A pair with what each method made of it, drawn: right matches, wrong ones, points found again or not."""

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np

from vioframe.checks import Array, Mask
from vioframe.features.scoring import Seen
from vioframe.features.table import pair_cell
from vioframe.pictures.pairs import PicturePair

_RIGHT, _WRONG, _LONELY = (80, 170, 60), (40, 40, 215), (40, 130, 230)
"""Blue, green, red: matched rightly or found again; matched wrongly; not found again."""
_PAPER = (255, 255, 255)
_GAP = 6
_HEAD = 22
# Lines and rings keep smooth edges in fractions of a pixel of this many bits.
_SHIFT = 4
_MOST_LINES = 400
# Pictures are enlarged to about this width, for lines to stay thin in them.
_WIDTH = 400


def draw_matches(pair: PicturePair, seen: Mapping[str, Seen], path: Path) -> None:
    """Draw a row for each method into a file: both pictures side by side, matches as lines, points as rings.

    Args:
        pair: at the size of the protocol.
        seen: by method.
        path: of the file, .jpg or .png.
    """
    rows = [_row(pair, name, one) for name, one in seen.items()]
    columns = 2 if len(rows) > 3 else 1
    blank = np.full_like(rows[0], 255)
    rows += [blank] * (-len(rows) % columns)
    gap = np.full((rows[0].shape[0], 3 * _GAP, 3), 255, np.uint8)
    lines = []
    for start in range(0, len(rows), columns):
        pieces = [piece for row in rows[start : start + columns] for piece in (gap, row)][1:]
        lines.append(np.concatenate(pieces, axis=1))
    cv2.imwrite(str(path), np.concatenate(lines, axis=0))


def _row(pair: PicturePair, name: str, seen: Seen) -> np.ndarray:
    height, width = pair.first.shape
    scale = max(1, round(_WIDTH / width))
    size = (width * scale, height * scale)
    pictures = [
        cv2.cvtColor(cv2.resize(picture, size, interpolation=cv2.INTER_LINEAR), cv2.COLOR_GRAY2BGR)
        for picture in (pair.first, pair.second)
    ]
    gap = np.full((size[1], _GAP, 3), 255, np.uint8)
    canvas = np.concatenate([pictures[0], gap, pictures[1]], axis=1)
    first = _enlarged(seen.first, scale)
    second = _enlarged(seen.second, scale) + np.array([size[0] + _GAP, 0.0])
    if len(seen.rows):
        _draw_lines(canvas, first[seen.rows], second[seen.columns], seen.correct)
    else:
        for points, repeated in zip((first, second), seen.repeated, strict=True):
            _draw_rings(canvas, points, repeated)
    head = np.full((_HEAD, canvas.shape[1], 3), _PAPER, np.uint8)
    kind = "right matches, corner error" if seen.scores.descriptors is not None else "points"
    text = f"{name}: {pair_cell(seen.scores)} ({kind})"
    cv2.putText(head, text, (4, _HEAD - 7), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (40, 40, 40), 1, cv2.LINE_AA)
    return np.concatenate([head, canvas], axis=0)


def _enlarged(pixels: Array, scale: int) -> Array:
    """Pixels of the picture in one that is ``scale`` times as large."""
    return (pixels + 0.5) * scale - 0.5


def _fixed(point: Array) -> tuple[int, int]:
    x, y = np.rint(point * 2**_SHIFT).astype(int).tolist()
    return x, y


def _draw_lines(canvas: np.ndarray, first: Array, second: Array, correct: Mask) -> None:
    """Wrong ones below, right ones above; every second or third where there are too many to tell apart."""
    order = np.argsort(correct, kind="stable")[:: max(1, -(-len(correct) // _MOST_LINES))]
    for index in order.tolist():
        colour = _RIGHT if correct[index] else _WRONG
        cv2.line(canvas, _fixed(first[index]), _fixed(second[index]), colour, 1, cv2.LINE_AA, _SHIFT)


def _draw_rings(canvas: np.ndarray, points: Array, repeated: Mask) -> None:
    for point, again in zip(points, repeated.tolist(), strict=True):
        cv2.circle(canvas, _fixed(point), 3 << _SHIFT, _RIGHT if again else _LONELY, 1, cv2.LINE_AA, _SHIFT)
