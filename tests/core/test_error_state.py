"""The filters' inertial core: every Jacobian against finite differences, the covariance against its axioms."""

import numpy as np
import pytest

from vioframe.consistency import StandstillTest, chi_square_limit
from vioframe.conventions import gravity_vector
from vioframe.data.simulator import CameraSettings, SimulatedDataset
from vioframe.error_state import (
    BIAS,
    Body,
    InertialFilter,
    difference,
    invariant_from_local,
    local_from_invariant,
    process_noise,
    propagate,
    retract,
    transition,
)
from vioframe.errors import StateError
from vioframe.geometry import se3, so3
from vioframe.increments import add_gap, coasting, part_of
from vioframe.initialisation import StillnessDetector, initial_covariance
from vioframe.types import Camera, Frame, ImuBias, ImuBlock, ImuNoise, InertialDelta, NavState, SensorRig, SyncedWindow

NOISE = ImuNoise(gyro_noise=2e-4, gyro_walk=2e-5, accel_noise=2e-3, accel_walk=3e-3, rate_hz=200.0)
GRAVITY = gravity_vector(9.81)
STEP = 1e-5


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


def random_body(rng: np.random.Generator) -> Body:
    return Body(
        R=so3.exp(rng.normal(size=3)),
        p=rng.normal(size=3) * 3.0,
        v=rng.normal(size=3),
        bias=ImuBias(gyro=rng.normal(size=3) * 0.01, accel=rng.normal(size=3) * 0.1),
    )


def random_delta(rng: np.random.Generator, bias: ImuBias, duration_s: float = 0.1) -> InertialDelta:
    root = rng.normal(size=(9, 9)) * 1e-3
    return InertialDelta(
        delta_R=so3.exp(rng.normal(size=3) * 0.2),
        delta_v=rng.normal(size=3),
        delta_p=rng.normal(size=3) * 0.05,
        duration_s=duration_s,
        covariance=root @ root.T,
        bias=bias,
        bias_jacobian=rng.normal(size=(9, 6)) * 0.1,
    )


def with_error(delta: InertialDelta, error: np.ndarray) -> InertialDelta:
    return InertialDelta(
        delta_R=delta.delta_R @ so3.exp(error[:3]),
        delta_v=delta.delta_v + error[3:6],
        delta_p=delta.delta_p + error[6:],
        duration_s=delta.duration_s,
        covariance=delta.covariance,
        bias=delta.bias,
        bias_jacobian=delta.bias_jacobian,
    )


def derivative(function, size: int) -> np.ndarray:
    """Central differences of a vector function at zero."""
    columns = []
    for axis in np.eye(size):
        columns.append((function(STEP * axis) - function(-STEP * axis)) / (2.0 * STEP))
    return np.stack(columns, axis=1)


def test_difference_inverts_retract(rng):
    body, error = random_body(rng), rng.normal(size=15) * 0.3
    np.testing.assert_allclose(difference(body, retract(body, error)), error, atol=1e-12)


def test_transition_against_finite_differences(rng):
    body = random_body(rng)
    delta = random_delta(rng, body.bias)
    after = propagate(body, delta, GRAVITY)
    phi, noise_map = transition(body, after, delta, GRAVITY)

    def moved(error):
        truth = retract(body, error)
        return difference(after, propagate(truth, delta.at(truth.bias), GRAVITY))

    np.testing.assert_allclose(phi, derivative(moved, 15), atol=1e-6)
    np.testing.assert_allclose(
        noise_map, derivative(lambda e: difference(after, propagate(body, with_error(delta, e), GRAVITY)), 9), atol=1e-6
    )


def test_transition_of_motion_does_not_depend_on_the_state(rng):
    first, second = random_body(rng), random_body(rng)
    delta = random_delta(rng, first.bias)
    phis = [transition(b, propagate(b, delta, GRAVITY), delta, GRAVITY)[0][:9, :9] for b in (first, second)]
    np.testing.assert_allclose(phis[0], phis[1], atol=1e-14)


