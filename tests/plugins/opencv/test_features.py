"""Every method of OpenCV's on pictures whose points are known, and where there are none."""

import cv2
import numpy as np
import pytest

from vioframe.errors import ConfigError
from vioframe.vision.keypoints import Extractor
from vioframe_opencv import FastExtractor, OrbExtractor, ShiTomasiExtractor, SiftExtractor
from vioframe_opencv.choice import Choice

SIZE = (320, 240)
EVERYWHERE = np.full(SIZE[::-1], 255, np.uint8)


def make(name, **options):
    common = {"count": 120, "suppression_px": 4}
    made = {
        "shi_tomasi": (ShiTomasiExtractor, {"subpixel": True}),
        "fast": (FastExtractor, {"threshold": 5}),
        "orb": (OrbExtractor, {"candidates": 8.0, "threshold": 5, "edge_px": 16, "levels": 8, "scale": 1.2}),
        "sift": (
            SiftExtractor,
            {"spread": False, "contrast": 0.01, "edge": 10.0, "layers": 3, "sigma": 1.6, "upright": False},
        ),
    }
    cls, own = made[name]
    return cls(**(common | own | options))


NAMES = ("shi_tomasi", "fast", "orb", "sift")
DESCRIPTORS = {"shi_tomasi": (0, np.float32), "fast": (0, np.float32), "orb": (32, np.uint8), "sift": (128, np.float32)}


