"""What a keyframe is known by where the front end describes its points itself."""

import numpy as np
import pytest

from loop_scenes import CAMERA, NO_IMAGE
from vioframe.geometry import camera as projection
from vioframe.types import Tracks
from vioframe.vision.keypoints import Keypoints
from vioframe_window.loop_appearance import NO_TRACK, Describer

DOWN = np.array([0.0, 1.0, 0.0])


def tracks_and_rest(rng, dimensions, followed=30, rest=80):
    pixels = rng.uniform(20.0, 460.0, (followed + rest, 2))
    descriptors = rng.standard_normal((followed + rest, dimensions)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    tracks = Tracks(
        ids=np.arange(followed, dtype=np.int64),
        pixels=pixels[:followed],
        bearings=projection.bearings(CAMERA, pixels[:followed]),
        scores=np.ones(followed),
        descriptors=descriptors[:followed],
    )
    untracked = Keypoints(pixels=pixels[followed:], scores=rng.uniform(size=rest), descriptors=descriptors[followed:])
    return tracks, untracked


def test_strongest_points_beside_the_tracks_are_known_too():
    tracks, untracked = tracks_and_rest(np.random.default_rng(0), 256)
    describer = Describer(CAMERA, corners=50, threshold=20, cell_px=24)
    seen = describer.describe(NO_IMAGE, tracks, DOWN, untracked)
    assert seen.ids.tolist() == [*range(30), *[NO_TRACK] * 50]
    assert seen.descriptors.shape == (80, 32)
    strongest = untracked.pixels[np.argsort(-untracked.scores)[:50]]
    assert np.array_equal(seen.pixels[30:], strongest)
    np.testing.assert_allclose(seen.bearings[30:], projection.bearings(CAMERA, strongest))
    alone = describer.describe(NO_IMAGE, tracks, DOWN)
    assert np.array_equal(alone.descriptors, seen.descriptors[:30])


@pytest.mark.parametrize("distance", [0.3, 0.7, 1.2])
def test_bits_that_differ_are_the_angle_between_descriptors(distance):
    """Charikar: a random plane parts two unit vectors with probability angle / π."""
    rng = np.random.default_rng(1)
    tracks, _ = tracks_and_rest(rng, 256, followed=200)
    angle = 2.0 * np.arcsin(distance / 2.0)
    aside = rng.standard_normal(tracks.descriptors.shape)
    aside -= np.sum(aside * tracks.descriptors, axis=1, keepdims=True) * tracks.descriptors
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    moved = Tracks(
        ids=tracks.ids,
        pixels=tracks.pixels,
        bearings=tracks.bearings,
        scores=tracks.scores,
        descriptors=(np.cos(angle) * tracks.descriptors + np.sin(angle) * aside).astype(np.float32),
    )
    describer = Describer(CAMERA, corners=0, threshold=20, cell_px=24)
    first, second = (describer.describe(NO_IMAGE, each, DOWN).descriptors for each in (tracks, moved))
    bits = np.unpackbits(first ^ second, axis=1).sum(axis=1)
    assert bits.mean() == pytest.approx(256 * angle / np.pi, rel=0.05)
