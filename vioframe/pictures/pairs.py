"""Two pictures of one plane, or of one scene from one place, and the homography between them.

The generated pairs are the held-out set on which features are compared: their pictures, places and light come from
random numbers that no training draws, whatever its seed.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from vioframe.checks import Array, check_array, check_positive
from vioframe.errors import ConfigError, DataError
from vioframe.pictures.homographies import HomographyOptions, sample_homography
from vioframe.pictures.lighting import LightingOptions, change_light
from vioframe.pictures.places import RenderedPlaces
from vioframe.pictures.sources import Mixture, Textures, check_size, read_gray
from vioframe.types import Image

Split = Literal["illumination", "viewpoint"]
SPLITS: tuple[Split, ...] = ("illumination", "viewpoint")

_SPLIT_OF_PREFIX: dict[str, Split] = {"i_": "illumination", "v_": "viewpoint"}
_PAIRS = 78
_PLACES_SHARE = 0.5
_PICTURES_IN_A_PLACE = 6
# As in HPatches: slant, scale and shift, some rotation.
_VIEWPOINT = HomographyOptions(patch_ratio=0.9, perspective=0.25, scale=0.35, max_angle=0.6, overflow=0.1)
# Content beyond the first picture, so that the second is full too.
_MARGIN = 0.3
_LITTLE = LightingOptions(
    shading=0.3,
    shading_stops=0.5,
    shadow=0.0,
    spotlight=0.0,
    vignetting=0.2,
    exposure=0.5,
    exposure_stops=0.4,
    tone=0.3,
    contrast=0.2,
    gamma=0.2,
    low_light=0.0,
    noise=0.5,
    noise_dn=2.5,
    speckle=0.0,
    blur=0.2,
    blur_sigma_px=0.8,
    motion_blur=0.0,
    compression=0.1,
)
_MUCH = LightingOptions(exposure=0.9, shading=0.8, shadow=0.4, spotlight=0.25, blur=0.1, motion_blur=0.0, speckle=0.1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PicturePair:
    """Two pictures and how the pixels of one lie in the other.

    Attributes:
        first, second: (H, W) uint8; sizes may differ.
        H_second_first: (3, 3), pixels of the first to pixels of the second; centre of the top-left pixel (0, 0).
        name: to tell it by.
        split: what differs: the light, or the viewpoint.
    """

    first: Image
    second: Image
    H_second_first: Array
    name: str
    split: Split

    def __post_init__(self) -> None:
        check_array("PicturePair.first", self.first, (None, None), np.uint8)
        check_array("PicturePair.second", self.second, (None, None), np.uint8)
        check_array("PicturePair.H_second_first", self.H_second_first, (3, 3))


def generated_pairs(split: Split, count: int, size_px: Sequence[int], seed: int = 0) -> Iterator[PicturePair]:
    """The held-out set: half of it in simulated places, half painted.

    ``illumination``: one picture in usual light, and in another, strongly; the homography is the identity, as in
    HPatches. ``viewpoint``: a homography of the ranges of HPatches, and nearly the same light.

    Args:
        split: which.
        count: of pairs.
        size_px: (width, height) of both pictures.
        seed: another seed is another held-out set.

    Raises:
        ConfigError: no such split, a size or a count that cannot be.
    """
    if split not in SPLITS:
        raise ConfigError(f"split={split!r} is none of generated pairs; choose from {', '.join(SPLITS)}")
    check_positive("pairs", count=count)
    size = check_size("pairs", size_px)
    return _generate(split, count, size, seed)


def _generate(split: Split, count: int, size_px: tuple[int, int], seed: int) -> Iterator[PicturePair]:
    margin = 0 if split == "illumination" else round(_MARGIN * min(size_px))
    large = size_px[0] + 2 * margin, size_px[1] + 2 * margin
    places = RenderedPlaces(size_px=large, count=count, seed=seed, each=_PICTURES_IN_A_PLACE, purpose="held_out")
    textures = Textures(size_px=large, count=count, seed=seed, purpose="held_out")
    source = Mixture([places, textures], [_PLACES_SHARE, 1.0 - _PLACES_SHARE], count=count, seed=seed)
    for index in range(count):
        rng = np.random.default_rng([seed, _PAIRS, SPLITS.index(split), index])
        picture = source.picture(index)
        if split == "illumination":
            H: Array = np.eye(3)
            first, second = change_light(picture, rng, _LITTLE), change_light(picture, rng, _MUCH)
        else:
            H = sample_homography(size_px, rng, _VIEWPOINT)
            to_first = np.array([[1.0, 0.0, -margin], [0.0, 1.0, -margin], [0.0, 0.0, 1.0]])
            middle = picture[margin : margin + size_px[1], margin : margin + size_px[0]]
            seen = cv2.warpPerspective(
                picture, H @ to_first, size_px, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101
            )
            first, second = change_light(middle, rng, _LITTLE), change_light(seen, rng, _LITTLE)
        yield PicturePair(first=first, second=second, H_second_first=H, name=f"{split}_{index:03d}", split=split)


def hpatches_pairs(folder: str | Path) -> Iterator[PicturePair]:
    """Pairs in the layout of HPatches: folders with pictures 1 … 6 and homographies ``H_1_2`` … ``H_1_6``.

    Names that begin with ``i_`` are the illumination split, those with ``v_`` the viewpoint split; any other counts as
    viewpoint. Each pair is named after its folder and its second picture.

    Args:
        folder: one such folder, or one of them.

    Raises:
        DataError: no such folder, none in it, a picture or homography that cannot be read.
    """
    root = Path(folder)
    if not root.is_dir():
        raise DataError(f"hpatches={str(folder)!r} is no folder: give one sequence, or the folder of all")
    sequences = [path for path in sorted({root, *root.iterdir()}) if path.is_dir() and any(path.glob("H_1_*"))]
    if not sequences:
        raise DataError(f"hpatches={str(folder)!r} holds no sequence: none has files 1.ppm, 2.ppm, … and H_1_2, …")
    return (pair for sequence in sequences for pair in _sequence_pairs(sequence))


def _sequence_pairs(sequence: Path) -> Iterator[PicturePair]:
    # A folder's own name may begin with anything before "v_" or "i_", as in "hpatches_v_churchill".
    split: Split = "viewpoint"
    for prefix, named in _SPLIT_OF_PREFIX.items():
        if sequence.name.startswith(prefix) or f"_{prefix}" in sequence.name:
            split = named
            break
    first = _numbered_picture(sequence, "1")
    for path in sorted(sequence.glob("H_1_*"), key=lambda found: (len(found.stem), found.stem)):
        number = path.stem.removeprefix("H_1_")
        yield PicturePair(
            first=first,
            second=_numbered_picture(sequence, number),
            H_second_first=_read_homography(path),
            name=f"{sequence.name}_{number}",
            split=split,
        )


def _numbered_picture(sequence: Path, number: str) -> Image:
    for path in sorted(sequence.glob(f"{number}.*")):
        image = read_gray(path)
        if image is None:
            raise DataError(f"{path} cannot be read as a picture: restore it, or leave its sequence out")
        return image
    raise DataError(f"{sequence} has no picture {number}: {number}.ppm, .png or .jpg belongs beside its homography")


def _read_homography(path: Path) -> Array:
    try:
        H: Array = np.loadtxt(path, dtype=np.float64)
    except (OSError, ValueError) as error:
        raise DataError(f"{path} must hold three rows of three numbers: {error}") from error
    if H.shape != (3, 3) or not np.isfinite(H).all() or abs(np.linalg.det(H)) < 1e-12:
        raise DataError(f"{path} must hold a homography, three rows of three numbers, got shape {H.shape}")
    # The sign is free; points of the picture lie before the camera.
    return H / H[2, 2] if H[2, 2] else H
