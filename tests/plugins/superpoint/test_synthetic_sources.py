"""Which pictures a training takes."""

import cv2
import numpy as np
import pytest

from vioframe.errors import DataError
from vioframe.pictures import RenderedPlaces, Textures
from vioframe_superpoint.training.options import PictureOptions
from vioframe_superpoint.training.sources import picture_source

OPTIONS = {"count": 3, "size_px": [96, 64], "folder": None, "places": 0.0, "held_out": 2}


def test_generated_pictures_are_mixed_of_places_and_textures():
    source = picture_source(PictureOptions(**OPTIONS), seed=4)
    assert len(source) == 5
    np.testing.assert_array_equal(source.picture(2), Textures(size_px=(96, 64), count=5, seed=4).picture(2))
    placed = picture_source(PictureOptions(**OPTIONS | {"places": 1.0}), seed=4)
    assert placed.picture(0).shape == (64, 96)
    assert not np.array_equal(placed.picture(0), source.picture(0))


def test_validation_shows_nothing_that_is_learned_from():
    source = picture_source(PictureOptions(**OPTIONS), seed=4)
    others = Textures(size_px=(96, 64), count=2, seed=4, purpose="validation")
    for number in range(2):
        np.testing.assert_array_equal(source.picture(3 + number), others.picture(number))
    learned = Textures(size_px=(96, 64), count=9, seed=4)
    assert not any(np.array_equal(source.picture(4), learned.picture(number)) for number in range(9))
    placed = picture_source(PictureOptions(**OPTIONS | {"places": 1.0, "count": 1, "held_out": 1}), seed=4)
    room = RenderedPlaces(size_px=(96, 64), count=1, seed=4, purpose="validation")
    np.testing.assert_array_equal(placed.picture(1), room.picture(0))


def test_a_folder_comes_in_their_place(tmp_path):
    for number in range(5):
        cv2.imwrite(str(tmp_path / f"{number}.png"), np.full((64, 96), 7, np.uint8))
    source = picture_source(PictureOptions(**OPTIONS | {"folder": str(tmp_path)}), seed=4)
    assert len(source) == 5
    np.testing.assert_array_equal(source.picture(4), 7)
    with pytest.raises(DataError, match=r"holds 5 pictures, but 4 are"):
        picture_source(PictureOptions(**OPTIONS | {"folder": str(tmp_path), "count": 4}), seed=4)
    with pytest.raises(DataError, match="no folder"):
        picture_source(PictureOptions(**OPTIONS | {"folder": str(tmp_path / "none")}), seed=4)
