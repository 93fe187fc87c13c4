"""Textures and the atlas they are looked up in: one image that holds every surface at every resolution.

Aliasing is kept out by choosing, for each pixel, the copy whose texels are about as large as the pixel's
footprint on the surface (Williams, "Pyramidal parametrics", SIGGRAPH 1983), in steps of √2.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from vioframe.checks import Array

LEVELS = 18
"""Copies of a texture, each 1/√2 of the one before."""

_PAD = 2
_ATLAS_WIDTH = 16_384
_SMALLEST = 4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Texture:
    """A picture of a surface, repeated without end in both directions.

    Attributes:
        image: (H, W) uint8.
        size_m: (width, height) that it covers.
        gain: brightness of the surface relative to its picture, where it gives light of its own.
    """

    image: np.ndarray
    size_m: tuple[float, float]
    gain: float = 1.0


class Atlas:
    """All textures in one image, for one lookup of all pixels.

    Attributes:
        image: (H, W) uint8.
        left, top: (T · LEVELS,) float32 px: position of a copy, such that fraction 0 of the texture is at
            ``left - 0.5`` in pixel-centre coordinates.
        width, height: (T · LEVELS,) float32 px: size of a copy.
        texels_per_metre: (T,) of the finest copy, the larger of both directions.
    """

    def __init__(self, textures: Sequence[Texture]) -> None:
        copies: list[tuple[int, np.ndarray]] = []
        for number, texture in enumerate(textures):
            previous = [texture.image, texture.image]
            for level in range(LEVELS):
                height, width = (max(round(n * 2.0 ** (-level / 2)), _SMALLEST) for n in texture.image.shape)
                copy = texture.image
                if level > 0:
                    # From the copy an octave larger: an average over two texels, not over 1.4.
                    copy = cv2.resize(previous[0], (width, height), interpolation=cv2.INTER_AREA)
                copies.append((number * LEVELS + level, copy))
                previous = [previous[1], copy] if level > 0 else [copy, copy]
        count = len(copies)
        self.left, self.top, self.width, self.height = (np.zeros(count, np.float32) for _ in range(4))
        places = np.zeros((count, 2), dtype=int)
        x = y = shelf = 0
        order = sorted(copies, key=lambda item: -item[1].shape[0])
        for index, copy in order:
            height, width = copy.shape[0] + 2 * _PAD, copy.shape[1] + 2 * _PAD
            if x + width > _ATLAS_WIDTH:
                x, y, shelf = 0, y + shelf, 0
            places[index] = x + _PAD, y + _PAD
            self.left[index], self.top[index] = x + _PAD, y + _PAD
            self.width[index], self.height[index] = copy.shape[1], copy.shape[0]
            x, shelf = x + width, max(shelf, height)
        self.image = np.zeros((y + shelf, _ATLAS_WIDTH), np.uint8)
        for index, copy in copies:
            x, y = places[index] - _PAD
            padded = cv2.copyMakeBorder(copy, _PAD, _PAD, _PAD, _PAD, cv2.BORDER_WRAP)
            self.image[y : y + padded.shape[0], x : x + padded.shape[1]] = padded
        self.texels_per_metre: Array = np.array(
            [max(t.image.shape[1] / t.size_m[0], t.image.shape[0] / t.size_m[1]) for t in textures]
        )


def fractal_noise(
    rng: np.random.Generator, shape: tuple[int, int], coarsest: float, octaves: int, roughness: float = 0.5
) -> np.ndarray:
    """Smooth random field (H, W) float32 of about unit deviation, repeating at its borders.

    Args:
        rng: generator.
        shape: (H, W).
        coarsest: size of the largest blobs, px.
        octaves: how many halvings follow.
        roughness: height of each octave relative to the one before.
    """
    height, width = shape
    total = np.zeros(shape, np.float32)
    weight, power, cell = 1.0, 0.0, float(coarsest)
    for _ in range(octaves):
        rows, columns = max(round(height / cell), 1), max(round(width / cell), 1)
        coarse = rng.standard_normal((rows, columns), dtype=np.float32)
        margin = 2
        wrapped = np.pad(coarse, margin, mode="wrap")
        scale_y, scale_x = height / rows, width / columns
        big = cv2.resize(
            wrapped,
            (round(wrapped.shape[1] * scale_x), round(wrapped.shape[0] * scale_y)),
            interpolation=cv2.INTER_CUBIC,
        )
        y, x = round(margin * scale_y), round(margin * scale_x)
        total += weight * big[y : y + height, x : x + width]
        power += 0.5 * weight**2
        weight, cell = weight * roughness, cell / 2.0
        if cell < 1.0:
            break
    return total / np.float32(np.sqrt(power))


def to_grey(values: np.ndarray) -> np.ndarray:
    """Rounded and clipped to uint8."""
    return np.clip(values + 0.5, 0.0, 255.0).astype(np.uint8)
