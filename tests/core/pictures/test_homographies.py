"""Random homographies: directions, ranges, masks against what is warped."""

import numpy as np
import pytest

from vioframe.errors import ConfigError
from vioframe.pictures import HomographyOptions, sample_homography, valid_mask, warp_picture, warp_points

SIZE = (160, 120)
STILL = HomographyOptions(patch_ratio=1.0, perspective=0.0, scale=0.0, max_angle=0.0, overflow=0.0)


@pytest.mark.parametrize(
    "wrong",
    [{"patch_ratio": 0.0}, {"patch_ratio": 1.1}, {"perspective": -0.1}, {"scale": 1.0}, {"max_angle": 4.0}],
    ids=str,
)
def test_ranges_that_cannot_be_are_refused(wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        HomographyOptions(**wrong)


def test_without_any_range_it_is_the_identity():
    H = sample_homography(SIZE, np.random.default_rng(0), STILL)
    np.testing.assert_allclose(H, np.eye(3), atol=1e-9)
    assert valid_mask(H, SIZE, border=0).all()
    mask = valid_mask(H, SIZE, border=3)
    assert mask[3:-3, 3:-3].all()
    assert mask.sum() == 114 * 154


def test_a_patch_ratio_is_a_zoom():
    options = HomographyOptions(patch_ratio=0.5, perspective=0.0, scale=0.0, max_angle=0.0, overflow=0.0)
    H = sample_homography(SIZE, np.random.default_rng(0), options)
    np.testing.assert_allclose(np.diag(H), [2.0, 2.0, 1.0], atol=1e-5)


def test_the_same_generator_gives_the_same_and_another_seed_another():
    first, again, other = (sample_homography(SIZE, np.random.default_rng(seed)) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 1e-3


def test_a_rotation_keeps_its_shape_on_a_picture_that_is_not_square():
    options = HomographyOptions(patch_ratio=1.0, perspective=0.0, scale=0.0, max_angle=1.5, overflow=0.0)
    for seed in range(5):
        H = sample_homography(SIZE, np.random.default_rng(seed), options)
        R = H[:2, :2]
        np.testing.assert_allclose(R @ R.T, np.eye(2), atol=1e-5)
        assert np.linalg.det(R) == pytest.approx(1.0, abs=1e-5)


def test_every_homography_sees_the_whole_picture_from_the_front_and_some_of_it():
    rng = np.random.default_rng(1)
    corners = np.array([[0, 0], [159, 0], [159, 119], [0, 119]], dtype=float)
    shares, angles = [], []
    for _ in range(200):
        H = sample_homography(SIZE, rng)
        assert np.isfinite(warp_points(corners, H)).all()
        shares.append(valid_mask(H, SIZE).mean())
        middle = warp_points(np.array([[80.0, 60.0], [90.0, 60.0]]), H)
        angles.append(np.arctan2(*(middle[1] - middle[0])[::-1]))
    assert min(shares) > 0.2
    assert np.mean(shares) > 0.6
    assert np.ptp(angles) > 2.5


def test_points_come_back_through_the_inverse():
    rng = np.random.default_rng(2)
    H = sample_homography(SIZE, rng)
    points = rng.uniform(0.0, 119.0, (3, 50, 2))
    np.testing.assert_allclose(warp_points(warp_points(points, H), np.linalg.inv(H)), points, atol=1e-8)


def test_behind_the_horizon_there_is_no_point():
    H = np.array([[1.0, 0, 0], [0, 1, 0], [-0.01, 0, 1]])
    warped = warp_points(np.array([[50.0, 10.0], [100.0, 10.0], [150.0, 10.0]]), H)
    assert np.isfinite(warped[0]).all()
    assert np.isnan(warped[1:]).all()


def test_a_blob_in_the_picture_moves_to_where_its_centre_does():
    rng = np.random.default_rng(5)
    y, x = np.mgrid[:120, :160]
    centre = np.array([83.3, 57.8])
    blob = np.round(250 * np.exp(-((x - centre[0]) ** 2 + (y - centre[1]) ** 2) / 18.0)).astype(np.uint8)
    # The centre of mass follows the centre as far as perspective is gentle over the blob.
    options = HomographyOptions(perspective=0.05, overflow=0.0)
    for _ in range(5):
        H = sample_homography(SIZE, rng, options)
        light = warp_picture(blob, H).astype(float)
        found = np.array([(light * x).sum(), (light * y).sum()]) / light.sum()
        np.testing.assert_allclose(found, warp_points(centre, H), atol=0.15)


@pytest.mark.parametrize("border", [0, 3, 6])
def test_the_mask_is_where_a_white_picture_is_white_less_the_border(border):
    rng = np.random.default_rng(7)
    white = np.full((120, 160), 255, np.uint8)
    corners = np.array([[0, 0], [159, 0], [159, 119], [0, 119]], dtype=float)
    for _ in range(10):
        H = sample_homography(SIZE, rng)
        mask = valid_mask(H, SIZE, border=border)
        assert np.all(warp_picture(white, H)[mask] >= 254)
        # Distance of every pixel from the warped outline: no closer than the border inside, no further outside.
        outline = warp_points(corners, H)
        along = np.roll(outline, -1, axis=0) - outline
        y, x = np.mgrid[:120, :160]
        off = np.stack([x, y], -1)[:, :, None] - outline
        depth = (along[:, 0] * off[..., 1] - along[:, 1] * off[..., 0]) / np.linalg.norm(along, axis=1)
        depth = depth.min(axis=-1)
        assert depth[mask].min() >= border - 1e-3
        assert not np.any(~mask & (depth > border + 1e-3))


def test_the_mask_of_the_picture_is_that_of_the_inverse():
    H = sample_homography(SIZE, np.random.default_rng(11))
    mask = valid_mask(np.linalg.inv(H), SIZE, border=0)
    y, x = np.mgrid[:120, :160]
    warped = warp_points(np.stack([x, y], -1).astype(float), H)
    inside = ((warped > -1e-4) & (warped < np.array([159, 119]) + 1e-4)).all(axis=-1)
    np.testing.assert_array_equal(mask, inside)


def test_another_size_of_the_warped_picture():
    H = np.diag([0.5, 0.5, 1.0])
    mask = valid_mask(H, SIZE, border=0, warped_size_px=(100, 70))
    assert mask.shape == (70, 100)
    assert mask[:60, :80].all()
    assert not mask[60:].any()
    assert not mask[:, 80:].any()
    assert warp_picture(np.zeros((120, 160), np.uint8), H, (100, 70), fill=7)[65, 5] == 7
