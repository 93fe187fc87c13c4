"""Which pictures are labelled and learned from."""

from typing import TYPE_CHECKING

from vioframe_superpoint.training.options import PictureOptions

if TYPE_CHECKING:
    from vioframe.pictures.sources import PictureSource


def picture_source(options: PictureOptions, seed: int) -> "PictureSource":
    """The pictures, those of validation last; a folder with fewer begins again."""
    from vioframe.pictures.places import RenderedPlaces
    from vioframe.pictures.sources import Mixture, PictureFolder, PictureSource, Textures

    size_px = int(options.size_px[0]), int(options.size_px[1])
    count = options.count + options.held_out
    if options.folder is not None:
        return Mixture([PictureFolder(options.folder, size_px=size_px)], [1.0], count=count)
    generated: list[PictureSource] = [
        RenderedPlaces(size_px=size_px, count=count, seed=seed),
        Textures(size_px=size_px, count=count, seed=seed),
    ]
    return Mixture(generated, [options.places, 1.0 - options.places], count=count, seed=seed)
