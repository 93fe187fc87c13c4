"""The strongest points, none beside a stronger one."""

import numpy as np
import pytest

from vioframe.vision.suppression import strongest


def by_pairs(pixels, scores, radius, count):
    """The definition, without a grid."""
    kept = []
    for index in np.argsort(-scores, kind="stable"):
        cell = np.rint(pixels[index])
        if all(np.abs(np.rint(pixels[other]) - cell).max() > radius for other in kept):
            kept.append(int(index))
    return kept[:count]


@pytest.mark.parametrize("radius", [0, 1, 4])
@pytest.mark.parametrize("count", [7, 1000])
def test_agrees_with_the_definition(radius, count):
    rng = np.random.default_rng(radius)
    pixels, scores = rng.uniform(0, 60, (300, 2)), rng.integers(0, 40, 300).astype(float)
    assert strongest(pixels, scores, radius_px=radius, count=count).tolist() == by_pairs(pixels, scores, radius, count)


def test_no_points_are_no_points():
    assert len(strongest(np.zeros((0, 2)), np.zeros(0), radius_px=4, count=5)) == 0
