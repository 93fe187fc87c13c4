"""Windows for training: where they begin, what they hold, and that a change keeps images and motion together."""

from dataclasses import replace

import numpy as np
import pytest

from learned_scenes import stored
from vioframe.data import augmentation
from vioframe.data.windows import PairAnswers, WindowIndex, check_split, cut_window
from vioframe.errors import ConfigError, DataError, ShapeError
from vioframe.geometry import se3, so3
from vioframe.geometry.camera import project
from vioframe.types import ImuBlock

OFF = {
    "reverse": 0.0,
    "mirror": 0.0,
    "blur": 0.0,
    "blur_sigma_px": [0.5, 1.5],
    "salt_pepper": 0.0,
    "salt_pepper_share": 0.02,
    "photometric": 0.0,
    "brightness": 0.2,
    "contrast": 0.2,
    "gamma": 0.2,
}


def integrate_gyro(samples, times):
    """Rotation over a window by the mid-point rule."""
    R = np.eye(3)
    for a, b, step in zip(samples[:-1], samples[1:], np.diff(times), strict=True):
        R = R @ so3.exp(0.5 * (a[:3] + b[:3]) * step)
    return R


def body_motion(window, pair):
    T_bc = window.T_body_cam
    return T_bc @ window.T_prev_cur[pair] @ np.linalg.inv(T_bc)


def test_no_window_in_no_recording():
    with pytest.raises(DataError, match=r"12 images"):
        WindowIndex([stored()], 12, split="training")


def test_pairs_below_one_are_refused():
    with pytest.raises(ConfigError, match="trainer.pairs"):
        WindowIndex([stored()], 0, split="training")


def test_mixed_sizes_are_refused_by_name():
    small = stored(name="small")
    small = replace(small, images=small.images[:, ::2, ::2])
    with pytest.raises(DataError, match="small has 160×120×1"):
        WindowIndex([stored(), small], 2, split="training")


def test_one_recording_in_both_splits_is_refused():
    with pytest.raises(ConfigError, match="car-1"):
        check_split(["car-0", "car-1"], ["car-1"])


def test_window_starts_keep_off_missing_images_and_unknown_truth():
    sequence = stored()
    stamps = sequence.stamps_ns.copy()
    stamps[5:] += 10 * (stamps[1] - stamps[0])
    known = sequence.known.copy()
    known[9] = False
    broken = replace(sequence, stamps_ns=stamps, known=known)
    starts = broken.starts(2)
    covered = [set(range(start, start + 3)) for start in starts]
    assert covered
    assert not any({4, 5} <= window or 9 in window for window in covered)


def test_imu_ends_at_the_images_and_integrates_to_the_true_rotation():
    window = cut_window(stored(), 3, 2)
    for pair in range(2):
        times = window.imu_time_s[pair]
        assert times[0] == 0.0
        assert times[-1] == pytest.approx((window.stamps_ns[pair + 1] - window.stamps_ns[pair]) / 1e9, abs=1e-12)
        R = integrate_gyro(window.imu[pair], times)
        np.testing.assert_allclose(R, body_motion(window, pair)[:3, :3], atol=1e-5)


@pytest.mark.parametrize("advance", [1, 2, 3])
def test_tiles_answer_every_pair_that_can_be_answered(advance):
    pairs = 3
    index = WindowIndex([stored(), stored(name="other")], pairs, split="validation")
    tiles = index.tiled(advance)
    answered = set()
    for window in (tiles[i] for i in range(len(tiles))):
        last = window.start + pairs
        answered |= {(window.recording, pair) for pair in range(last - advance, last)}
    frames = len(stored())
    assert {(r, p) for r in (0, 1) for p in range(pairs - 1, frames - 1)} <= answered


def test_reversing_twice_is_nothing():
    window = cut_window(stored(), 2, 3)
    again = augmentation.reversed_window(augmentation.reversed_window(window))
    np.testing.assert_array_equal(again.images, window.images)
    np.testing.assert_array_equal(again.stamps_ns, window.stamps_ns)
    np.testing.assert_allclose(again.T_prev_cur, window.T_prev_cur, atol=1e-12)
    np.testing.assert_allclose(np.concatenate(again.imu), np.concatenate(window.imu))


