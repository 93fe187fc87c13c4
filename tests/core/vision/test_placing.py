"""Points placed by their patches: to a tenth of a pixel whatever the light, and slips found out."""

import cv2
import numpy as np
import pytest

from vioframe.vision.placing import AnchoredPlaces, AnchorOptions

OPTIONS = AnchorOptions(window_px=19, steps=4, reach_px=2.0, min_correlation=0.8, memory_images=2, follow=True)


@pytest.fixture(scope="module")
def texture():
    rng = np.random.default_rng(0)
    rough = rng.uniform(40, 200, (60, 80)).astype(np.float32)
    return cv2.resize(rough, (640, 480), interpolation=cv2.INTER_CUBIC)


def shifted(texture, x, y, gain=1.0, offset=0.0):
    moved = cv2.warpAffine(texture, np.array([[1, 0, x], [0, 1, y]], float), (640, 480), borderMode=cv2.BORDER_REFLECT)
    return np.clip(gain * moved + offset, 0, 255).astype(np.uint8)


def points(count=60, seed=1):
    return np.random.default_rng(seed).uniform((40, 40), (600, 440), (count, 2))


@pytest.mark.parametrize(("gain", "offset"), [(1.0, 0.0), (0.5, 10.0), (1.1, -30.0)])
def test_points_are_placed_whatever_the_detector_and_the_light_say(texture, gain, offset):
    places, pixels, ids = AnchoredPlaces(OPTIONS), points(), np.arange(60)
    jitter = np.random.default_rng(2)
    placed, slipped = places.place(shifted(texture, 0, 0), ids, pixels)
    assert np.array_equal(placed, pixels) and not slipped.any()
    for step in range(1, 6):
        motion = step * np.array([0.8, -0.37])
        found = pixels + motion + jitter.uniform(-0.7, 0.7, pixels.shape)
        placed, slipped = places.place(shifted(texture, *motion, gain, offset), ids, found)
        assert not slipped.any()
        assert np.linalg.norm(placed - pixels - motion, axis=1).max() < 0.1


def test_a_slip_to_a_neighbour_is_another_point(texture):
    places, pixels, ids = AnchoredPlaces(OPTIONS), points(), np.arange(60)
    places.place(shifted(texture, 0, 0), ids, pixels)
    found = pixels.copy()
    found[:10] += (6.0, -5.0)
    _, slipped = places.place(shifted(texture, 0, 0), ids, found)
    assert slipped[:10].sum() >= 9 and not slipped[10:].any()


def test_light_that_fits_no_patch_slips_no_point(texture):
    """Another picture at the same matches: descriptors may know better than patches, and they are cut anew."""
    places, pixels, ids = AnchoredPlaces(OPTIONS), points(), np.arange(60)
    places.place(shifted(texture, 0, 0), ids, pixels)
    other = np.ascontiguousarray(shifted(texture, 0, 0)[::-1, ::-1])
    placed, slipped = places.place(other, ids, pixels)
    assert not slipped.any() and np.array_equal(placed, pixels)
    placed, slipped = places.place(other, ids, pixels + 0.5)
    assert not slipped.any() and np.linalg.norm(placed - pixels, axis=1).max() < 0.1


def test_a_point_comes_back_and_one_long_gone_does_not(texture):
    places, pixels = AnchoredPlaces(OPTIONS), points()
    image = shifted(texture, 0, 0)
    places.place(image, np.arange(60), pixels)
    for _ in range(OPTIONS.memory_images - 1):
        places.place(image, np.arange(30), pixels[:30])
    placed, _ = places.place(image, np.arange(60), pixels + 0.4)
    assert np.linalg.norm(placed - pixels, axis=1).max() < 0.1
    for _ in range(OPTIONS.memory_images + 1):
        places.place(image, np.arange(30), pixels[:30])
    placed, _ = places.place(image, np.arange(60), pixels + 0.4)
    assert np.array_equal(placed[30:], pixels[30:] + 0.4), "they begin anew where they are found"


def test_patches_find_points_from_where_they_should_be_about(texture):
    places, pixels, ids = AnchoredPlaces(OPTIONS), points(), np.arange(60)
    places.place(shifted(texture, 0, 0), ids, pixels)
    off = np.random.default_rng(3).uniform(-1.5, 1.5, pixels.shape)
    unknown = np.array([100, 101])
    near = pixels + np.array([2.0, -1.0]) + off
    expected = np.concatenate([near, [(50.0, 50.0), (300.0, 200.0)]])
    found, good = places.follow(shifted(texture, 2, -1, 0.6), np.concatenate([ids, unknown]), expected)
    assert good[:60].mean() > 0.95 and not good[60:].any()
    assert np.linalg.norm(found - expected, axis=1)[60:].max() == 0.0
    assert np.linalg.norm(found[:60] - pixels - (2.0, -1.0), axis=1)[good[:60]].max() < 0.1
    _, elsewhere = places.follow(shifted(texture, 200, 100), ids, pixels)
    assert elsewhere.mean() < 0.1
    for level in (0, 128, 255):
        _, nowhere = places.follow(np.full((480, 640), level, np.uint8), ids, pixels)
        assert not nowhere.any()


def test_the_other_camera_is_placed_by_the_same_patches(texture):
    places, pixels, ids = AnchoredPlaces(OPTIONS), points(), np.arange(60)
    places.place(shifted(texture, 0, 0), ids, pixels)
    found = pixels[::2] + np.array([-7.3, 0.5])
    found[:5] += 8.0
    placed, slipped = places.place_elsewhere(shifted(texture, -7.3, 0, 0.7), ids[::2], found)
    assert slipped[:5].sum() >= 4 and not slipped[5:].any()
    assert np.linalg.norm(placed[5:] - pixels[::2][5:] - np.array([-7.3, 0.0]), axis=1).max() < 0.1
    again, _ = places.place(shifted(texture, 0, 0), ids, pixels + 0.3)
    assert np.linalg.norm(again - pixels, axis=1).max() < 0.1


def test_no_points_are_no_trouble(texture):
    places, none = AnchoredPlaces(OPTIONS), np.zeros((0, 2))
    image = shifted(texture, 0, 0)
    for ids, pixels in ((np.zeros(0, int), none), (np.arange(5), points(5)), (np.zeros(0, int), none)):
        placed, slipped = places.place(image, ids, pixels)
        assert len(placed) == len(slipped) == len(ids)
