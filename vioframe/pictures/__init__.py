"""Pictures to learn and to measure features on: made by the seed, or from a folder; with homographies and light."""

from vioframe.pictures.homographies import (
    HomographyOptions,
    sample_homography,
    valid_mask,
    warp_picture,
    warp_points,
)
from vioframe.pictures.lighting import LightingOptions, change_light
from vioframe.pictures.pairs import PicturePair, generated_pairs, hpatches_pairs
from vioframe.pictures.places import RenderedPlaces
from vioframe.pictures.sources import Mixture, PictureFolder, PictureSource, Textures

__all__ = [
    "HomographyOptions",
    "LightingOptions",
    "Mixture",
    "PictureFolder",
    "PicturePair",
    "PictureSource",
    "RenderedPlaces",
    "Textures",
    "change_light",
    "generated_pairs",
    "hpatches_pairs",
    "sample_homography",
    "valid_mask",
    "warp_picture",
    "warp_points",
]