def test_yaw_and_position_pass_a_window_unchanged(rng):
    body = random_body(rng)
    delta = random_delta(rng, body.bias)
    phi, _ = transition(body, propagate(body, delta, GRAVITY), delta, GRAVITY)
    gauge = np.zeros((15, 4))
    gauge[2, 0] = 1.0
    gauge[3:6, 1:] = np.eye(3)
    np.testing.assert_allclose(phi @ gauge, gauge, atol=1e-14)


def test_conversion_of_errors_against_finite_differences(rng):
    body = random_body(rng)

    def local(error):
        truth = retract(body, error)
        return np.concatenate(
            [
                so3.log(body.R.T @ truth.R),
                truth.p - body.p,
                truth.v - body.v,
                truth.bias.gyro - body.bias.gyro,
                truth.bias.accel - body.bias.accel,
            ]
        )

    np.testing.assert_allclose(local_from_invariant(body), derivative(local, 15), atol=1e-6)
    np.testing.assert_allclose(local_from_invariant(body) @ invariant_from_local(body), np.eye(15), atol=1e-12)


def test_process_noise_is_positive_and_holds_the_bias_walk(rng):
    body = random_body(rng)
    delta = random_delta(rng, body.bias)
    _, noise_map = transition(body, propagate(body, delta, GRAVITY), delta, GRAVITY)
    noise = process_noise(noise_map, delta, NOISE)
    assert np.linalg.eigvalsh(noise).min() > -1e-18
    np.testing.assert_allclose(np.diag(noise[BIAS, BIAS])[:3], NOISE.gyro_walk**2 * delta.duration_s)


def test_bias_walk_moves_the_state_as_simulated(rng):
    """A gyro bias that walks inside a long window: simulated turn against the stated covariance."""
    duration, steps = 2.0, 400
    noise = ImuNoise(gyro_noise=0.0, gyro_walk=0.1, accel_noise=0.0, accel_walk=0.0, rate_hz=200.0)
    jacobian = np.zeros((9, 6))
    jacobian[:3, :3] = -duration * np.eye(3)
    delta = InertialDelta(
        delta_R=np.eye(3),
        delta_v=np.zeros(3),
        delta_p=np.zeros(3),
        duration_s=duration,
        covariance=np.zeros((9, 9)),
        bias=ImuBias(),
        bias_jacobian=jacobian,
    )
    noise_map = np.zeros((15, 9))
    noise_map[:3, :3] = np.eye(3)
    stated = process_noise(noise_map, delta, noise)[np.ix_([0, 9], [0, 9])]
    walk = np.cumsum(rng.normal(size=(20_000, steps)) * 0.1 * np.sqrt(duration / steps), axis=1)
    sampled = np.cov(np.stack([-walk.mean(axis=1) * duration, walk[:, -1]]))
    np.testing.assert_allclose(stated, sampled, rtol=0.05)


def walk_delta() -> InertialDelta:
    """One window of a simulated walk, with its path."""
    from vioframe_preintegration import Preintegration

    dataset = SimulatedDataset(sequence="walk", duration_s=4.0, camera=CameraSettings(images=False))
    recording = dataset.open(dataset.sequences[0])
    stamps = recording.frame_stamps_ns[60] + np.arange(41) * 5_000_000
    integrator = Preintegration()
    integrator.setup(recording.rig)
    return integrator.integrate(recording.exact_imu(stamps), ImuBias())


def test_parts_of_a_window_make_the_window():
    delta = walk_delta()
    whole = random_body(np.random.default_rng(1))
    cut = 0.0873
    first, second = part_of(delta, 0.0, cut), part_of(delta, cut, delta.duration_s)
    halfway = propagate(whole, first, GRAVITY)
    joined, direct = propagate(halfway, second, GRAVITY), propagate(whole, delta, GRAVITY)
    np.testing.assert_allclose(difference(joined, direct), np.zeros(15), atol=1e-12)
    assert part_of(delta, 0.0, delta.duration_s) is delta


