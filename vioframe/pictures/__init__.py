"""Pictures to learn and to measure features on: made by the seed, or from a folder; with homographies and light."""

from vioframe.pictures.homographies import (
    HomographyOptions,
    sample_homography,
    valid_mask,
    warp_picture,
    warp_points,
)
from vioframe.pictures.lighting import LightingOptions, change_light

__all__ = [
    "HomographyOptions",
    "LightingOptions",
    "change_light",
    "sample_homography",
    "valid_mask",
    "warp_picture",
    "warp_points",
]
