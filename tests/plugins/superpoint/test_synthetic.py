"""Drawn shapes: exact areas and corners, nothing marked where nothing is seen, the same from the same seed."""

import cv2
import numpy as np
import pytest

from vioframe.errors import ConfigError
from vioframe_superpoint.synthetic import KINDS, SyntheticShapes
from vioframe_superpoint.synthetic.canvas import Canvas, _merge, _shrink, crossing_points, pick_grey

SIZE = (160, 120)


def test_pictures_too_small_and_unknown_kinds_are_refused():
    with pytest.raises(ConfigError, match="32 px"):
        SyntheticShapes(size_px=(31, 120))
    with pytest.raises(ConfigError, match="cubist.*choose from.*boxes"):
        SyntheticShapes(kinds=("cubist",))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("size_px", [SIZE, (64, 48), (101, 203)], ids=str)
def test_every_kind_in_any_size_gives_a_picture_with_corners_inside(kind, size_px):
    shapes = SyntheticShapes(size_px=size_px, seed=3, kinds=(kind,))
    found = 0
    for index in range(6):
        gray, corners = shapes.picture(index)
        assert gray.shape == size_px[::-1]
        assert gray.dtype == np.uint8
        assert corners.shape == (len(corners), 2)
        assert np.all((corners >= 0) & (corners <= np.array(size_px) - 1))
        found += len(corners)
    assert (found > 0) == (kind not in ("ellipses", "nothing"))


def test_a_picture_is_a_function_of_seed_and_index():
    shapes = SyntheticShapes(seed=4)
    late, early = shapes.picture(7), shapes.picture(2)
    again = SyntheticShapes(seed=4)
    for (gray, corners), index in ((early, 2), (late, 7)):
        same_gray, same_corners = again.picture(index)
        np.testing.assert_array_equal(gray, same_gray)
        np.testing.assert_array_equal(corners, same_corners)
    assert np.any(SyntheticShapes(seed=5).picture(2)[0] != early[0])


def _sheet_of(polygon: np.ndarray) -> np.ndarray:
    """Share (H, W) of each pixel that a polygon covers."""
    canvas = Canvas(SIZE, np.random.default_rng(0))
    canvas._sheet[:] = 0
    canvas.polygon(polygon, 255, textured=False)
    return cv2.resize(canvas._sheet, SIZE, interpolation=cv2.INTER_AREA) / 255.0


def test_a_polygon_is_drawn_as_large_as_it_is_and_where_it_is():
    rng = np.random.default_rng(1)
    y, x = np.mgrid[:120, :160]
    for _ in range(20):
        turn = rng.uniform(0, 2 * np.pi) + np.arange(4) * np.pi / 2
        centre, reach = rng.uniform(50, 70, 2), rng.uniform(15, 40)
        polygon = centre + reach * np.stack([np.cos(turn), np.sin(turn)], -1)
        share = _sheet_of(polygon[:: rng.choice([-1, 1])])
        assert share.sum() == pytest.approx(2 * reach**2, abs=0.06 * 4 * np.sqrt(2) * reach)
        np.testing.assert_allclose([(share * x).sum() / share.sum(), (share * y).sum() / share.sum()], centre, atol=0.1)


def test_marked_corners_are_where_a_sub_pixel_search_finds_them():
    off = []
    for index in range(30):
        gray, corners = SyntheticShapes(seed=8, kinds=("checkerboard",)).picture(index)
        inner = corners[np.all((corners > 8) & (corners < np.array(SIZE) - 9), axis=1)]
        if len(inner):
            start = inner.astype(np.float32).reshape(-1, 1, 2)
            stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 0.01)
            refined = cv2.cornerSubPix(gray, start.copy(), (3, 3), (-1, -1), stop)[:, 0]
            off.append(refined - inner)
    off = np.concatenate(off)
    assert len(off) > 100
    # The middle of all is free of what single noisy or blurred corners do.
    np.testing.assert_allclose(np.median(off, axis=0), 0.0, atol=0.06)
    assert np.median(np.linalg.norm(off, axis=1)) < 0.3


def test_two_corners_are_never_the_same_one():
    for index in range(40):
        corners = SyntheticShapes(seed=2).picture(index)[1]
        if len(corners) > 1:
            gaps = np.linalg.norm(corners[:, None] - corners[None], axis=-1) + 1e9 * np.eye(len(corners))
            assert gaps.min() >= 2.0


def test_corners_behind_a_shape_are_gone_and_its_crossings_are_new():
    canvas = Canvas(SIZE, np.random.default_rng(0))
    canvas._sheet[:] = 100
    behind = np.array([[20.0, 20], [80, 20], [80, 80], [20, 80]])
    before = np.array([[50.0, 50], [120, 50], [120, 110], [50, 110]])
    for polygon, grey in ((behind, 30), (before, 220)):
        canvas.cover(polygon)
        canvas.polygon(polygon, grey, textured=False)
        canvas.mark(polygon)
    corners = np.concatenate(canvas._corners)
    wanted = {(20, 20), (80, 20), (20, 80), (50, 50), (120, 50), (120, 110), (50, 110), (80, 50), (50, 80)}
    assert {tuple(c) for c in corners} == wanted


def test_outlines_cross_where_lines_do():
    square = np.array([[0.0, 0], [10, 0], [10, 10], [0, 10]])
    line = np.array([[-5.0, 5.0], [15.0, 7.0]])
    np.testing.assert_allclose(_merge(crossing_points(line, square)), [[10, 6.5], [0, 5.5]], atol=1e-9)


def test_shrinking_moves_every_side():
    square = np.array([[0.0, 0], [10, 0], [10, 10], [0, 10]])
    np.testing.assert_allclose(_shrink(square, 1.0), [[1, 1], [9, 1], [9, 9], [1, 9]])
    np.testing.assert_allclose(_shrink(square[::-1], 1.0), [[1, 9], [9, 9], [9, 1], [1, 1]])


def test_a_grey_value_keeps_its_distance_where_it_can():
    rng = np.random.default_rng(0)
    for _ in range(50):
        others = rng.uniform(0, 255, 3)
        grey = pick_grey(rng, others, 40.0)
        reachable = np.abs(np.arange(8, 248)[:, None] - others).min(axis=1).max()
        assert np.abs(grey - others).min() >= min(40.0, reachable)