def test_reversed_gyro_integrates_to_the_reversed_motion():
    window = augmentation.reversed_window(cut_window(stored(), 2, 3))
    for pair in range(3):
        R = integrate_gyro(window.imu[pair], window.imu_time_s[pair])
        np.testing.assert_allclose(R, body_motion(window, pair)[:3, :3], atol=1e-5)


def test_mirroring_twice_is_nothing():
    window = cut_window(stored(), 2, 3)
    again = augmentation.mirrored_window(augmentation.mirrored_window(window))
    np.testing.assert_array_equal(again.images, window.images)
    for field in ("T_prev_cur", "intrinsics_px", "T_body_cam"):
        np.testing.assert_allclose(getattr(again, field), getattr(window, field), atol=1e-12)
    np.testing.assert_allclose(np.concatenate(again.imu), np.concatenate(window.imu))


def test_mirrored_points_move_as_the_mirrored_motion_says():
    sequence = stored()
    window = cut_window(sequence, 2, 1)
    mirrored = augmentation.mirrored_window(window)
    camera = sequence.camera
    twin = replace(camera, intrinsics_px=mirrored.intrinsics_px)
    point = np.array([0.4, -0.2, 5.0])
    flipped = point * [-1.0, 1.0, 1.0]
    width = camera.size_px[0]
    for T, T_mirror in ((np.eye(4), np.eye(4)), (window.T_prev_cur[0], mirrored.T_prev_cur[0])):
        inverse, inverse_mirror = np.linalg.inv(T), np.linalg.inv(T_mirror)
        pixel, _ = project(camera, inverse[:3, :3] @ point + inverse[:3, 3])
        seen, _ = project(twin, inverse_mirror[:3, :3] @ flipped + inverse_mirror[:3, 3])
        np.testing.assert_allclose(seen, [width - 1 - pixel[0], pixel[1]], atol=1e-9)


def test_mirrored_gyro_integrates_to_the_mirrored_motion_and_gravity_stays_as_strong():
    plain = cut_window(stored(), 2, 2)
    window = augmentation.mirrored_window(plain)
    assert np.linalg.det(window.T_body_cam[:3, :3]) == pytest.approx(1.0)
    for pair in range(2):
        R = integrate_gyro(window.imu[pair], window.imu_time_s[pair])
        np.testing.assert_allclose(R, body_motion(window, pair)[:3, :3], atol=1e-5)
        lengths = np.linalg.norm(window.imu[pair][:, 3:], axis=1)
        np.testing.assert_allclose(lengths, np.linalg.norm(plain.imu[pair][:, 3:], axis=1))


def answered(sequence, seed=0):
    """The sequence with what a VO answered: true motions with an error of the covariance that it states."""
    rng = np.random.default_rng(seed)
    count = len(sequence) - 1
    roots = 0.01 * rng.standard_normal((count, 6, 6))
    errors = np.einsum("kij,kj->ki", roots, rng.standard_normal((count, 6)))
    answers = PairAnswers(
        T_prev_cur=sequence.motions() @ se3.exp(errors),
        covariance=roots @ roots.transpose(0, 2, 1),
        valid=rng.uniform(size=count) < 0.8,
    )
    return replace(sequence, vo=answers)


def mahalanobis(window):
    """Of the VO's errors, in the units of what it states."""
    errors = se3.log(se3.inverse(window.T_prev_cur) @ window.vo.T_prev_cur)
    return np.einsum("ki,kij,kj->k", errors, np.linalg.inv(window.vo.covariance), errors)


def test_a_window_holds_what_the_vo_answered():
    sequence = answered(stored())
    window = cut_window(sequence, 3, 4)
    np.testing.assert_array_equal(window.vo.T_prev_cur, sequence.vo.T_prev_cur[3:7])
    np.testing.assert_array_equal(window.vo.valid, sequence.vo.valid[3:7])
    with pytest.raises(ShapeError, match="must answer for 11 pairs, got 5"):
        replace(sequence, vo=sequence.vo.cut(0, 5))


def test_reversed_and_mirrored_answers_err_as_they_did():
    window = cut_window(answered(stored()), 2, 5)
    for change, order in ((augmentation.reversed_window, -1), (augmentation.mirrored_window, 1)):
        changed = change(window)
        np.testing.assert_allclose(mahalanobis(changed), mahalanobis(window)[::order], rtol=1e-4)
        np.testing.assert_array_equal(changed.vo.valid, window.vo.valid[::order])
        again = change(changed)
        np.testing.assert_allclose(again.vo.covariance, window.vo.covariance, atol=1e-12)
        np.testing.assert_allclose(again.vo.T_prev_cur, window.vo.T_prev_cur, atol=1e-12)


