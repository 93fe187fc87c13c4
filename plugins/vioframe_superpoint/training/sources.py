"""Which pictures are labelled and learned from."""

from vioframe.errors import DataError
from vioframe.pictures import Mixture, PictureFolder, PictureSource, RenderedPlaces, Textures
from vioframe_superpoint.training.options import PictureOptions


def picture_source(options: PictureOptions, seed: int) -> PictureSource:
    """The pictures to learn from, and after them those of validation.

    Raises:
        DataError: a folder without enough pictures.
    """
    count = options.count + options.held_out
    if options.folder is not None:
        folder = PictureFolder(options.folder, size_px=options.size_px)
        if len(folder) < count:
            raise DataError(
                f"frontend.training.pictures.folder={options.folder} holds {len(folder)} pictures, but "
                f"{options.count} are to be learned from and {options.held_out} held out: ask for fewer "
                "(frontend.training.pictures.count)"
            )
        return Mixture([folder], [1.0], count=count, seed=seed)
    places = RenderedPlaces(size_px=options.size_px, count=count, seed=seed)
    textures = Textures(size_px=options.size_px, count=count, seed=seed)
    return Mixture([places, textures], [options.places, 1.0 - options.places], count=count, seed=seed)
