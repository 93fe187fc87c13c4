"""Words that are learned on the way: places are found again by them, also when some are forgotten."""

import cv2
import numpy as np

from loop_scenes import CAMERA
from vioframe.types import Tracks
from vioframe_window.loop_appearance import Describer
from vioframe_window.loop_vocabulary import GrowingTree, PlaceIndex, as_lanes, hamming


def spoiled(rng: np.random.Generator, descriptors: np.ndarray, bits: int) -> np.ndarray:
    """The same descriptors with some bits of each the other way round."""
    each = np.unpackbits(descriptors, axis=1)
    for row in each:
        row[rng.choice(256, bits, replace=False)] ^= 1
    return np.packbits(each, axis=1)


def seen_again(rng: np.random.Generator, place: np.ndarray) -> np.ndarray:
    """Half of a place's descriptors a little changed, and as many that were never there."""
    kept = spoiled(rng, place[rng.permutation(len(place))[: len(place) // 2]], 10)
    return np.concatenate([kept, rng.integers(0, 256, kept.shape, dtype=np.uint8)])


def likeliest(index: PlaceIndex, descriptors: np.ndarray) -> list[int]:
    """The three places that look most like it."""
    return np.argsort(-index.similarity(descriptors))[:3].tolist()


def test_hamming_counts_differing_bits() -> None:
    rng = np.random.default_rng(0)
    first, second = (rng.integers(0, 256, (7, 32), dtype=np.uint8) for _ in range(2))
    wanted = (np.unpackbits(first, axis=1)[:, None] != np.unpackbits(second, axis=1)[None]).sum(axis=2)
    np.testing.assert_array_equal(hamming(as_lanes(first)[:, None], as_lanes(second)[None]), wanted)


def test_a_place_is_found_among_two_hundred() -> None:
    rng = np.random.default_rng(1)
    places = rng.integers(0, 256, (200, 80, 32), dtype=np.uint8)
    index = PlaceIndex(capacity=60)
    for place in places:
        index.add(place)
    asked = range(0, 200, 5)
    assert np.mean([number in likeliest(index, seen_again(rng, places[number])) for number in asked]) >= 0.85


def test_forgotten_places_leave_the_others_where_they_are() -> None:
    rng = np.random.default_rng(2)
    places = rng.integers(0, 256, (60, 80, 32), dtype=np.uint8)
    index = PlaceIndex(capacity=40)
    for place in places[:50]:
        index.add(place)
    kept = np.arange(50) % 3 > 0
    index.thin(kept)
    numbers = [*np.flatnonzero(kept), *range(50, 60)]
    for place in places[50:]:
        index.add(place)
    assert len(index) == len(numbers)
    found = [now in likeliest(index, seen_again(rng, places[number])) for now, number in enumerate(numbers)]
    assert np.mean(found) >= 0.85


def test_the_same_descriptors_make_the_same_words() -> None:
    rng = np.random.default_rng(3)
    lanes = as_lanes(rng.integers(0, 256, (500, 32), dtype=np.uint8))
    words = []
    for _ in range(2):
        tree = GrowingTree(branching=4, capacity=100)
        tree.divide(0, lanes)
        words.append(tree.words(lanes))
    np.testing.assert_array_equal(words[0], words[1])
    assert len(np.unique(words[0])) == 4


def test_one_point_seen_often_is_one_word() -> None:
    rng = np.random.default_rng(4)
    point = rng.integers(0, 256, (1, 32), dtype=np.uint8)
    lanes = as_lanes(spoiled(rng, np.repeat(point, 200, axis=0), 8))
    assert GrowingTree(capacity=100).divide(0, lanes) is None


def picture(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    image = np.full((480, 640), 120, np.uint8)
    for _ in range(400):
        corner = rng.integers(0, (640, 480))
        size = rng.integers(8, 40, 2)
        cv2.rectangle(image, corner.tolist(), (corner + size).tolist(), int(rng.integers(0, 255)), -1)
    return cv2.GaussianBlur(image, (0, 0), 1.0)


def tracks_at(pixels: np.ndarray) -> Tracks:
    from vioframe.geometry import camera as projection

    return Tracks(
        ids=np.arange(len(pixels)),
        pixels=pixels,
        bearings=projection.bearings(CAMERA, pixels),
        scores=np.ones(len(pixels)),
    )


def test_descriptors_turn_with_gravity() -> None:
    rng = np.random.default_rng(5)
    image = picture(6)
    turn = np.radians(35.0)
    centre = CAMERA.intrinsics_px[2:]
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    warp = np.column_stack([rotation, centre - rotation @ centre])
    turned = cv2.warpAffine(image, warp, (640, 480))
    radius, angle = rng.uniform(0.0, 180.0, 150), rng.uniform(0.0, 2.0 * np.pi, 150)
    pixels = np.round(centre + radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    moved = (pixels - centre) @ rotation.T + centre
    describer = Describer(CAMERA, corners=0, threshold=20, cell_px=24)
    down, down_turned = np.array([0.0, 1.0, 0.0]), np.array([*(rotation @ (0.0, 1.0)), 0.0])

    def distance(direction: np.ndarray) -> float:
        first = describer.describe(image, tracks_at(pixels), down)
        second = describer.describe(turned, tracks_at(moved), direction)
        assert len(first) == len(second) == 150
        return float(np.median(hamming(as_lanes(first.descriptors), as_lanes(second.descriptors))))

    assert distance(down_turned) < 45.0
    assert distance(down) > 60.0


def test_corners_lie_between_the_tracked_points() -> None:
    image = picture(7)
    tracked = np.array([[100.0, 100.0], [300.0, 200.0], [500.0, 400.0]])
    seen = Describer(CAMERA, corners=60, threshold=20, cell_px=32).describe(image, tracks_at(tracked), np.eye(3)[1])
    corners = seen.pixels[seen.ids < 0]
    assert 40 <= len(corners) <= 60
    assert not {tuple(p) for p in (corners // 32).tolist()} & {tuple(p) for p in (tracked // 32).tolist()}
    np.testing.assert_allclose(np.linalg.norm(seen.bearings, axis=1), 1.0)


def test_an_image_without_corners_has_only_its_tracks() -> None:
    flat = np.full((480, 640), 90, np.uint8)
    seen = Describer(CAMERA, corners=60, threshold=20, cell_px=32).describe(flat, Tracks.none(), np.eye(3)[1])
    assert len(seen) == 0


def test_learned_descriptors_become_binary_and_keep_who_is_near_whom() -> None:
    rng = np.random.default_rng(8)
    learned = rng.standard_normal((50, 64))
    learned /= np.linalg.norm(learned, axis=1, keepdims=True)
    again = learned + 0.03 * rng.standard_normal(learned.shape)
    describer = Describer(CAMERA, corners=0, threshold=20, cell_px=24)
    pixels = rng.uniform(50.0, 400.0, (50, 2))

    def binary(descriptors: np.ndarray) -> np.ndarray:
        from dataclasses import replace

        tracks = replace(tracks_at(pixels), descriptors=descriptors.astype(np.float32))
        return as_lanes(describer.describe(picture(9), tracks, np.eye(3)[1]).descriptors)

    distance = hamming(binary(learned)[:, None], binary(again)[None])
    np.testing.assert_array_equal(distance.argmin(axis=1), np.arange(50))