@pytest.mark.parametrize("change", [lambda same: same, augmentation.reversed_window, augmentation.mirrored_window])
def test_velocity_gravity_and_specific_force_agree(change):
    """v' = a + g - ω × v in the body, whichever way time runs and however space is mirrored."""
    window = change(cut_window(stored(), 2, 6))
    assert np.linalg.norm(window.gravity_body, axis=1) == pytest.approx(9.81)
    for pair in range(6):
        samples, times = window.imu[pair], window.imu_time_s[pair]
        R = body_motion(window, pair)[:3, :3]
        increment, turned = np.zeros(3), np.eye(3)
        for a, b, step in zip(samples[:-1], samples[1:], np.diff(times), strict=True):
            middle = turned @ so3.exp(0.25 * step * (a[:3] + b[:3]))
            increment += step * middle @ (0.5 * (a[3:] + b[3:]))
            turned = turned @ so3.exp(0.5 * step * (a[:3] + b[:3]))
        after = window.velocity_body[pair] + window.gravity_body[pair] * times[-1] + increment
        np.testing.assert_allclose(R @ window.velocity_body[pair + 1], after, atol=2e-4)
        np.testing.assert_allclose(R @ window.gravity_body[pair + 1], window.gravity_body[pair], atol=1e-6)


def test_samples_are_cut_where_they_are_known():
    sequence = stored()
    half, imu = len(sequence.imu) // 2, sequence.imu
    short = replace(
        sequence, imu=ImuBlock(stamps_ns=imu.stamps_ns[:half], gyro=imu.gyro[:half], accel=imu.accel[:half])
    )
    window = cut_window(short, 0, len(sequence) - 1)
    covered = sequence.stamps_ns[1:] <= short.imu.stamps_ns[-1]
    assert 0 < covered.sum() < len(covered)
    assert [len(block) > 0 for block in window.imu] == covered.tolist()


def test_switched_off_changes_nothing():
    window = cut_window(stored(), 0, 2)
    assert augmentation.Augmentation(**OFF).apply(window, np.random.default_rng(0)) is window


def test_the_same_generator_gives_the_same_change_and_leaves_the_window_alone():
    window = cut_window(stored(), 0, 2)
    before = window.images.copy()
    always = augmentation.Augmentation(
        **{**OFF, "reverse": 1, "mirror": 1, "blur": 1, "salt_pepper": 1, "photometric": 1}
    )
    one, two = (always.apply(window, np.random.default_rng(7)) for _ in range(2))
    np.testing.assert_array_equal(one.images, two.images)
    np.testing.assert_array_equal(window.images, before)
    assert one.images.dtype == np.uint8
    assert one.images.shape == window.images.shape
    assert np.abs(one.images.astype(int) - before[::-1, :, ::-1]).max() > 50


@pytest.mark.parametrize(
    "wrong",
    [
        {"reverse": 1.5},
        {"salt_pepper_share": -0.1},
        {"gamma": -1.0},
        {"blur_sigma_px": [0.0, 1.0]},
        {"blur_sigma_px": [2]},
    ],
)
def test_impossible_augmentation_is_refused_by_its_key(wrong):
    with pytest.raises(ConfigError, match=f"trainer.augmentation.{next(iter(wrong))}"):
        augmentation.Augmentation(**{**OFF, **wrong})


def test_salt_and_pepper_come_in_the_share_asked_for():
    images = np.full((2, 100, 200, 1), 128, dtype=np.uint8)
    changed = augmentation.salted(images, 0.1, np.random.default_rng(0))
    assert np.mean(changed == 0) == pytest.approx(0.05, abs=0.01)
    assert np.mean(changed == 255) == pytest.approx(0.05, abs=0.01)


def test_neutral_tone_is_the_identity():
    images = np.arange(256, dtype=np.uint8).reshape(1, 16, 16, 1)
    np.testing.assert_array_equal(augmentation.toned(images, 1.0, 1.0, 1.0), images)
