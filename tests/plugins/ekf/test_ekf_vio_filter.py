"""The robocentric filter on tensors: its maps are derivatives, and gradients pass through all its steps."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs torch: pip install 'vioframe[learn]'")

import torch

from vioframe.geometry import so3
from vioframe.inertial import white_sigma
from vioframe.types import ImuBias, ImuBlock, ImuNoise, SensorRig
from vioframe_ekf.net.increments import gap_covariance, increment_covariance, preintegrate
from vioframe_ekf.net.noise import FilterNoise
from vioframe_ekf.net.path import StartSigmas, from_nav_errors, given_state, misplaced, to_nav_errors
from vioframe_ekf.net.robocentric import (
    AT_IMAGE,
    BIAS,
    GRAVITY,
    IN_WINDOW,
    SHIFT,
    TURN,
    VELOCITY,
    Increment,
    Moved,
    State,
    apply,
    correct,
    innovate,
    motion_noise,
    motion_residual,
    motion_rows,
    passing,
    propagate,
    settle,
    turn,
    turn_between,
)
from vioframe_preintegration import Preintegration

SIGMAS = StartSigmas(
    tilt=0.01, yaw=0.02, position=0.1, velocity=0.2, gravity=0.05, biases=torch.tensor([0.01, 0.1]).double()
)


@pytest.fixture
def random():
    return torch.Generator().manual_seed(5)


def normal(random, *shape):
    return torch.randn(*shape, generator=random, dtype=torch.float64)


def some_state(random, B=1) -> State:
    state = given_state(3.0 * normal(random, B, 3), 9.81 * torch.nn.functional.normalize(normal(random, B, 3)), SIGMAS)
    return replace(state, p=5.0 * normal(random, B, 3), bias=0.05 * normal(random, B, 6))


def some_increment(random, B=1, S=None) -> Increment:
    lead = (B,) if S is None else (B, S)
    samples = preintegrate(
        torch.cat([normal(random, *lead, 11, 3), 5.0 * normal(random, *lead, 11, 3)], dim=-1),
        torch.linspace(0.0, 0.1, 11).expand(*lead, 11),
        torch.ones(*lead, 11, dtype=torch.bool),
    )
    T = torch.full(lead, 0.1, dtype=torch.float64)
    covariance = increment_covariance(samples.R, samples.v, T, torch.tensor([1e-3, 1e-2], dtype=torch.float64))
    transition, noise = passing(T, samples.jacobian, covariance, torch.full((6,), 1e-6, dtype=torch.float64))
    return Increment(
        R=samples.R,
        v=samples.v,
        p=samples.p,
        duration_s=T,
        jacobian=samples.jacobian,
        reference=torch.zeros(*lead, 6, dtype=torch.float64),
        transition=transition,
        noise=noise,
    )


def disturbed(state: State, error: torch.Tensor) -> State:
    """The truth that differs by an error (B, 18) from a state."""
    turned = turn(error[:, :3])
    return replace(
        state,
        R=turned @ state.R,
        p=apply(turned, state.p) + error[:, 3:6],
        gravity=state.gravity + error[:, GRAVITY],
        v=state.v + error[:, VELOCITY],
        bias=state.bias + error[:, BIAS],
    )


def error_between(estimate: State, truth: State) -> torch.Tensor:
    turned = truth.R @ estimate.R.mT
    return torch.cat(
        [
            turn_between(turned),
            truth.p - apply(turned, estimate.p),
            truth.gravity - estimate.gravity,
            truth.v - estimate.v,
            truth.bias - estimate.bias,
        ],
        dim=-1,
    )


def derivative(function, size: int) -> torch.Tensor:
    """Of a function of errors (1, size), by central differences."""
    columns = []
    for axis in range(size):
        step = torch.zeros(1, size, dtype=torch.float64)
        step[0, axis] = 1e-5
        columns.append((function(step) - function(-step)) / 2e-5)
    return torch.stack(columns, dim=-1)[0]


def test_small_turns_are_rotations_and_invert(random):
    vector = 0.8 * normal(random, 20, 3)
    R = turn(vector)
    assert torch.allclose(R @ R.mT, torch.eye(3, dtype=torch.float64), atol=1e-14)
    assert torch.allclose(turn_between(R), vector, atol=1e-13)
    small = 1e-3 * vector
    np.testing.assert_allclose(turn(small).numpy(), so3.exp(small.numpy()), atol=2e-9)


def test_errors_pass_through_a_window_as_stated(random):
    state, increment = some_state(random), some_increment(random)
    expected = propagate(state, increment)

    def moved(error):
        truth = propagate(disturbed(state, error), increment)
        around = error_between(expected.before, truth.before)
        inside = torch.cat([turn_between(expected.R.mT @ truth.R), truth.r - expected.r], dim=-1)
        return torch.cat([around[:, :9], truth.v - expected.v, around[:, 12:], inside], dim=-1)

    # The bias is brought in to first order, about the one that was subtracted.
    assert torch.allclose(derivative(moved, AT_IMAGE), increment.transition[0], atol=3e-4)


def test_errors_are_settled_as_stated(random):
    state, increment = some_state(random), some_increment(random)
    moved = propagate(state, increment)
    after = settle(moved)

    def settled(error):
        truth = Moved(
            before=disturbed(moved.before, error[:, :AT_IMAGE]),
            R=moved.R @ turn(error[:, TURN]),
            r=moved.r + error[:, SHIFT],
            v=moved.v + error[:, VELOCITY],
            covariance=moved.covariance,
        )
        return error_between(after, settle(truth))

    into = derivative(settled, IN_WINDOW)
    assert torch.allclose(into @ moved.covariance[0] @ into.T, after.covariance[0], rtol=1e-6, atol=1e-9)


def test_motion_of_the_camera_becomes_that_of_the_body_with_its_noise(random):
    """A noise in the tangent of the camera is seen in the residual as stated."""
    state, increment = some_state(random), some_increment(random)
    moved = propagate(state, increment)
    T_body_cam = torch.eye(4, dtype=torch.float64)
    T_body_cam[:3, :3], T_body_cam[:3, 3] = turn(normal(random, 3)), normal(random, 3)
    true_motion = torch.eye(4, dtype=torch.float64).repeat(1, 1, 1)
    true_motion[:, :3, :3], true_motion[:, :3, 3] = moved.R, moved.r
    T_prev_cur = torch.linalg.inv(T_body_cam) @ true_motion @ T_body_cam
    square = normal(random, 6, 6)
    _, noise = motion_noise(T_prev_cur, T_body_cam, (square @ square.T)[None])

    def seen(error):
        spoilt = torch.eye(4, dtype=torch.float64).repeat(1, 1, 1)
        spoilt[:, :3, :3], spoilt[:, :3, 3] = turn(error[:, :3]), error[:, 3:]
        return motion_residual(moved, motion_noise(T_prev_cur @ spoilt, T_body_cam, (square @ square.T)[None])[0])

    into = derivative(seen, 6)
    assert torch.allclose(into @ square @ square.T @ into.T, noise[0], rtol=1e-6)


def test_correction_is_josephs_form(random):
    state, increment = some_state(random), some_increment(random)
    moved = propagate(state, increment)
    H = motion_rows(state.R)
    residual, noise = 0.01 * normal(random, 1, 6), 1e-4 * torch.eye(6, dtype=torch.float64)[None]
    after = correct(moved, innovate(moved, H, residual, noise), torch.tensor([True]))
    P = moved.covariance[0]
    gain = P @ H.T @ torch.linalg.inv(H @ P @ H.T + noise[0])
    keep = torch.eye(IN_WINDOW, dtype=torch.float64) - gain @ H
    assert torch.allclose(after.covariance[0], keep @ P @ keep.T + gain @ noise[0] @ gain.T, atol=1e-12)
    assert torch.allclose(after.r[0] - moved.r[0], (gain @ residual[0])[SHIFT])


def test_a_covariance_that_is_none_spoils_only_its_own_window(random):
    state, increment = some_state(random, 2), some_increment(random, 2)
    moved = propagate(state, increment)
    noise = torch.stack([-10.0 * torch.eye(6), 1e-2 * torch.eye(6)]).double().requires_grad_()
    innovation = innovate(moved, motion_rows(state.R), 0.01 * normal(random, 2, 6), noise)
    assert innovation.sound.tolist() == [False, True]
    settle(correct(moved, innovation, innovation.sound)).p.sum().backward()
    assert noise.grad.isfinite().all() and noise.grad[1].abs().max() > 0.0


def test_heading_and_place_are_never_learned(random):
    """Whatever motions are measured, the pose at the first image stays as uncertain about the vertical as it was."""
    state = some_state(random)
    up = torch.zeros(1, 6, dtype=torch.float64)
    up[:, 2] = 1.0
    before = apply(state.covariance[:, :6, :6], up)[0, 2]
    for _ in range(20):
        moved = propagate(state, some_increment(random))
        noise = 1e-6 * torch.eye(6, dtype=torch.float64)[None]
        innovation = innovate(moved, motion_rows(state.R), torch.zeros(1, 6, dtype=torch.float64), noise)
        state = settle(correct(moved, innovation, innovation.sound))
    assert state.covariance[0, 2, 2] > 0.999 * before


def test_preintegration_agrees_with_the_integrator(random):
    rng = np.random.default_rng(0)
    stamps_ns = np.cumsum(rng.integers(4_000_000, 12_000_000, size=14))
    block = ImuBlock(stamps_ns=stamps_ns, gyro=rng.normal(size=(14, 3)), accel=9.0 * rng.normal(size=(14, 3)))
    noise = ImuNoise(gyro_noise=1e-3, gyro_walk=0.0, accel_noise=1e-2, accel_walk=0.0, rate_hz=100.0)
    integrator = Preintegration()
    integrator.setup(SensorRig(cameras=(), imu=noise))
    wanted = integrator.integrate(block, ImuBias())
    imu, times = np.zeros((2, 20, 6)), np.zeros((2, 20))
    imu[0, :14], times[0, :14] = np.concatenate([block.gyro, block.accel], axis=1), (stamps_ns - stamps_ns[0]) * 1e-9
    mask = torch.arange(20).expand(2, 20) < torch.tensor([[14], [0]])
    got = preintegrate(torch.from_numpy(imu), torch.from_numpy(times), mask)
    for name in ("R", "v", "p"):
        np.testing.assert_allclose(getattr(got, name)[0].numpy(), getattr(wanted, f"delta_{name}"), atol=1e-12)
    np.testing.assert_allclose(got.jacobian[0].numpy(), wanted.bias_jacobian, atol=1e-12)
    assert got.there.tolist() == [True, False]
    assert torch.equal(got.R[1], torch.eye(3, dtype=torch.float64)) and got.v[1].abs().max() == 0.0


def test_covariance_in_closed_form_is_that_of_samples(random):
    """Constant force, no turn: the integrator's covariance is a sum over samples, this one its limit."""
    stamps_ns = np.arange(0, 200_000_001, 500_000)
    count = len(stamps_ns)
    block = ImuBlock(stamps_ns=stamps_ns, gyro=np.zeros((count, 3)), accel=np.tile([3.0, -2.0, 9.0], (count, 1)))
    noise = ImuNoise(gyro_noise=1e-2, gyro_walk=0.0, accel_noise=1e-2, accel_walk=0.0, rate_hz=2000.0)
    integrator = Preintegration()
    integrator.setup(SensorRig(cameras=(), imu=noise))
    delta = integrator.integrate(block, ImuBias())
    closed = increment_covariance(
        torch.from_numpy(delta.delta_R),
        torch.from_numpy(delta.delta_v),
        torch.tensor(delta.duration_s, dtype=torch.float64),
        torch.tensor([1e-2, 1e-2], dtype=torch.float64),
    )
    scale = np.sqrt(np.outer(np.diag(delta.covariance), np.diag(delta.covariance)))
    np.testing.assert_allclose(closed.numpy() / scale, delta.covariance / scale, atol=0.01)
    assert white_sigma(1e-2, 0.2) == pytest.approx(closed[0, 0].sqrt().item() / 0.2)


