"""Pictures to learn and to measure features on: made by the seed, or from a folder; with homographies and light."""

from vioframe.pictures.homographies import (
    HomographyOptions,
    sample_homography,
    valid_mask,
    warp_picture,
    warp_points,
)

__all__ = [
    "HomographyOptions",
    "sample_homography",
    "valid_mask",
    "warp_picture",
    "warp_points",
]
