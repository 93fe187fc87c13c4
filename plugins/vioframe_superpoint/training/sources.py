"""Which pictures are labelled and learned from."""

from vioframe.errors import DataError
from vioframe.pictures import Mixture, PictureFolder, PictureSource, RenderedPlaces, Textures
from vioframe.pictures.sources import Purpose
from vioframe.types import Image
from vioframe_superpoint.training.options import PictureOptions

# Pictures of a place in validation: a dozen should show several.
_VALIDATED_IN_A_PLACE = 2
_LEARNED_IN_A_PLACE = 80


class InTurn:
    """The pictures of one source, and after them those of another.

    Args:
        first: of them.
        then: the other.
    """

    def __init__(self, first: PictureSource, then: PictureSource) -> None:
        self._first = first
        self._then = then

    def __len__(self) -> int:
        """How many there are."""
        return len(self._first) + len(self._then)

    def picture(self, index: int) -> Image:
        """Picture ``index`` (H, W) uint8."""
        beyond = index - len(self._first)
        return self._first.picture(index) if beyond < 0 else self._then.picture(beyond)


def picture_source(options: PictureOptions, seed: int) -> PictureSource:
    """The pictures to learn from, and after them those of validation, which show no place and no surface of the former.

    Raises:
        DataError: a folder without enough pictures.
    """
    if options.folder is not None:
        count = options.count + options.held_out
        folder = PictureFolder(options.folder, size_px=options.size_px)
        if len(folder) < count:
            raise DataError(
                f"frontend.training.pictures.folder={options.folder} holds {len(folder)} pictures, but "
                f"{options.count} are to be learned from and {options.held_out} held out: ask for fewer "
                "(frontend.training.pictures.count)"
            )
        return Mixture([folder], [1.0], count=count, seed=seed)
    learned = _generated(options, options.count, seed, "training", _LEARNED_IN_A_PLACE)
    return InTurn(learned, _generated(options, options.held_out, seed, "validation", _VALIDATED_IN_A_PLACE))


def _generated(options: PictureOptions, count: int, seed: int, purpose: Purpose, each: int) -> PictureSource:
    places = RenderedPlaces(size_px=options.size_px, count=count, seed=seed, each=each, purpose=purpose)
    textures = Textures(size_px=options.size_px, count=count, seed=seed, purpose=purpose)
    return Mixture([places, textures], [options.places, 1.0 - options.places], count=count, seed=seed)
