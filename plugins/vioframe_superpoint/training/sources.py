"""Which pictures are labelled and learned from."""

from typing import TYPE_CHECKING

from vioframe_superpoint.training.options import PictureOptions

if TYPE_CHECKING:
    from vioframe.pictures.sources import PictureSource


def picture_source(options: PictureOptions, seed: int) -> "PictureSource":
    """The pictures, those of validation last."""
    from vioframe.pictures.sources import Textures

    return Textures(size_px=tuple(options.size_px), seed=seed, count=options.count + options.held_out)
