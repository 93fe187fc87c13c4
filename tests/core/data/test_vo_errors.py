"""The error model errs as told, by seed and recording alone, and its parameters are found again in what it did."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from vioframe.checks import Array
from vioframe.conventions import NANOSECONDS
from vioframe.data.error_fit import AnsweredMotions, fit_errors
from vioframe.data.error_model_vo import ErrorModelVO
from vioframe.data.exposure import ExposedFrame
from vioframe.data.simulator import CameraSettings, SimulatedDataset
from vioframe.data.vo_errors import DIRECTION, ROTATION, SCALE, ErrorCourse, VoErrors, error_signals
from vioframe.errors import ConfigError, DataError, StateError
from vioframe.geometry import se3, so3
from vioframe.interfaces import METRIC_SCALE, RELATIVE_POSE, UsesGroundTruth
from vioframe.types import Frame, RelativePose, SensorRig, Trajectory, VisualFeatures

ERRORS = VoErrors(
    rotation_white=(0.002, 0.004, 0.001),
    rotation_correlated=(0.001, 0.003, 0.002),
    rotation_time_s=2.0,
    direction_white=(0.004, 0.006, 0.005),
    direction_correlated=(0.01, 0.02, 0.015),
    direction_time_s=3.0,
    scale_white=0.01,
    scale_correlated=0.04,
    scale_time_s=5.0,
    translation_floor=0.01,
    tail=5.0,
)
RECORDING = SimulatedDataset(duration_s=20.0, camera=CameraSettings(images=False)).open("walk-0")


def answers(vo: ErrorModelVO, stamps: Array, truth: Trajectory | None = None) -> list[RelativePose]:
    vo.setup(RECORDING.rig)
    vo.take_ground_truth(RECORDING.ground_truth() if truth is None else truth)
    features = [VisualFeatures(frame=Frame(stamp_ns=int(stamp))) for stamp in stamps]
    return [vo.estimate(a, b) for a, b in pairwise(features)]


def drive(pairs: int, seed: int = 0, rate_hz: float = 10.0) -> tuple[Array, Array]:
    """Motions (P, 4, 4) of a camera that looks ahead at about 10 m/s and turns gently, and stamps (P + 1,)."""
    random = np.random.default_rng(seed)
    turns = 0.02 * np.cumsum(random.normal(size=(pairs, 3)), axis=0) / np.sqrt(np.arange(1, pairs + 1))[:, None]
    ahead = np.zeros((pairs, 3))
    ahead[:, 2] = (10.0 + np.sin(np.arange(pairs) / 50.0)) / rate_hz
    ahead[:, :2] = 0.02 * random.normal(size=(pairs, 2))
    stamps = np.round(np.arange(pairs + 1) / rate_hz * NANOSECONDS).astype(np.int64)
    return se3.from_parts(so3.exp(turns / rate_hz), ahead), stamps


def spoilt(errors: VoErrors, pairs: int, seed: int, rate_hz: float = 10.0) -> AnsweredMotions:
    true, stamps = drive(pairs, seed, rate_hz)
    course = ErrorCourse(errors, int(stamps[0]), int(stamps[-1]), (seed, 17))
    duration = 1.0 / rate_hz
    out = [
        errors.spoil(T, duration, *course.draw(int(a), int(b)))
        for T, a, b in zip(true, stamps[:-1], stamps[1:], strict=True)
    ]
    return AnsweredMotions(
        T_true=true,
        T_estimate=np.array(out),
        duration_s=np.full(pairs, duration),
        valid=np.ones(pairs, dtype=np.bool_),
    )


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("rotation_white", (0.1, -0.1, 0.0)),
        ("direction_correlated", (0.1, 0.1)),
        ("scale_white", -1.0),
        ("translation_floor", float("nan")),
        ("scale_time_s", 0.0),
        ("tail", 2.0),
    ],
)
def test_wrong_parameters_are_refused_by_name(name: str, value: object) -> None:
    with pytest.raises(ConfigError, match=f"vo.errors.{name}"):
        replace(ERRORS, **{name: value})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "options", [{"rotation_level": -1.0}, {"translation_level": float("nan")}, {"lost_share": 2.0}, {"seed": -1}]
)
def test_wrong_options_are_refused_by_name(options: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=f"vo.{next(iter(options))}"):
        ErrorModelVO(errors=ERRORS, **options)  # type: ignore[arg-type]


def test_it_uses_the_truth_and_is_metric() -> None:
    vo = ErrorModelVO(errors=ERRORS)
    assert isinstance(vo, UsesGroundTruth)
    assert vo.provides == {RELATIVE_POSE, METRIC_SCALE} and not vo.requires
    vo.setup(RECORDING.rig)
    with pytest.raises(StateError, match="ground truth"):
        vo.estimate(VisualFeatures(frame=Frame(stamp_ns=0)), VisualFeatures(frame=Frame(stamp_ns=1)))


def test_without_errors_it_is_exact() -> None:
    stamps = RECORDING.frame_stamps_ns
    found = answers(ErrorModelVO(errors=ERRORS, rotation_level=0.0, translation_level=0.0), stamps)
    poses = RECORDING.motion.evaluate(RECORDING.elapsed_s(stamps)).T_world_body @ RECORDING.rig.cameras[0].T_body_cam
    np.testing.assert_allclose([e.T_prev_cur for e in found], se3.inverse(poses[:-1]) @ poses[1:], atol=1e-9)
    np.linalg.cholesky([e.covariance for e in found])


def test_signals_are_read_back_from_the_motions_that_they_made() -> None:
    true, _ = drive(50)
    random = np.random.default_rng(1)
    signals = random.normal(size=(50, 7)) * [0.1, 0.1, 0.1, 0.05, 0.05, 0.0, 0.2]
    # A direction turned about itself is the same: take that part out of what is to be read back.
    ahead = true[:, :3, 3] / np.linalg.norm(true[:, :3, 3], axis=1, keepdims=True)
    signals[:, DIRECTION] -= ahead * np.sum(ahead * signals[:, DIRECTION], axis=1, keepdims=True)
    out = np.array([ERRORS.spoil(T, 0.1, s, np.zeros(3)) for T, s in zip(true, signals, strict=True)])
    np.testing.assert_allclose(error_signals(true, out, np.full(50, 0.1), 1.0), signals, atol=1e-9)


def test_slow_motions_say_nothing_of_direction_and_scale() -> None:
    true, _ = drive(3)
    true[1, :3, 3] *= 0.01
    signals = error_signals(true, true, np.full(3, 0.1), 1.0)
    assert np.isnan(signals[1, 3:]).all() and np.isfinite(signals[[0, 2]]).all() and np.isfinite(signals[1, :3]).all()


def test_the_stated_covariance_is_that_of_single_pairs() -> None:
    """Over many draws of one pair that turns and moves: mean square Mahalanobis length, and each variance."""
    T = se3.from_parts(so3.exp(np.array([0.1, -0.3, 0.2])), np.array([0.3, -0.1, 1.0]))
    gaussian = replace(ERRORS, tail=1e6)
    errors = []
    for seed in range(3000):
        course = ErrorCourse(gaussian, 0, NANOSECONDS, (seed,))
        out = gaussian.spoil(T, 0.1, *course.draw(NANOSECONDS // 2, NANOSECONDS // 2 + NANOSECONDS // 10))
        errors.append(se3.log(se3.inverse(T) @ out))
    stated = gaussian.covariance(T, 0.1)
    whitened = np.linalg.solve(np.linalg.cholesky(stated), np.array(errors).T)
    # Variances of 3000 draws are known to 2.6 %; the errors are taken to first order.
    np.testing.assert_allclose(whitened @ whitened.T / 3000, np.eye(6), atol=0.1)


def test_tails_are_as_heavy_as_told_and_their_variance_stays() -> None:
    heavy = replace(
        ERRORS, tail=5.0, rotation_correlated=(0.0,) * 3, direction_correlated=(0.0,) * 3, scale_correlated=0.0
    )
    course = ErrorCourse(heavy, 0, NANOSECONDS, (3,))
    step = NANOSECONDS // 10
    draws = np.array([course.draw(k * step, (k + 1) * step)[0] for k in range(8000)])
    sigma = heavy.white / np.sqrt(0.1)
    np.testing.assert_allclose(draws.std(axis=0), sigma, rtol=0.06)
    # Student's t with 5 degrees of freedom and unit variance: P(|x| > 4) = 0.0035; a Gaussian has 6e-5.
    assert np.mean(np.abs(draws / sigma) > 4.0) == pytest.approx(0.0035, abs=0.001)


def test_correlated_errors_last_and_do_not_depend_on_the_rate() -> None:
    only = replace(
        ERRORS, rotation_white=(0.0,) * 3, direction_white=(0.0,) * 3, scale_white=0.0, translation_floor=0.0
    )
    course = ErrorCourse(only, 0, 4000 * NANOSECONDS, (5,))
    slow = np.array([course.draw(k * NANOSECONDS, (k + 1) * NANOSECONDS)[0] for k in range(3999)])
    fast = np.array([course.draw(k * NANOSECONDS // 10, (k + 1) * NANOSECONDS // 10)[0] for k in range(39990)])
    np.testing.assert_allclose(fast.reshape(3999, 10, 7).mean(axis=1), slow, atol=1e-9)
    np.testing.assert_allclose(fast.std(axis=0), only.correlated, rtol=0.12)
    lag = 10  # one second
    correlation = np.mean(fast[lag:] * fast[:-lag], axis=0) / fast.var(axis=0)
    np.testing.assert_allclose(correlation, np.exp(-1.0 / only.times_s), atol=0.07)


def test_a_pair_errs_the_same_whatever_other_images_exist() -> None:
    stamps = RECORDING.frame_stamps_ns
    vo = ErrorModelVO(errors=ERRORS, seed=4)
    whole = answers(vo, stamps)
    late = answers(vo, stamps[200:])
    np.testing.assert_array_equal(whole[230].T_prev_cur, late[30].T_prev_cur)
    features = [VisualFeatures(frame=Frame(stamp_ns=int(s))) for s in stamps[[230, 231]]]
    np.testing.assert_array_equal(vo.estimate(*features).T_prev_cur, whole[230].T_prev_cur)
    # A moved stamp is no other picture.
    moved = [
        VisualFeatures(frame=ExposedFrame(stamp_ns=f.frame.stamp_ns + 7_000_000, exposed_ns=f.frame.stamp_ns))
        for f in features
    ]
    np.testing.assert_array_equal(vo.estimate(*moved).T_prev_cur, whole[230].T_prev_cur)


def test_seed_and_recording_make_the_errors() -> None:
    stamps = RECORDING.frame_stamps_ns[:50]
    first, again = (answers(ErrorModelVO(errors=ERRORS, seed=1), stamps) for _ in range(2))
    other = answers(ErrorModelVO(errors=ERRORS, seed=2), stamps)
    np.testing.assert_array_equal([e.T_prev_cur for e in first], [e.T_prev_cur for e in again])
    assert np.abs(first[10].T_prev_cur - other[10].T_prev_cur).max() > 1e-5
    # The same stamps on another recording; and the same recording as seen from another place on the body.
    truth = RECORDING.ground_truth()
    slower = Trajectory(stamps_ns=truth.stamps_ns, T_world_body=se3.exp(0.5 * se3.log(truth.T_world_body)))
    mounted = Trajectory(stamps_ns=truth.stamps_ns, T_world_body=truth.T_world_body @ se3.exp(np.full(6, 0.2)))
    errors = []
    for trajectory in (truth, slower, mounted):
        made = answers(ErrorModelVO(errors=ERRORS, seed=1), stamps, trajectory)
        exact = answers(ErrorModelVO(errors=ERRORS, rotation_level=0.0, translation_level=0.0), stamps, trajectory)
        pairs = zip(exact, made, strict=True)
        errors.append(np.array([so3.log(a.T_prev_cur[:3, :3].T @ b.T_prev_cur[:3, :3]) for a, b in pairs]))
    assert np.abs(errors[0] - errors[1]).max() > 1e-5
    np.testing.assert_allclose(errors[0], errors[2], atol=1e-9)


def test_beyond_the_truth_and_where_it_is_lost_it_is_invalid() -> None:
    truth = RECORDING.ground_truth()
    end = int(truth.stamps_ns[-1])
    assert not answers(ErrorModelVO(errors=ERRORS), np.array([end, end + NANOSECONDS]))[0].valid
    stamps = RECORDING.frame_stamps_ns
    whole = answers(ErrorModelVO(errors=ERRORS), stamps)
    holed = answers(ErrorModelVO(errors=ERRORS, lost_share=0.3), stamps)
    assert 0.6 < np.mean([e.valid for e in holed]) < 0.8
    for a, b in zip(whole, holed, strict=True):
        if b.valid:
            np.testing.assert_array_equal(a.T_prev_cur, b.T_prev_cur)


def test_without_a_camera_it_is_the_motion_of_the_body() -> None:
    vo = ErrorModelVO(errors=ERRORS, rotation_level=0.0, translation_level=0.0)
    vo.setup(SensorRig(cameras=(), imu=RECORDING.rig.imu))
    vo.take_ground_truth(RECORDING.ground_truth())
    stamps = RECORDING.frame_stamps_ns[[100, 101]]
    found = vo.estimate(*(VisualFeatures(frame=Frame(stamp_ns=int(s))) for s in stamps))
    poses = RECORDING.motion.evaluate(RECORDING.elapsed_s(stamps)).T_world_body
    np.testing.assert_allclose(found.T_prev_cur, se3.inverse(poses[0]) @ poses[1], atol=1e-9)


def test_known_parameters_are_found_again() -> None:
    known = replace(ERRORS, translation_floor=0.0)
    found = fit_errors([spoilt(known, 8000, seed) for seed in range(2)])
    seen = [0, 1, 2, 3, 4, 6]
    np.testing.assert_allclose(found.white[seen], known.white[seen], rtol=0.12)
    np.testing.assert_allclose(found.correlated[seen], known.correlated[seen], rtol=0.2)
    np.testing.assert_allclose(found.times_s, known.times_s, rtol=0.45)
    assert found.tail == pytest.approx(5.0, rel=0.35)
    # Ahead it cannot be seen: the mean of the two that can.
    assert found.direction_white[2] == pytest.approx(np.mean(known.direction_white[:2]), rel=0.3)


def test_densities_do_not_depend_on_the_frame_rate() -> None:
    known = replace(ERRORS, translation_floor=0.0)
    found = fit_errors([spoilt(known, 8000, 0, rate_hz=20.0)])
    np.testing.assert_allclose(found.white[:3], known.white[:3], rtol=0.12)


def test_white_noise_alone_is_not_taken_for_drift() -> None:
    white = replace(
        ERRORS,
        rotation_correlated=(0.0,) * 3,
        direction_correlated=(0.0,) * 3,
        scale_correlated=0.0,
        translation_floor=0.0,
    )
    found = fit_errors([spoilt(white, 6000, 3)])
    share = found.correlated**2 / (found.correlated**2 + found.white**2 / 0.1)
    assert share[ROTATION].max() < 0.08 and share[SCALE] < 0.08


def test_too_few_pairs_are_refused() -> None:
    with pytest.raises(DataError, match="200 valid pairs"):
        fit_errors([spoilt(ERRORS, 50, 0)])
