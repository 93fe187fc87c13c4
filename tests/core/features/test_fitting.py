"""Pictures brought to the protocol's size keep what they show where the homography says."""

import cv2
import numpy as np
import pytest

from vioframe.features.fitting import fit_pair, fit_picture, shared_areas
from vioframe.pictures.homographies import warp_points
from vioframe.pictures.pairs import PicturePair

TRUE = np.array([[0.92, -0.21, 61.0], [0.18, 1.03, -32.0], [1e-4, -6e-5, 1.0]])


def ramps(width, height):
    """A picture of which the grey levels tell x, and one of which they tell y, in single precision."""
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    return x, y


@pytest.mark.parametrize("size", [(320, 240), (200, 200), (640, 480), (900, 800)])
@pytest.mark.parametrize("given", [(640, 480), (1024, 768), (431, 977)])
def test_pixels_show_what_the_homography_says(given, size):
    for axis, ramp in enumerate(ramps(*given)):
        fitted, to_fitted = fit_picture(ramp, size)
        assert fitted.shape == size[::-1]
        inner = np.stack(np.meshgrid(np.arange(5, size[0] - 5, 37), np.arange(5, size[1] - 5, 37)), axis=-1)
        back = warp_points(inner.reshape(-1, 2).astype(float), np.linalg.inv(to_fitted))
        seen = fitted[inner[..., 1], inner[..., 0]].reshape(-1)
        # Areas cut into fixed-point weights leave a few hundredths.
        assert np.abs(seen - back[:, axis]).max() < 0.1


def test_a_picture_of_the_size_asked_for_stays_as_it_is():
    picture = np.random.default_rng(0).integers(0, 255, (240, 320), dtype=np.uint8)
    fitted, to_fitted = fit_picture(picture, (320, 240))
    assert np.array_equal(fitted, picture) and np.array_equal(to_fitted, np.eye(3))


def test_the_pair_keeps_its_geometry():
    pair = PicturePair(
        first=np.zeros((480, 700), np.uint8),
        second=np.zeros((600, 640), np.uint8),
        H_second_first=TRUE,
        name="pair",
        split="viewpoint",
    )
    fitted = fit_pair(pair, (320, 240))
    _, to_first = fit_picture(pair.first, (320, 240))
    _, to_second = fit_picture(pair.second, (320, 240))
    points = np.random.default_rng(1).uniform(50, 400, (30, 2))
    expected = warp_points(warp_points(points, TRUE), to_second)
    assert np.allclose(warp_points(warp_points(points, to_first), fitted.H_second_first), expected)
    assert (fitted.name, fitted.split) == (pair.name, pair.split)


def test_shared_areas_are_where_both_see_the_same():
    shift = np.array([[1.0, 0.0, 30.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    first, second = shared_areas(shift, (100, 80), 4)
    rows, columns = np.nonzero(first)
    assert (columns.min(), columns.max(), rows.min(), rows.max()) == (4, 99 - 30 - 4, 4, 79 - 4)
    rows, columns = np.nonzero(second)
    assert (columns.min(), columns.max()) == (30 + 4, 99 - 4)
    whole = cv2.countNonZero(shared_areas(np.eye(3), (100, 80), 0)[0].astype(np.uint8))
    assert whole == 100 * 80
