"""Labelled pictures on disk: made once, in chunks, and read by every training that is given the folder.

A folder holds ``labels.json``, which says what made it, and for each chunk ``pictures-NNNN.npy`` (n, H, W) uint8 and
``points-NNNN.npz`` with ``points`` (P, 2) float32 px, picture after picture, and ``counts`` (n,), the
``seconds`` it took, and ``seen`` (n, ⌈H W / 8⌉), bits of which pixels were looked at often enough to have a label. A
chunk appears whole or not at all, its points last, so that making them can be stopped and gone on with.
"""

import json
import logging
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vioframe.checks import Array, Mask
from vioframe.errors import DataError
from vioframe.types import Image

ABOUT_FILE = "labels.json"
FORMAT = "vioframe-superpoint-labels-2"
"""The first had no ``seen``: all pixels count as looked at."""

_OLD_FORMAT = "vioframe-superpoint-labels-1"

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LabelledPictures:
    """Pictures and their points.

    Attributes:
        pictures: each (H, W) uint8.
        points: of each, (P, 2) px.
        seen: of each, bits of the pixels that may have a label.
        about: what made them.
    """

    pictures: Sequence[Image]
    points: Sequence[Array]
    seen: Sequence[NDArray[np.uint8]]
    about: Mapping[str, Any]

    def __len__(self) -> int:
        return len(self.pictures)

    def seen_in(self, number: int) -> Mask:
        """Where in a picture (H, W) bool there may be labels: elsewhere that there is none says nothing."""
        height, width = self.pictures[number].shape
        bits = np.unpackbits(self.seen[number], count=height * width)
        mask: Mask = bits.reshape(height, width).astype(np.bool_)
        return mask

    def parted(self, last: int) -> "tuple[LabelledPictures, LabelledPictures]":
        """All but the last so many, and those."""
        one, other = (
            LabelledPictures(
                pictures=self.pictures[part], points=self.points[part], seen=self.seen[part], about=self.about
            )
            for part in (slice(None, -last), slice(-last, None))
        )
        return one, other


