"""Changes of light: none by itself, each what it says, pixels in their places."""

from dataclasses import fields, replace

import cv2
import numpy as np
import pytest

from vioframe.errors import ConfigError
from vioframe.pictures import LightingOptions, change_light
from vioframe.pictures.lighting import _PROBABILITIES

DARK = LightingOptions(**dict.fromkeys(_PROBABILITIES, 0.0))


def scene() -> np.ndarray:
    rng = np.random.default_rng(0)
    picture = np.full((96, 128), 120, np.uint8)
    for _ in range(30):
        x, y, w, h = rng.integers(0, 110), rng.integers(0, 80), rng.integers(8, 40), rng.integers(8, 30)
        cv2.rectangle(picture, (int(x), int(y)), (int(x + w), int(y + h)), int(rng.integers(40, 200)), -1)
    return picture


def only(name: str, **strengths: float) -> LightingOptions:
    return replace(DARK, **{name: 1.0}, **strengths)


@pytest.mark.parametrize("wrong", [{"shading": 1.1}, {"noise": -0.1}, {"noise_dn": -1.0}], ids=str)
def test_numbers_that_cannot_be_are_refused(wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        LightingOptions(**wrong)


def test_without_a_change_nothing_changes():
    np.testing.assert_array_equal(change_light(scene(), np.random.default_rng(0), DARK), scene())


@pytest.mark.parametrize("name", _PROBABILITIES)
def test_each_change_alone_changes_the_picture_and_leaves_the_one_given(name):
    picture = scene()
    changed = change_light(picture, np.random.default_rng(1), only(name))
    np.testing.assert_array_equal(picture, scene())
    assert changed.shape == picture.shape
    assert changed.dtype == np.uint8
    assert np.any(changed != picture)


def test_the_generator_alone_decides():
    first, again, other = (change_light(scene(), np.random.default_rng(seed)) for seed in (5, 5, 6))
    np.testing.assert_array_equal(first, again)
    assert np.any(first != other)


@pytest.mark.parametrize("grey", [0, 255])
@pytest.mark.parametrize("shape", [(1, 1), (7, 9), (240, 320)])
def test_black_white_and_tiny_pictures_are_no_error(grey, shape):
    rng = np.random.default_rng(2)
    for _ in range(20):
        assert change_light(np.full(shape, grey, np.uint8), rng).shape == shape


def test_exposure_scales_and_clips():
    ramp = np.tile(np.arange(0, 256, 2, dtype=np.uint8), (32, 1))
    factors = []
    for seed in range(20):
        changed = change_light(ramp, np.random.default_rng(seed), only("exposure", exposure_stops=1.0)).astype(float)
        unclipped = (changed[0] < 254) & (ramp[0] > 40)
        factor = np.median(changed[0][unclipped] / ramp[0][unclipped])
        np.testing.assert_allclose(changed[0], np.minimum(factor * ramp[0], 255.0), atol=1.5)
        factors.append(factor)
    assert 0.49 < min(factors) < 0.7
    assert 1.4 < max(factors) < 2.01


def test_smooth_light_is_bounded_by_its_stops():
    flat = np.full((120, 160), 60, np.uint8)
    for seed in range(20):
        changed = change_light(flat, np.random.default_rng(seed), only("shading", shading_stops=1.0))
        assert 29 <= changed.min() <= changed.max() <= 121
        assert np.abs(np.diff(changed.astype(int), axis=0)).max() <= 4


def test_noise_is_white_and_no_stronger_than_its_limit():
    flat = np.full((200, 200), 128, np.uint8)
    deviations = []
    for seed in range(10):
        changed = change_light(flat, np.random.default_rng(seed), only("noise", noise_dn=8.0)).astype(float)
        deviations.append(changed.std())
        off = changed - changed.mean()
        assert abs((off[:, 1:] * off[:, :-1]).mean()) < 0.05 * max(off.var(), 1.0)
    assert 4.0 < max(deviations) < 8.2


def test_low_light_keeps_the_scene_above_black():
    for seed in range(20):
        changed = change_light(scene(), np.random.default_rng(seed), only("low_light"))
        assert 6.0 < changed.mean() < scene().mean() + 2.0


@pytest.mark.parametrize("name", ["blur", "motion_blur", "exposure", "tone"])
def test_the_centre_of_a_blob_stays_where_it_is(name):
    y, x = np.mgrid[:61, :81].astype(float)
    blob = np.round(200.0 * np.exp(-((x - 40.3) ** 2 + (y - 29.6) ** 2) / 30.0)).astype(np.uint8)
    for seed in range(10):
        light = change_light(blob, np.random.default_rng(seed), only(name, gamma=0.1, exposure_stops=0.3)).astype(float)
        light -= light[0, 0]
        found = (light * x).sum() / light.sum(), (light * y).sum() / light.sum()
        np.testing.assert_allclose(found, (40.3, 29.6), atol=0.1)


def test_a_perfect_lens_is_an_option_among_all():
    options = LightingOptions().without_blur()
    assert options.blur == options.motion_blur == 0.0
    unchanged = {f.name for f in fields(options)} - {"blur", "motion_blur"}
    assert all(getattr(options, name) == getattr(LightingOptions(), name) for name in unchanged)
