"""Where pictures to learn from come from: painted scenes and surfaces, simulated places, a folder, or a mixture.

A picture is a pure function of a source's options and of its index, so that workers share the work without sharing
anything else, and a picture can be made again instead of being kept.
"""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, Protocol

import cv2
import numpy as np

from vioframe.checks import check_positive
from vioframe.data.simulator.texture import fractal_noise
from vioframe.errors import ConfigError, DataError
from vioframe.pictures.homographies import HomographyOptions, sample_homography
from vioframe.pictures.lighting import LightingOptions, change_light
from vioframe.pictures.patches import PAINTERS, TextureBank
from vioframe.pictures.scenery import SCENES, paint_scene
from vioframe.types import Image

log = logging.getLogger(__name__)

SMALLEST_PX = 32
"""Shorter sides make no picture."""

SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".ppm", ".pgm", ".pnm", ".bmp", ".tif", ".tiff", ".webp"})
"""Of files that :class:`PictureFolder` takes for pictures."""

COMMON_LIGHT = LightingOptions(
    shading=0.5,
    shading_stops=1.0,
    shadow=0.15,
    spotlight=0.05,
    vignetting=0.2,
    exposure=0.3,
    exposure_stops=0.7,
    tone=0.3,
    contrast=0.3,
    gamma=0.3,
    low_light=0.0,
    noise=0.4,
    noise_dn=2.0,
    speckle=0.0,
    blur=0.3,
    blur_sigma_px=0.9,
    motion_blur=0.0,
    compression=0.0,
)
"""What is done to every made picture: the light and the camera of a usual photograph. No traces of compression: in two
views of one picture they would be a part of the scene."""

# Tags that keep the random numbers of one purpose apart from those of all others.
_TEXTURES, _HELD_OUT_TEXTURES, _MIXTURE, _VALIDATION_TEXTURES = 72, 73, 75, 79
_TEXTURES_OF_A_KIND = 12
_FRESH = 0.22
_SLANTS = HomographyOptions(patch_ratio=0.9, perspective=0.25, scale=0.3, max_angle=float(np.pi), overflow=0.0)
_PERIOD = 60
# A picture is painted anew where fewer of its blocks have any contrast.
_BLOCK_PX = 16
_LEAST_DEVIATION_DN = 5.0
_LEAST_SHARE = 0.3
TRIES = 4
"""How often a picture is made until it shows something."""


Purpose = Literal["training", "validation", "held_out"]
"""Pictures of one purpose have nothing in common with those of another, whatever the seeds."""

_TAGS: dict[Purpose, int] = {
    "training": _TEXTURES,
    "validation": _VALIDATION_TEXTURES,
    "held_out": _HELD_OUT_TEXTURES,
}


class PictureSource(Protocol):
    """Pictures by number."""

    def __len__(self) -> int:
        """How many there are."""
        ...

    def picture(self, index: int) -> Image:
        """Picture ``index`` (H, W) uint8; always the same."""
        ...


def check_size(owner: str, size_px: Sequence[int]) -> tuple[int, int]:
    """(width, height) as two integers.

    Raises:
        ConfigError: not two, or one that is too small.
    """
    if len(size_px) != 2 or min(size_px) < SMALLEST_PX:
        raise ConfigError(
            f"{owner}.size_px must be [width, height] of at least {SMALLEST_PX} px each, got {list(size_px)}"
        )
    return int(size_px[0]), int(size_px[1])


class Textures:
    """Painted surfaces and scenes put together from them, in perspective, in some light.

    Args:
        size_px: (width, height).
        count: how many.
        seed: of all.
        purpose: what they are for.
    """

    def __init__(self, *, size_px: Sequence[int], count: int, seed: int = 0, purpose: Purpose = "training") -> None:
        check_positive("pictures", count=count)
        self._size_px = check_size("pictures", size_px)
        self._count = count
        self._seed = seed
        self._tag = _TAGS[purpose]
        self._bank = TextureBank([seed, self._tag], _TEXTURES_OF_A_KIND * len(PAINTERS))
        self._scenes = tuple(SCENES)
        self._shares = np.array([SCENES[name][0] for name in self._scenes])

    def __len__(self) -> int:
        """How many there are."""
        return self._count

    def picture(self, index: int) -> Image:
        """Picture ``index`` (H, W) uint8."""
        for attempt in range(TRIES):
            rng = np.random.default_rng([self._seed, self._tag, index, attempt])
            if rng.random() < _FRESH:
                image = _fresh_surface(rng, self._size_px)
            else:
                image = paint_scene(str(rng.choice(self._scenes, p=self._shares)), self._size_px, self._bank, rng)
            if shows_something(image):
                break
        return change_light(image, rng, COMMON_LIGHT)