def test_parts_of_a_window_have_its_jacobians_and_noise():
    delta = walk_delta()
    body = Body(R=np.eye(3), p=np.zeros(3), v=np.zeros(3), bias=ImuBias())
    halfway = propagate(body, part_of(delta, 0.0, 0.1), GRAVITY)
    after = propagate(body, delta, GRAVITY)
    pieces = [
        transition(body, halfway, part_of(delta, 0.0, 0.1), GRAVITY),
        transition(halfway, after, part_of(delta, 0.1, 0.2), GRAVITY),
    ]
    phi, noise_map = transition(body, after, delta, GRAVITY)
    # The rule of powers of time holds for slow rotation; the walk turns by some degrees in 0.2 s.
    np.testing.assert_allclose(pieces[1][0] @ pieces[0][0], phi, atol=0.02)
    whole = noise_map @ delta.covariance @ noise_map.T
    noises = [
        m @ part.covariance @ m.T
        for (_, m), part in zip(pieces, (part_of(delta, 0.0, 0.1), part_of(delta, 0.1, 0.2)), strict=True)
    ]
    joined = pieces[1][0] @ noises[0] @ pieces[1][0].T + noises[1]
    np.testing.assert_allclose(np.diag(joined)[:9], np.diag(whole)[:9], rtol=0.1)


def test_part_without_a_path_takes_constant_motion(rng):
    body = random_body(rng)
    delta = random_delta(rng, body.bias)
    halves = part_of(delta, 0.0, 0.05), part_of(delta, 0.05, 0.1)
    joined = propagate(propagate(body, halves[0], GRAVITY), halves[1], GRAVITY)
    np.testing.assert_allclose(difference(joined, propagate(body, delta, GRAVITY)), np.zeros(15), atol=1e-12)


def test_gap_adds_what_an_unknown_constant_motion_does(rng):
    delta = random_delta(rng, ImuBias(), duration_s=1.0)
    added = add_gap(delta, 0.5, rate_sigma=0.2, accel_sigma=3.0).covariance - delta.covariance
    assert np.linalg.eigvalsh(added).min() > -1e-12
    np.testing.assert_allclose(np.sqrt(np.diag(added))[:6], [0.1] * 3 + [1.5] * 3)


def test_coasting_keeps_velocity_and_attitude(rng):
    body = random_body(rng)
    after = propagate(body, coasting(body, 2.0, GRAVITY, 0.1, 1.0), GRAVITY)
    np.testing.assert_allclose(after.v, body.v, atol=1e-12)
    np.testing.assert_allclose(after.p, body.p + 2.0 * body.v, atol=1e-12)
    np.testing.assert_allclose(after.R, body.R)


def started(rng) -> InertialFilter:
    body = random_body(rng)
    filter_ = InertialFilter(extra=2, noise=NOISE, gravity=9.81)
    state = NavState(stamp_ns=0, T_world_body=body.T_world_body, v_world_body=body.v, bias=body.bias)
    filter_.start(state, initial_covariance(body.R))
    return filter_


def test_start_gives_the_covariance_back(rng):
    filter_ = started(rng)
    given = initial_covariance(filter_.body.R)
    np.testing.assert_allclose(filter_.nav_state(0, "tracking").covariance, given, atol=1e-12)


def test_clone_is_the_pose_itself(rng):
    filter_ = started(rng)
    filter_.clone_pose()
    P = filter_.covariance
    np.testing.assert_array_equal(P[-6:, -6:], P[:6, :6])
    np.testing.assert_array_equal(P[-6:, :15], P[:6, :15])
    filter_.drop_clone()
    assert filter_.covariance.shape == (17, 17)


def test_covariance_stays_symmetric_and_positive(rng):
    filter_ = started(rng)
    for _ in range(200):
        filter_.clone_pose()
        filter_.propagate(random_delta(rng, filter_.body.bias))
        H, residual, noise = filter_.standstill_measurement(1e-3, 1e-3, 1e-2)
        filter_.correct(H, 1e-3 * residual, noise)
        filter_.drop_clone()
        state = filter_.nav_state(0, "tracking")
        np.testing.assert_array_equal(state.covariance, state.covariance.T)
        scale = np.sqrt(np.diag(state.covariance))
        assert np.linalg.eigvalsh(state.covariance / np.outer(scale, scale)).min() > 0.0


