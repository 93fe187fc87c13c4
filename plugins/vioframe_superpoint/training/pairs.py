"""Two views of a labelled picture, in different light: what the third stage learns from. No torch here."""

from collections.abc import Mapping
from typing import TypedDict

import cv2
import numpy as np
from numpy.typing import NDArray

from vioframe.checks import Array, Mask
from vioframe.pictures import change_light, sample_homography, valid_mask, warp_picture, warp_points
from vioframe.types import Image
from vioframe_superpoint.training.labels import cell_classes, whole_cells
from vioframe_superpoint.training.options import PairOptions

# px, from where a picture ends, within which nothing is matched: a corner of black is none of the scene. What labels
# were not looked for there, adaptation.border_px, is in what was seen.
_BORDER_PX = 3
# Tries for points that both views show, as a multiple of those that are wanted.
_TRIES = 4


class Pair(TypedDict):
    """Two views of one picture.

    ``images`` (2, H, W) uint8; ``classes`` (2, h, w) int64 of the cells, 64 for none; ``known`` (2, h, w) bool, cells
    all of which was seen when labels were made; ``overlap`` (2, h, w) bool, cells in the picture and in the other view;
    ``H`` (3, 3) float32 from pixels of the first to the second; ``points`` (2, N, 2) float32 px, which correspond;
    ``matched`` (N,) bool, which of these are there.
    """

    images: NDArray[np.uint8]
    classes: NDArray[np.int64]
    known: Mask
    overlap: Mask
    H: NDArray[np.float32]
    points: NDArray[np.float32]
    matched: Mask


def make_pair(
    picture: Image, labels: Array, rng: np.random.Generator, options: PairOptions, seen: Mask | None = None
) -> Pair:
    """Draw two views of a picture.

    The first is a crop at some scale, the second a homography of the first that looks at the whole picture, so that it
    shows what the crop left out.

    Args:
        picture: (H, W) uint8.
        labels: (P, 2) px.
        rng: generator, which alone decides.
        options: of the views.
        seen: (H, W), where in the picture labels were looked for; None: everywhere.
    """
    size = (int(options.size_px[0]), int(options.size_px[1]))
    picture_size = (picture.shape[1], picture.shape[0])
    first = _crop(picture_size, size, rng, options)
    if rng.random() < 0.5:
        mirror = np.array([[-1.0, 0.0, size[0] - 1.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        first = mirror @ first
    H = sample_homography(size, rng, options.homographies)
    views = (first, H @ first)
    images, classes, known, whole, masks = [], [], [], [], []
    for view in views:
        images.append(change_light(warp_picture(picture, view, size), rng, options.lighting))
        mask = valid_mask(view, picture_size, _BORDER_PX, size)
        shown = warp_points(labels, view)
        classes.append(cell_classes(shown[_inside(shown, mask)], size, rng))
        whole.append(whole_cells(mask))
        known.append(whole[-1] if seen is None else whole[-1] & whole_cells(_looked_at(seen, view, size)))
        masks.append(mask)
    overlap = [
        whole_cells(valid_mask(np.linalg.inv(H), size, 0)) & whole[0],
        whole_cells(valid_mask(H, size, 0)) & whole[1],
    ]
    points, matched = _matches(labels, views, masks, H, size, rng, options)
    return {
        "images": np.stack(images),
        "classes": np.stack(classes),
        "known": np.stack(known),
        "overlap": np.stack(overlap),
        "H": H.astype(np.float32),
        "points": points,
        "matched": matched,
    }


def _looked_at(seen: Mask, view: Array, size: tuple[int, int]) -> Mask:
    """Pixels of a view all of which lie where the picture was seen."""
    full = np.where(seen, 255, 0).astype(np.uint8)
    warped: Mask = cv2.warpPerspective(full, view, size, flags=cv2.INTER_LINEAR) == 255
    return warped


def _crop(
    picture_size: tuple[int, int], size: tuple[int, int], rng: np.random.Generator, options: PairOptions
) -> Array:
    """From pixels of the picture to those of a view (3, 3) that shows part of it, or all and more at a small scale."""
    scale = float(np.exp(rng.uniform(np.log(options.scale[0]), np.log(options.scale[1]))))
    # Of a view's pixels, the picture spans scale times its own; what is left over is where the view may lie.
    room = np.array(picture_size) * scale - np.array(size)
    corner = rng.uniform(np.minimum(room, 0.0), np.maximum(room, 0.0))
    shift = 0.5 * (scale - 1.0)
    return np.array([[scale, 0.0, shift - corner[0]], [0.0, scale, shift - corner[1]], [0.0, 0.0, 1.0]])


def _matches(
    labels: Array,
    views: tuple[Array, Array],
    masks: list[Mask],
    H: Array,
    size: tuple[int, int],
    rng: np.random.Generator,
    options: PairOptions,
) -> tuple[NDArray[np.float32], Mask]:
    """Points (2, N, 2) px that both views show, labels first, and which of them are there (N,)."""
    chosen = [warp_points(labels, view) for view in views]
    count = options.matches
    wanted = round(options.labelled * count)
    both = np.flatnonzero(_inside(chosen[0], masks[0]) & _inside(chosen[1], masks[1]))
    both = rng.permutation(both)[:wanted]
    anywhere = rng.uniform(0.0, np.array(size) - 1.0, size=(_TRIES * count, 2))
    there = warp_points(anywhere, H)
    shown = np.flatnonzero(_inside(anywhere, masks[0]) & _inside(there, masks[1]))[: count - len(both)]
    first = np.concatenate((chosen[0][both], anywhere[shown]))
    second = np.concatenate((chosen[1][both], there[shown]))
    points = np.zeros((2, count, 2), dtype=np.float32)
    points[0, : len(first)], points[1, : len(first)] = first, second
    return points, np.arange(count) < len(first)


def _inside(points: Array, mask: Mask) -> Mask:
    """Which points (P, 2) px lie on a true pixel of the mask (H, W); NaN lies nowhere."""
    with np.errstate(invalid="ignore"):
        near = np.rint(np.nan_to_num(points, nan=-1e6))
    height, width = mask.shape
    inside: Mask = (near >= 0).all(axis=1) & (near[:, 0] < width) & (near[:, 1] < height)
    places = near[inside].astype(np.int64)
    inside[inside] = mask[places[:, 1], places[:, 0]]
    return inside


def stack_pairs(pairs: list[Pair]) -> Mapping[str, np.ndarray]:
    """A batch: each field with a leading axis."""
    return {name: np.stack([pair[name] for pair in pairs]) for name in Pair.__annotations__}  # type: ignore[literal-required]
