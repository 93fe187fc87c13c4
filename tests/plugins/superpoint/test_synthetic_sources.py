"""Which pictures a training takes."""

import cv2
import numpy as np
import pytest

from vioframe.errors import DataError
from vioframe.pictures import Textures
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


def test_a_folder_comes_in_their_place(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), np.full((64, 96), 7, np.uint8))
    source = picture_source(PictureOptions(**OPTIONS | {"folder": str(tmp_path)}), seed=4)
    assert len(source) == 5
    np.testing.assert_array_equal(source.picture(4), 7)
    with pytest.raises(DataError, match="no folder"):
        picture_source(PictureOptions(**OPTIONS | {"folder": str(tmp_path / "none")}), seed=4)