def test_holes_widen_as_in_the_core():
    from vioframe.increments import add_gap
    from vioframe.types import InertialDelta

    delta = InertialDelta(
        delta_R=np.eye(3),
        delta_v=np.zeros(3),
        delta_p=np.zeros(3),
        duration_s=0.1,
        covariance=np.zeros((9, 9)),
        bias=ImuBias(),
        bias_jacobian=np.zeros((9, 6)),
    )
    wanted = add_gap(delta, 0.07, 0.5, 2.0).covariance
    gap, duration = torch.tensor([0.07, 0.0]).double(), torch.tensor([0.1, 0.1]).double()
    got = gap_covariance(gap, duration, 0.5, 2.0)
    np.testing.assert_allclose(got[0].numpy(), wanted, rtol=1e-6)
    assert got[1].abs().max() == 0.0


def test_a_draw_is_an_error_of_the_covariance_it_came_from(random):
    state = some_state(random, 2000)
    one = State(**{name: getattr(state, name)[:1].expand_as(getattr(state, name)) for name in State.__slots__})
    error = error_between(misplaced(one, normal(random, 2000, 12)), one)[:, :12]
    stated = one.covariance[0, :12, :12]
    spread = stated.diagonal().sqrt()
    assert torch.allclose(error.std(0), spread, rtol=0.1)
    assert torch.allclose(error.T.cov() / spread.outer(spread), stated / spread.outer(spread), atol=0.1)


