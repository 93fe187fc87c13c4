"""The equations of the filter's state against numerical derivatives and against the dense forms."""

from dataclasses import replace

import numpy as np
import pytest

from filter_runs import simulated
from vioframe.error_state import THETA
from vioframe.geometry import se3, so3
from vioframe.types import ImuBias, ImuNoise, NavState
from vioframe_msckf.correction import correct_by_information, correct_by_residuals
from vioframe_msckf.state import CLONES, FilterState
from vioframe_preintegration import Preintegration

NOISE = ImuNoise(gyro_noise=1e-3, gyro_walk=1e-4, accel_noise=1e-2, accel_walk=1e-3, rate_hz=200.0)
STEP = 1e-6


def random_pose(rng, spread=1.0):
    return se3.exp(np.concatenate([rng.normal(0, 1, 3), rng.normal(0, spread, 3)]))


def make_state(seed=0, points=4, clones=3):
    """A state with clones and points and a full, random covariance."""
    rng = np.random.default_rng(seed)
    state = FilterState(NOISE, 9.81)
    given = NavState(
        stamp_ns=0,
        T_world_body=random_pose(rng),
        v_world_body=rng.normal(0, 1, 3),
        bias=ImuBias(gyro=rng.normal(0, 0.01, 3), accel=rng.normal(0, 0.1, 3)),
    )
    state.start(given, 1e-4 * np.eye(15), random_pose(rng, 0.1), 1e-4 * np.eye(7))
    for _ in range(clones):
        state.add_clone(0.01, rng.normal(0, 1, 3))
        state.body = replace(state.body, p=state.body.p + rng.normal(0, 0.3, 3))
    ahead = state.p_clones.mean(axis=0) + 4.0 * state.R_clones[-1][:, 2]
    state.add_points(
        np.arange(points),
        ahead + rng.normal(0, 1, (points, 3)),
        np.zeros((points, 3, len(state.covariance))),
        np.broadcast_to(1e-2 * np.eye(3), (points, 3, 3)),
    )
    root = rng.normal(0, 1, state.covariance.shape) * 1e-2
    state.covariance = root @ root.T
    return state


def copy(state):
    twin = FilterState(NOISE, 9.81)
    for name in (
        "body",
        "origin",
        "T_body_cam",
        "delay_s",
        "R_clones",
        "p_clones",
        "points",
        "point_ids",
        "covariance",
    ):
        value = getattr(state, name)
        setattr(twin, name, value.copy() if isinstance(value, np.ndarray) else value)
    return twin


def moved(state, error):
    twin = copy(state)
    twin.apply(error)
    return twin


def pose_error(T_estimate, T_true):
    """ξ of ``T_true = Exp(ξ) T_estimate``."""
    return se3.log(T_true @ se3.inverse(T_estimate))


@pytest.mark.parametrize("later_s", [0.0, 0.02, -0.03])
def test_camera_pose_has_the_jacobian_it_states(later_s):
    state = make_state()
    reading = np.array([0.4, -1.2, 0.7])

    def pose(s):
        return s.camera_pose(later_s + s.delay_s - state.delay_s, reading - s.body.bias.gyro)[0]

    T, J = state.camera_pose(later_s, reading - state.body.bias.gyro)
    for column in range(CLONES):
        error = np.zeros(len(state.covariance))
        error[column] = STEP
        plus, minus = pose(moved(state, error)), pose(moved(state, -error))
        np.testing.assert_allclose((pose_error(T, plus) - pose_error(T, minus)) / (2 * STEP), J[:, column], atol=2e-5)


def test_propagation_moves_the_errors_of_body_and_points_as_the_equations_do():
    # A point stands still, but its error is told beyond the body's turn, which the gyro's error changes.
    recording = simulated("drone", 3.0)
    imu = recording.exact_imu(recording.ground_truth().stamps_ns[400:420])
    pre = Preintegration()
    pre.setup(recording.rig)
    state = make_state()
    state.covariance[:] = 0.0
    delta = pre.integrate(imu, state.body.bias)
    rng = np.random.default_rng(1)
    columns = []
    names = [*range(15), *range(state.point_errors.start, state.point_errors.stop)]
    for column in names:
        ends = []
        for sign in (1.0, -1.0):
            error = np.zeros(len(state.covariance))
            error[column] = sign * STEP
            twin = moved(state, error)
            twin.propagate(delta.at(twin.body.bias))
            ends.append(twin)
        columns.append([*ends])
    base = copy(state)
    base.covariance = np.diag(
        np.where(np.isin(np.arange(len(state.covariance)), names), rng.uniform(0.5, 2, len(state.covariance)), 0.0)
    )
    before = base.covariance.copy()
    silent = replace(delta, covariance=np.zeros((9, 9)))
    base._noise = replace(NOISE, gyro_walk=0.0, accel_walk=0.0)
    base.propagate(silent)

    def difference(a, b):
        from vioframe.error_state import difference as body_difference

        body = body_difference(a.body, b.body)
        turn = so3.exp(body[THETA])
        points = (b.points - a.points @ turn.T) @ so3.left_jacobian_inverse(body[THETA]).T
        return np.concatenate([body, points.reshape(-1)])

    F = np.stack([difference(minus, plus) / (2 * STEP) for plus, minus in columns], axis=1)
    small = before[np.ix_(names, names)]
    np.testing.assert_allclose(base.covariance[np.ix_(names, names)], F @ small @ F.T, rtol=1e-4, atol=1e-4)