class LabelStore:
    """Writes and reads a folder of labelled pictures.

    Args:
        folder: need not exist.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def begin(self, about: Mapping[str, Any]) -> None:
        """Say what makes the labels, or find that the folder was begun with the same.

        Raises:
            DataError: it was begun with something else.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        plain = json.loads(json.dumps(about))
        if self.exists:
            differing = self.differing({"format": FORMAT, **about})
            if differing:
                raise DataError(
                    f"{self.folder} was begun with other {differing[0]}: name another folder "
                    "(frontend.training.labels) or delete it"
                )
            return
        _write_text(self.folder / ABOUT_FILE, json.dumps({"format": FORMAT, **plain}, indent=2) + "\n")

    def differing(self, about: Mapping[str, Any]) -> list[str]:
        """In what the folder was begun otherwise than ``about`` says, with both values.

        Raises:
            DataError: it is damaged, or not one.
        """
        plain, stored = json.loads(json.dumps(about)), self.about()
        return [
            f"{name} ({_short(stored.get(name))}, not {_short(plain[name])})"
            for name in sorted(plain)
            if plain[name] != stored.get(name)
        ]

    def about(self) -> dict[str, Any]:
        """What ``labels.json`` says.

        Raises:
            DataError: it is damaged, or not one.
        """
        path = self.folder / ABOUT_FILE
        try:
            about = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise DataError(f"{path} cannot be read ({error}): delete the folder, or name another") from error
        if not isinstance(about, dict) or about.get("format") not in (FORMAT, _OLD_FORMAT):
            raise DataError(f"{path} does not describe labelled pictures of vioframe: name another folder")
        return about

    def tell(self, told: Mapping[str, Any]) -> None:
        """Add to ``labels.json`` what is known when all is done."""
        about = {**self.about(), "told": dict(told)}
        _write_text(self.folder / ABOUT_FILE, json.dumps(about, indent=2) + "\n")

    @property
    def exists(self) -> bool:
        """Whether the folder was begun."""
        return (self.folder / ABOUT_FILE).exists()

    @property
    def is_complete(self) -> bool:
        """Whether all was made."""
        return self.exists and "told" in self.about()

    def has(self, chunk: int) -> bool:
        """Whether a chunk is there."""
        return self._points(chunk).exists()

    def write(
        self,
        chunk: int,
        pictures: Sequence[Image],
        points: Sequence[Array],
        seen: Sequence[Mask],
        seconds: float = 0.0,
    ) -> None:
        """Write a chunk that took so many seconds: pictures (H, W), their points (P, 2) px and what was seen (H, W)."""
        partial = self.folder / f"chunk-{chunk:04d}.partial"
        with partial.open("wb") as file:
            np.save(file, np.stack(pictures), allow_pickle=False)
        os.replace(partial, self._pictures(chunk))
        counts = np.array([len(each) for each in points], dtype=np.int64)
        with partial.open("wb") as file:
            np.savez(
                file,
                points=np.concatenate(points).astype(np.float32),
                counts=counts,
                seen=np.stack([np.packbits(each) for each in seen]),
                seconds=seconds,
            )
        os.replace(partial, self._points(chunk))

    def seconds(self) -> float:
        """What all chunks took together."""
        total, chunk = 0.0, 0
        while self.has(chunk):
            with np.load(self._points(chunk), allow_pickle=False) as file:
                total += float(file["seconds"])
            chunk += 1
        return total

    def read_chunk(self, chunk: int) -> tuple[Array, list[Array], NDArray[np.uint8]]:
        """Pictures (n, H, W), which stay on disk until looked at, points of each, and bits (n, ...) of what was seen.

        Raises:
            DataError: missing or damaged.
        """
        try:
            pictures = np.load(self._pictures(chunk), mmap_mode="r", allow_pickle=False)
            with np.load(self._points(chunk), allow_pickle=False) as file:
                points, counts = file["points"], file["counts"]
                pixels = int(np.prod(pictures.shape[1:]))
                everything = np.full((len(counts), -(-pixels // 8)), 255, dtype=np.uint8)
                seen = file["seen"] if "seen" in file else everything
            ends = np.cumsum(counts)
            whole = len(counts) == len(pictures) and int(ends[-1]) == len(points) and pictures.dtype == np.uint8
            whole = whole and seen.shape == everything.shape and seen.dtype == np.uint8
        except (OSError, ValueError, KeyError, IndexError) as error:
            raise DataError(f"chunk {chunk} of {self.folder} is damaged ({error}): delete the folder") from error
        if not whole:
            raise DataError(
                f"chunk {chunk} of {self.folder} is damaged (points and pictures differ): delete the folder"
            )
        return pictures, np.split(points, ends[:-1]), seen

    def read(self, count: int | None = None) -> LabelledPictures:
        """All that is there, or the first ``count`` pictures.

        Raises:
            DataError: there is nothing, too little, or something damaged.
        """
        about = self.about()
        pictures: list[Image] = []
        points: list[Array] = []
        seen: list[NDArray[np.uint8]] = []
        chunk = 0
        if about["format"] == _OLD_FORMAT:
            log.warning(
                "%s does not say where no label could be, near the edges of pictures: there it teaches that there is "
                "no point; labels made anew do not",
                self.folder,
            )
        while self.has(chunk) and (count is None or len(pictures) < count):
            more, theirs, looked = self.read_chunk(chunk)
            pictures.extend(more)
            points.extend(theirs)
            seen.extend(looked)
            chunk += 1
        if not pictures or (count is not None and len(pictures) < count):
            raise DataError(f"{self.folder} holds {len(pictures)} labelled pictures, {count or 'some'} are needed")
        return LabelledPictures(pictures=pictures[:count], points=points[:count], seen=seen[:count], about=about)

    def _pictures(self, chunk: int) -> Path:
        return self.folder / f"pictures-{chunk:04d}.npy"

    def _points(self, chunk: int) -> Path:
        return self.folder / f"points-{chunk:04d}.npz"


def cell_classes(points: Array, size_px: tuple[int, int], rng: np.random.Generator) -> NDArray[np.int64]:
    """Classes (h, w) int64 of the cells of a picture: where in it a point lies, or 64.

    Of several points in a cell one is taken at random.

    Args:
        points: (P, 2) px; those outside are left out, NaN too.
        size_px: (width, height) of the picture, multiples of 8.
        rng: generator.
    """
    width, height = size_px
    classes = np.full((height // 8, width // 8), 64, dtype=np.int64)
    with np.errstate(invalid="ignore"):
        pixels = np.rint(points)
        inside = (pixels >= 0).all(axis=1) & (pixels[:, 0] < width) & (pixels[:, 1] < height)
    whole = pixels[inside].astype(np.int64)
    whole = whole[rng.permutation(len(whole))]
    x, y = whole.T
    classes[y // 8, x // 8] = (y % 8) * 8 + x % 8
    return classes


def whole_cells(mask: Mask) -> Mask:
    """Cells (h, w) bool all of whose pixels are in ``mask`` (8h, 8w)."""
    height, width = mask.shape
    cells: Mask = np.all(mask.reshape(height // 8, 8, width // 8, 8), axis=(1, 3))
    return cells


def _write_text(path: Path, text: str) -> None:
    partial = path.with_suffix(".partial")
    partial.write_text(text, encoding="utf-8")
    os.replace(partial, path)


def _short(value: object) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