def test_errors_of_a_state_come_back(random):
    state = some_state(random)
    there = from_nav_errors(state.R, state.p, state.v, state.gravity)
    back = to_nav_errors(state.R, state.p, state.v)
    assert torch.allclose(back @ there, torch.eye(15, dtype=torch.float64), atol=1e-12)


def test_gradients_pass_through_the_filter(random):
    """Against central differences: of motions, of their variances, and of the learned factors, over several windows."""
    state, increment = some_state(random), some_increment(random, 1, 5)
    expected, motions = state, []
    for k in range(5):
        moved = propagate(expected, replace_at(increment, k))
        motion = torch.eye(4, dtype=torch.float64).repeat(1, 1, 1)
        motion[:, :3, :3] = moved.R @ turn(0.02 * normal(random, 1, 3))
        motion[:, :3, 3] = moved.r + 0.02 * normal(random, 1, 3)
        motions.append(motion)
        expected = settle(moved)
    net = FilterNoise(densities=(1e-3, 1e-2, 1e-5, 1e-3), bias_sigmas=(0.01, 0.1))

    def end(vector, log_variances, visual, inertial):
        densities, factors = densities_of(inertial), net.factors(visual)
        reached = state
        for k, motion in enumerate(motions):
            here = replace_at(increment, k)
            covariance = increment_covariance(here.R, here.v, here.duration_s, densities[:2])
            move, added = passing(
                here.duration_s, here.jacobian, covariance, densities[2:].square().repeat_interleave(3)
            )
            spoilt = torch.eye(4, dtype=torch.float64).repeat(1, 1, 1)
            spoilt = torch.cat(
                [
                    torch.cat([turn(vector[k, :3])[None], vector[k, None, 3:, None]], dim=-1),
                    spoilt[:, 3:],
                ],
                dim=-2,
            )
            scaled = (log_variances[k].exp() * factors.square()).diag_embed()[None]
            measured, noise = motion_noise(motion @ spoilt, torch.eye(4, dtype=torch.float64), scaled)
            moved = propagate(reached, replace(here, transition=move, noise=added))
            innovation = innovate(moved, motion_rows(move), motion_residual(moved, measured), noise)
            reached = settle(correct(moved, innovation, innovation.sound))
        return torch.cat([reached.p[0], reached.R.flatten(), reached.v[0], reached.covariance.diagonal()[0].log()])

    def densities_of(inertial):
        return net.densities() * net.factors(inertial)

    given = (0.01 * normal(random, 5, 6), -8.0 + normal(random, 5, 6), 0.3 * normal(random, 6), 0.3 * normal(random, 4))
    assert torch.autograd.gradcheck(
        end, [each.requires_grad_() for each in given], eps=1e-6, atol=1e-6, rtol=1e-4, nondet_tol=0.0
    )


def replace_at(increment: Increment, k: int) -> Increment:
    return Increment(**{name: getattr(increment, name)[:, k] for name in Increment.__slots__})