def test_update_equals_the_batch_solution(rng):
    """Two linear updates are one least-squares problem."""
    filter_ = started(rng)
    prior = filter_.covariance[:15, :15]
    body = filter_.body
    H = np.zeros((4, 17))
    H[:, :15] = rng.normal(size=(4, 15))
    noise = np.diag([0.1, 0.2, 0.3, 0.4])
    for rows in (slice(0, 2), slice(2, 4)):
        filter_.correct(H[rows], np.zeros(2), noise[rows, rows])
    # Corrections of zero leave the linearisation alone, so the covariances must agree.
    information = np.linalg.inv(prior) + H[:, :15].T @ np.linalg.inv(noise) @ H[:, :15]
    np.testing.assert_allclose(filter_.covariance[:15, :15], np.linalg.inv(information), atol=1e-10)
    np.testing.assert_allclose(difference(body, filter_.body), np.zeros(15), atol=1e-15)


def test_standstill_jacobian_against_finite_differences(rng):
    filter_ = started(rng)
    filter_.clone_pose()
    # Evaluated where the measurement is fulfilled but for a velocity, as in use.
    H, _, _ = filter_.standstill_measurement(1.0, 1.0, 1.0)
    body, T_clone = filter_.body, filter_.T_world_clone

    def expected(error):
        truth = retract(body, error[:15])
        T_true_clone = se3.exp(error[15:]) @ T_clone
        return np.concatenate([se3.log(se3.inverse(T_true_clone) @ truth.T_world_body), truth.v])

    numerical = derivative(expected, 21)
    np.testing.assert_allclose(np.delete(H, [15, 16], axis=1), numerical, atol=1e-6)


def test_standstill_without_a_clone_is_refused(rng):
    with pytest.raises(StateError, match="clone_pose"):
        started(rng).standstill_measurement(1.0, 1.0, 1.0)


def test_doubt_widens_tilt_and_velocity_only(rng):
    filter_ = started(rng)
    before = filter_.nav_state(0, "tracking").covariance
    filter_.doubt(0.1, 2.0)
    added = filter_.nav_state(0, "tracking").covariance - before
    R = filter_.body.R
    np.testing.assert_allclose(R @ added[:3, :3] @ R.T, np.diag([0.01, 0.01, 0.0]), atol=1e-12)
    np.testing.assert_allclose(added[6:9, 6:9], 4.0 * np.eye(3), atol=1e-12)
    np.testing.assert_allclose(added[3:6, 3:6], 0.0, atol=1e-12)


def test_chi_square_limit_against_the_table():
    # Abramowitz & Stegun, table 26.8.
    assert chi_square_limit(0.95, 6) == pytest.approx(12.592, abs=1e-3)
    assert chi_square_limit(0.999, 3) == pytest.approx(16.266, abs=1e-3)


def still_window(index: int, gyro: np.ndarray) -> SyncedWindow:
    stamps = np.arange(0, 100_000_001, 5_000_000, dtype=np.int64) + index * 100_000_000
    imu = ImuBlock(
        stamps_ns=stamps, gyro=np.tile(gyro, (len(stamps), 1)), accel=np.tile([0.0, 0.0, 9.81], (len(stamps), 1))
    )
    return SyncedWindow(
        previous=Frame(stamp_ns=int(stamps[0])), current=Frame(stamp_ns=int(stamps[-1])), imu=imu, gap_ns=5_000_000
    )


@pytest.mark.parametrize(
    ("gyro", "speed", "rest"), [(0.0, 0.0, True), (0.0, 0.5, False), (0.05, 0.0, False)], ids=["rest", "coast", "turn"]
)
def test_standstill_needs_still_samples_and_no_speed(gyro, speed, rest):
    camera = Camera(model="pinhole", intrinsics_px=np.array([1.0, 1.0, 0.0, 0.0]), size_px=(2, 2), T_body_cam=np.eye(4))
    rig = SensorRig(cameras=(camera,), imu=NOISE)
    test = StandstillTest(StillnessDetector(rig, duration_s=0.5), gyro_limit=0.02, speed_limit=0.1)
    body = Body(R=np.eye(3), p=np.zeros(3), v=np.array([speed, 0.0, 0.0]), bias=ImuBias())
    answers = [test.push(still_window(i, np.array([0.0, 0.0, gyro])), body) for i in range(8)]
    assert answers[-1] is rest
    assert not any(answers[:4])