def shows_something(image: Image) -> bool:
    """Whether enough of a picture (H, W) uint8 differs from a blank wall to learn from or to measure on."""
    size = max(image.shape[1] // _BLOCK_PX, 1), max(image.shape[0] // _BLOCK_PX, 1)
    values = image.astype(np.float32)
    mean = cv2.resize(values, size, interpolation=cv2.INTER_AREA)
    square = cv2.resize(values * values, size, interpolation=cv2.INTER_AREA)
    return bool(np.mean(square - mean * mean > _LEAST_DEVIATION_DN**2) >= _LEAST_SHARE)


def _fresh_surface(rng: np.random.Generator, size_px: tuple[int, int]) -> Image:
    """One surface of its own, or two that show in patches, at a slant."""
    shape = size_px[1], size_px[0]
    image = PAINTERS[int(rng.integers(len(PAINTERS)))](rng, shape)
    if rng.random() < 0.35:
        other = PAINTERS[int(rng.integers(len(PAINTERS)))](rng, shape)
        cover = (
            3.0 * rng.uniform(0.5, 6.0) * (fractal_noise(rng, shape, rng.uniform(20.0, 120.0), 4) + rng.uniform(-1, 1))
        )
        weight = np.clip(0.5 + cover, 0.0, 1.0).astype(np.float32)
        image = (weight * image + (1.0 - weight) * other).astype(np.uint8)
    H = sample_homography(size_px, rng, _SLANTS)
    slanted: Image = cv2.warpPerspective(image, H, size_px, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
    return slanted


class PictureFolder:
    """Pictures of a folder and the folders in it, grey, cut and shrunk to one size.

    A file that cannot be read gives its place to the next one that can; a warning names the first, once.

    Args:
        folder: where.
        size_px: (width, height): the largest middle part of this shape, resized.

    Attributes:
        unreadable: files met so far that could not be read.

    Raises:
        DataError: no folder, or no picture in it.
    """

    def __init__(self, folder: str | Path, *, size_px: Sequence[int]) -> None:
        self._size_px = check_size("pictures", size_px)
        self._folder = Path(folder)
        if not self._folder.is_dir():
            raise DataError(f"pictures.folder={str(folder)!r} is no folder: give one with pictures in it")
        self._files = sorted(path for path in self._folder.rglob("*") if path.suffix.lower() in SUFFIXES)
        if not self._files:
            endings = ", ".join(sorted(SUFFIXES))
            raise DataError(f"pictures.folder={str(folder)!r} holds no picture: none of its files ends in {endings}")
        self.unreadable: set[Path] = set()

    def __len__(self) -> int:
        """How many files there are."""
        return len(self._files)

    def picture(self, index: int) -> Image:
        """Picture ``index`` (H, W) uint8.

        Raises:
            DataError: no file can be read.
        """
        for number in range(len(self._files)):
            path = self._files[(index + number) % len(self._files)]
            if path in self.unreadable:
                continue
            image = read_gray(path)
            if image is not None:
                return fit_picture(image, self._size_px)
            if not self.unreadable:
                log.warning(
                    "pictures.folder=%s: %s cannot be read and is left out, as will be others", self._folder, path
                )
            self.unreadable.add(path)
        raise DataError(f"pictures.folder={str(self._folder)!r}: none of its {len(self._files)} pictures can be read")


def read_gray(path: Path) -> Image | None:
    """A file as grey picture (H, W) uint8; None where it is none."""
    try:
        code = np.fromfile(path, dtype=np.uint8)
        image = cv2.imdecode(code, cv2.IMREAD_GRAYSCALE) if code.size else None
    except (OSError, cv2.error):
        return None
    return None if image is None else np.asarray(image, dtype=np.uint8)


def fit_picture(image: Image, size_px: tuple[int, int]) -> Image:
    """The largest middle part of the wanted shape, resized to (width, height)."""
    height, width = image.shape
    scale = min(width / size_px[0], height / size_px[1])
    cut_width, cut_height = max(round(scale * size_px[0]), 1), max(round(scale * size_px[1]), 1)
    left, top = (width - cut_width) // 2, (height - cut_height) // 2
    part = image[top : top + cut_height, left : left + cut_width]
    how = cv2.INTER_AREA if scale > 1.0 else cv2.INTER_LINEAR
    fitted: Image = cv2.resize(part, size_px, interpolation=how)
    return fitted


class Mixture:
    """Pictures of several sources in fixed shares, each source's in its own order and again from its first.

    Args:
        sources: two or more, or one.
        shares: of each, relative to each other.
        count: how many.
        seed: of the order in which they take turns.

    Raises:
        ConfigError: shares that do not fit.
    """

    def __init__(self, sources: Sequence[PictureSource], shares: Sequence[float], *, count: int, seed: int = 0) -> None:
        check_positive("pictures", count=count)
        if len(sources) != len(shares) or not sources or min(shares) < 0.0 or sum(shares) <= 0.0:
            raise ConfigError(
                f"{len(sources)} sources of pictures need as many shares, none negative, got {list(shares)}"
            )
        self._sources = tuple(sources)
        self._count = count
        # Sources take turns by a pattern that repeats, in which each has its share to a sixtieth.
        ends = np.rint(_PERIOD * np.cumsum(np.asarray(shares, dtype=float)) / sum(shares)).astype(int)
        turn = np.searchsorted(ends, np.arange(_PERIOD), side="right")
        self._turn = np.random.default_rng([seed, _MIXTURE]).permutation(turn)
        self._each = np.bincount(self._turn, minlength=len(sources))
        self._before = np.array([np.sum(self._turn[:k] == self._turn[k]) for k in range(_PERIOD)])

    def __len__(self) -> int:
        """How many there are."""
        return self._count

    def picture(self, index: int) -> Image:
        """Picture ``index`` (H, W) uint8."""
        rounds, place = divmod(index, _PERIOD)
        number = int(self._turn[place])
        source = self._sources[number]
        return source.picture((rounds * int(self._each[number]) + int(self._before[place])) % len(source))