def test_new_points_and_clones_are_correlated_as_their_jacobians_say():
    state = make_state(points=0)
    T, J = state.camera_pose(0.01, np.array([0.1, 0.2, 0.3]))
    P = state.covariance[:CLONES, :CLONES].copy()
    state.add_clone(0.01, np.array([0.1, 0.2, 0.3]))
    newest = slice(len(state.covariance) - 6, len(state.covariance))
    np.testing.assert_allclose(state.covariance[newest, newest], J @ P @ J.T, atol=1e-12)
    np.testing.assert_allclose(state.covariance[newest, :CLONES], J @ P, atol=1e-12)
    np.testing.assert_allclose(state.R_clones[-1], T[:3, :3])


def test_moving_the_origin_changes_nothing_that_can_be_seen():
    state, twin = make_state(), make_state()
    twin._move_origin(np.array([30.0, -20.0, 5.0]))
    a, b = state.nav_state(0), twin.nav_state(0)
    np.testing.assert_allclose(a.T_world_body, b.T_world_body, atol=1e-12)
    np.testing.assert_allclose(a.covariance, b.covariance, atol=1e-9)
    # The same error in both leads to the same place.
    by = np.array([30.0, -20.0, 5.0])
    error = np.random.default_rng(3).normal(0, 1e-4, len(state.covariance))
    changed = error.copy()
    crossed = so3.hat(by)
    changed[3:6] -= crossed @ error[THETA]
    points = state.point_errors
    changed[points] -= np.tile(crossed @ error[THETA], len(state.points))
    blocks = changed[state.clone_errors].reshape(-1, 6)
    blocks[:, 3:] -= blocks[:, :3] @ crossed.T
    changed[state.clone_errors] = blocks.reshape(-1)
    one, two = moved(state, error), moved(twin, changed)
    np.testing.assert_allclose(one.body.p, two.body.p + by, atol=1e-6)
    np.testing.assert_allclose(one.points, two.points + by, atol=1e-6)
    np.testing.assert_allclose(one.p_clones, two.p_clones + by, atol=1e-6)


def test_both_forms_of_the_correction_agree_with_josephs():
    rng = np.random.default_rng(4)
    state = make_state()
    columns = state.clone_errors
    H = np.zeros((40, len(state.covariance)))
    H[:, columns] = rng.normal(0, 3, (40, columns.stop - columns.start))
    # No residual changes when all clones move as one.
    H[:, columns.stop - 6 : columns.stop] = -H[:, columns].reshape(40, -1, 6)[:, :-1].sum(axis=1)
    r = rng.normal(0, 1, 40) * 0.01
    P = state.covariance
    S = H @ P @ H.T + np.eye(40)
    K = P @ H.T @ np.linalg.inv(S)
    keep = np.eye(len(P)) - K @ H
    wanted = keep @ P @ keep.T + K @ K.T
    informed, direct = copy(state), copy(state)
    Hc = H[:, columns]
    assert correct_by_information(informed, Hc.T @ Hc, Hc.T @ r)
    assert correct_by_residuals(direct, H @ P, S, r)
    for twin in (informed, direct):
        np.testing.assert_allclose(twin.covariance, wanted, atol=1e-10)
        np.testing.assert_allclose(twin.body.p, moved(state, K @ r).body.p, atol=1e-10)


def test_a_correction_without_a_finite_answer_leaves_the_state():
    state = make_state()
    before = copy(state)
    n = state.clone_errors.stop - state.clone_errors.start
    assert not correct_by_information(state, np.eye(n), np.full(n, np.nan))
    S = -np.eye(2)
    assert not correct_by_residuals(state, np.zeros((2, len(state.covariance))), S, np.zeros(2))
    np.testing.assert_array_equal(state.covariance, before.covariance)
    np.testing.assert_array_equal(state.body.p, before.body.p)
