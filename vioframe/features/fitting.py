"""Pairs of pictures brought to the size of a protocol, and what both of a pair show."""

import cv2
import numpy as np

from vioframe.checks import Array, Mask
from vioframe.pictures.homographies import valid_mask
from vioframe.pictures.pairs import PicturePair
from vioframe.types import Image


def fit_pair(pair: PicturePair, size_px: tuple[int, int]) -> PicturePair:
    """Both pictures scaled to cover ``size_px`` (width, height) and cut around the middle, the homography with them."""
    first, to_first = fit_picture(pair.first, size_px)
    second, to_second = fit_picture(pair.second, size_px)
    H = to_second @ pair.H_second_first @ np.linalg.inv(to_first)
    return PicturePair(first=first, second=second, H_second_first=H, name=pair.name, split=pair.split)


def fit_picture(picture: Image, size_px: tuple[int, int]) -> tuple[Image, Array]:
    """The picture (H, W) uint8 scaled to cover ``size_px`` and cut around the middle.

    Returns:
        the picture (height, width), and the homography (3, 3) from pixels of the given one to its pixels.
    """
    height, width = picture.shape
    scale = max(size_px[0] / width, size_px[1] / height)
    # Rounding may miss the size asked for by one pixel.
    scaled_px = max(round(width * scale), size_px[0]), max(round(height * scale), size_px[1])
    if scaled_px != (width, height):
        how = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR
        picture = cv2.resize(picture, scaled_px, interpolation=how)
    left, top = (scaled_px[0] - size_px[0]) // 2, (scaled_px[1] - size_px[1]) // 2
    cut: Image = np.ascontiguousarray(picture[top : top + size_px[1], left : left + size_px[0]])
    # The centre of pixel x lies x + 1/2 pixels from the edge, before and after.
    x, y = scaled_px[0] / width, scaled_px[1] / height
    to_cut = np.array([[x, 0.0, 0.5 * x - 0.5 - left], [0.0, y, 0.5 * y - 0.5 - top], [0.0, 0.0, 1.0]])
    return cut, to_cut


def shared_areas(H_second_first: Array, size_px: tuple[int, int], border_px: int) -> tuple[Mask, Mask]:
    """Where (H, W) each picture shows what the other shows too, ``border_px`` away from the edges of both.

    Args:
        H_second_first: (3, 3), pixels of the first picture to those of the second.
        size_px: (width, height) of both.
        border_px: see above.
    """
    inner = valid_mask(np.eye(3), size_px, border_px)
    in_first = inner & valid_mask(np.linalg.inv(H_second_first), size_px, border_px)
    in_second = inner & valid_mask(H_second_first, size_px, border_px)
    return in_first, in_second