def picture(size=SIZE, seed=2):
    rng = np.random.default_rng(seed)
    image = np.full(size[::-1], 120, np.uint8)
    for _ in range(size[0] * size[1] // 600):
        box = cv2.boxPoints((rng.uniform([0, 0], size), rng.uniform(5, 30, 2), rng.uniform(0, 90)))
        cv2.fillConvexPoly(image, box.astype(int), int(rng.integers(20, 236)))
    return cv2.GaussianBlur(image, (0, 0), 0.8)


@pytest.mark.parametrize("name", NAMES)
def test_keeps_the_contract(name):
    extractor = make(name)
    assert isinstance(extractor, Extractor)
    allowed = EVERYWHERE.copy()
    allowed[:, 200:] = 0
    found = extractor.extract(picture(), allowed)
    assert 60 <= len(found) <= 120
    assert found.pixels[:, 0].max() <= 200.5
    width, kind = DESCRIPTORS[name]
    assert found.descriptors.shape == (len(found), width) and found.descriptors.dtype == kind
    cells = np.rint(found.pixels)
    apart = np.abs(cells[:, None] - cells).max(axis=-1) + 99 * np.eye(len(found))
    # Refined points may come nearer by a pixel.
    assert apart.min() >= 4
    again = extractor.extract(picture(), allowed)
    assert np.array_equal(found.pixels, again.pixels) and np.array_equal(found.descriptors, again.descriptors)


@pytest.mark.parametrize("name", NAMES)
def test_points_turn_with_the_picture_without_a_bias(name):
    """Of a picture and its half turn: a shift of all points to one side would show twice."""
    gray = picture()
    extractor = make(name, count=300)
    first = extractor.extract(gray, EVERYWHERE).pixels
    turned = extractor.extract(np.ascontiguousarray(gray[::-1, ::-1]), EVERYWHERE).pixels
    second = np.array([SIZE[0] - 1.0, SIZE[1] - 1.0]) - turned
    apart = second[None] - first[:, None]
    nearest = np.abs(apart).sum(axis=-1).argmin(axis=1)
    shift = apart[np.arange(len(first)), nearest]
    shift = shift[np.abs(shift).max(axis=1) < 1.5]
    # The pixels of ORB's levels are others in the turned picture.
    assert len(shift) > (0.5 if name == "orb" else 0.7) * len(first)
    assert np.abs(shift.mean(axis=0)).max() < (0.1 if name == "orb" else 0.06)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("level", [0, 90, 255])
def test_an_empty_picture_has_no_points(name, level):
    found = make(name).extract(np.full(SIZE[::-1], level, np.uint8), EVERYWHERE)
    assert len(found) == 0
    assert found.descriptors.shape == (0, DESCRIPTORS[name][0])


@pytest.mark.parametrize("name", NAMES)
def test_a_forbidden_picture_has_no_points(name):
    assert len(make(name).extract(picture(), np.zeros_like(EVERYWHERE))) == 0


@pytest.mark.parametrize("name", NAMES)
def test_a_tiny_picture_is_no_error(name):
    make(name).extract(picture((24, 20)), np.full((20, 24), 255, np.uint8))


def test_shi_tomasi_finds_corners_of_a_board_to_a_tenth_of_a_pixel():
    squares = np.kron(np.indices((8, 10)).sum(axis=0) % 2, np.ones((120, 120))) * 200 + 20
    # Drawn at four times the size: a crossing at 4 k − 1/2 there lies at k − 1/2 here.
    gray = cv2.resize(squares.astype(np.uint8), None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    found = make("shi_tomasi", count=63).extract(gray, np.full(gray.shape, 255, np.uint8))
    crossings = np.stack(np.meshgrid(np.arange(1, 10), np.arange(1, 8)), axis=-1).reshape(-1, 2) * 30.0 - 0.5
    apart = np.linalg.norm(crossings[:, None] - found.pixels, axis=-1).min(axis=1)
    assert apart.max() < 0.1


def test_the_strongest_are_kept():
    gray = picture()
    for name in NAMES:
        few, many = (make(name, count=count).extract(gray, EVERYWHERE) for count in (20, 100))
        if name != "orb":
            # What ORB distributes over its levels depends on how many are asked for.
            assert np.array_equal(few.pixels, many.pixels[: len(few)])
        assert few.scores.min() >= np.sort(many.scores)[-20] - 1e-9 or name == "orb"


def test_sift_describes_with_unit_vectors_that_survive_a_turn():
    gray = picture((240, 240))
    allowed = np.full(gray.shape, 255, np.uint8)
    turned = np.ascontiguousarray(np.rot90(gray))
    found, after = make("sift").extract(gray, allowed), make("sift").extract(turned, allowed)
    assert np.allclose(np.linalg.norm(found.descriptors, axis=1), 1.0, atol=1e-5)
    # A turn to the left takes (x, y) to (y, 239 − x).
    place = np.stack([found.pixels[:, 1], 239.0 - found.pixels[:, 0]], axis=1)
    apart = np.linalg.norm(place[:, None] - after.pixels, axis=-1)
    near = apart.min(axis=1) < 1.0
    assert near.mean() > 0.6
    far = np.linalg.norm(found.descriptors[near] - after.descriptors[apart.argmin(axis=1)[near]], axis=1)
    assert np.median(far) < 0.3
    upright = make("sift", upright=True)
    first, second = upright.extract(gray, allowed), upright.extract(turned, allowed)
    place = np.stack([first.pixels[:, 1], 239.0 - first.pixels[:, 0]], axis=1)
    nearest = np.linalg.norm(place[:, None] - second.pixels, axis=-1).argmin(axis=1)
    assert np.median(np.linalg.norm(first.descriptors - second.descriptors[nearest], axis=1)) > 0.6


def test_spread_points_cover_the_picture():
    gray = picture()
    gray[:, 160:] = (gray[:, 160:].astype(int) // 4 + 90).astype(np.uint8)
    strong = make("sift", count=40, suppression_px=8).extract(gray, EVERYWHERE)
    spread = make("sift", count=40, suppression_px=8, spread=True).extract(gray, EVERYWHERE)
    assert (strong.pixels[:, 0] > 160).mean() < 0.25 < (spread.pixels[:, 0] > 160).mean()


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("shi_tomasi", {"count": 0}, "feature.count must be positive"),
        ("fast", {"threshold": 0}, "feature.threshold must be positive"),
        ("orb", {"scale": 1.0}, "feature.scale must be above 1"),
        ("orb", {"suppression_px": -1}, "feature.suppression_px must not be negative"),
        ("sift", {"edge": 1.0}, "feature.edge must be above 1"),
        ("sift", {"contrast": 0.0}, "feature.contrast must be positive"),
    ],
)
def test_options_that_cannot_work(name, options, words):
    with pytest.raises(ConfigError, match=words):
        make(name, **options)


def test_spreading_needs_a_distance():
    with pytest.raises(ConfigError, match="suppression_px"):
        Choice(count=5, suppression_px=0, spread=True)
