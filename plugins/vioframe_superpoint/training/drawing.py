"""Pictures of a training while it lasts: points on shapes, points and matches on pairs."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from vioframe.checks import Array
from vioframe.features.scoring import Seen
from vioframe.pictures.pairs import PicturePair
from vioframe.types import Image

# BGR, as OpenCV writes.
_RIGHT, _WRONG, _TRUE, _PAPER = (80, 200, 60), (60, 60, 230), (230, 160, 30), 255
_ENLARGED = 3
_SHAPES_A_ROW = 4
_CAPTION_PX = 22
_SHIFT = 4


def draw_points(path: Path, shown: Sequence[tuple[Image, Array, Array]]) -> None:
    """A sheet of pictures (H, W) with points that were found, (N, 2), and the true ones, (M, 2), as rings."""
    tiles = []
    for picture, points, corners in shown:
        tile = _enlarge(picture, _ENLARGED)
        for corner in corners:
            cv2.circle(tile, _place(corner, _ENLARGED), 5 << _SHIFT, _TRUE, 1, cv2.LINE_AA, _SHIFT)
        for point in points:
            near = len(corners) > 0 and float(np.linalg.norm(corners - point, axis=1).min()) <= _ENLARGED
            cv2.circle(tile, _place(point, _ENLARGED), 2 << _SHIFT, _RIGHT if near else _WRONG, -1, cv2.LINE_AA, _SHIFT)
        tiles.append(cv2.copyMakeBorder(tile, 2, 2, 2, 2, cv2.BORDER_CONSTANT, value=(_PAPER,) * 3))
    while len(tiles) % _SHAPES_A_ROW:
        tiles.append(np.full_like(tiles[0], _PAPER))
    rows = [np.hstack(tiles[at : at + _SHAPES_A_ROW]) for at in range(0, len(tiles), _SHAPES_A_ROW)]
    told = "rings: corners; green: found, red: found where there is none"
    _write(path, np.vstack([*rows, _caption(told, rows[0].shape[1])]))


def draw_pairs(path: Path, shown: Sequence[tuple[PicturePair, Seen]]) -> None:
    """Pairs below each other: points of both pictures, and matches as lines from the one to the other."""
    rows = []
    for pair, seen in shown:
        left, right = _enlarge(pair.first, 2), _enlarge(pair.second, 2)
        sheet = np.hstack([left, right])
        offset = left.shape[1]
        for points, repeated, shift in ((seen.first, seen.repeated[0], 0), (seen.second, seen.repeated[1], offset)):
            for point, again in zip(points, repeated, strict=True):
                x, y = _place(point, 2)
                colour = _RIGHT if again else _WRONG
                cv2.circle(sheet, (x + (shift << _SHIFT), y), 2 << _SHIFT, colour, 1, cv2.LINE_AA, _SHIFT)
        for row, column, correct in zip(seen.rows, seen.columns, seen.correct, strict=True):
            a, b = _place(seen.first[row], 2), _place(seen.second[column], 2)
            ends = a, (b[0] + (offset << _SHIFT), b[1])
            cv2.line(sheet, *ends, _RIGHT if correct else _WRONG, 1, cv2.LINE_AA, _SHIFT)
        scores = seen.scores
        told = f"{pair.name}: repeatability {scores.repeatability:.2f}"
        if scores.descriptors is not None:
            of = scores.descriptors
            told += (
                f", {of.correct} of {of.matches} matches within 3 px (green), corners {of.corner_error_px:.1f} px off"
            )
        rows += [sheet, _caption(told, sheet.shape[1])]
    _write(path, np.vstack(rows))


def _enlarge(picture: Image, factor: int) -> Image:
    large = cv2.resize(picture, None, fx=factor, fy=factor, interpolation=cv2.INTER_LINEAR)
    coloured: Image = cv2.cvtColor(large, cv2.COLOR_GRAY2BGR)
    return coloured


def _place(point: Array, factor: int) -> tuple[int, int]:
    """A pixel of the enlarged picture in sixteenths: centres of pixels stay centres."""
    x, y = (np.asarray(point, dtype=np.float64) + 0.5) * factor - 0.5
    return round(float(x) * (1 << _SHIFT)), round(float(y) * (1 << _SHIFT))


def _caption(text: str, width: int) -> Image:
    strip = np.full((_CAPTION_PX, width, 3), _PAPER, dtype=np.uint8)
    cv2.putText(strip, text, (6, _CAPTION_PX - 7), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (30, 30, 30), 1, cv2.LINE_AA)
    return strip


def _write(path: Path, sheet: Image) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), sheet)
