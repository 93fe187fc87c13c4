"""Factors of the window against geometry and integration that know nothing of gtsam."""

import gtsam
import numpy as np
import pytest

from inertial_truth import NOISE, even_stamps, exact_increment, make_rig, samples, window_of
from vioframe.geometry import se3, so3
from vioframe.initialisation import initial_covariance
from vioframe.tight.options import InertialTrust
from vioframe.types import ImuBias, NavState
from vioframe_preintegration import Preintegration
from vioframe_window import factors
from vioframe_window.factors import start_prior, tie_error
from vioframe_window.samples import SampleIntegrator

GRAVITY = 9.81


def place(seed):
    rng = np.random.default_rng(seed)
    T_world_body, T_body_cam = se3.exp(rng.normal(size=6)), se3.exp(0.5 * rng.normal(size=6))
    velocity, rate, shift = rng.normal(size=3), rng.normal(size=3), 0.01
    turned = T_world_body[:3, :3] @ so3.exp(rate * shift)
    there = se3.from_parts(
        turned @ T_body_cam[:3, :3], T_world_body[:3, 3] + velocity * shift + turned @ T_body_cam[:3, 3]
    )
    return T_world_body, there, T_body_cam, velocity, rate, shift


def test_a_camera_where_it_belongs_has_no_tie_error():
    T_world_body, T_world_cam, T_body_cam, velocity, rate, shift = place(0)
    error, _ = tie_error(T_world_body, T_world_cam, T_body_cam, velocity, rate, shift, so3.exp(rate * shift))
    np.testing.assert_allclose(error, 0.0, atol=1e-14)


@pytest.mark.parametrize("which", range(5))
def test_derivatives_of_the_tie(which):
    T_world_body, T_world_cam, T_body_cam, velocity, rate, shift = place(1)
    T_world_cam = T_world_cam @ se3.exp(np.array([1e-3, -2e-3, 1e-3, 0.01, 0.02, -0.01]))

    def error(step):
        at = [T_world_body, T_world_cam, T_body_cam, velocity, shift]
        if which < 3:
            at[which] = at[which] @ se3.exp(step)
        else:
            at[which] = at[which] + (step if which == 3 else step[0])
        turn = so3.exp(rate * at[4])
        return tie_error(at[0], at[1], at[2], at[3], rate, at[4], turn)

    derivative = error(np.zeros((6, 6, 6, 3, 1)[which]))[1][which]
    size, step = derivative.shape[1], 1e-6
    numerical = [(error(step * axis)[0] - error(-step * axis)[0]) / (2 * step) for axis in np.eye(size)]
    np.testing.assert_allclose(derivative, np.array(numerical).T, atol=2e-5)


def test_start_prior_is_the_information_of_its_covariance():
    rng = np.random.default_rng(3)
    R = so3.exp(rng.normal(size=3))
    root = 0.05 * rng.normal(size=(15, 15))
    covariance = initial_covariance(R, position_sigma=0.1, tilt_sigma=0.1, yaw_sigma=0.1) + root @ root.T
    state = NavState(stamp_ns=0, T_world_body=se3.from_parts(R, rng.normal(size=3)), v_world_body=rng.normal(size=3))
    error = np.linalg.cholesky(covariance) @ rng.normal(size=15) * 0.01
    values = gtsam.Values()
    T = state.T_world_body.copy()
    T[:3, :3] = T[:3, :3] @ so3.exp(error[:3])
    T[:3, 3] += error[3:6]
    values.insert(factors.body_key(4), gtsam.Pose3(T))
    values.insert(factors.velocity_key(4), state.v_world_body + error[6:9])
    values.insert(factors.bias_key(4), gtsam.imuBias.ConstantBias(error[12:], error[9:12]))
    distance = 2.0 * start_prior(4, state, covariance).error(values)
    assert distance == pytest.approx(error @ np.linalg.solve(covariance, error), rel=0.02)


def collected(imu, bias):
    integrator = SampleIntegrator(NOISE, GRAVITY, InertialTrust())
    integrator.begin(bias)
    integrator.push(window_of(imu), NOISE)
    return integrator.take()


def test_increment_between_keyframes_is_exact_beside_the_sensors_noise():
    for start in np.arange(0.0, 2.0, 0.2):
        truth = exact_increment(start, start + 0.2)
        increment = collected(samples(even_stamps(start, start + 0.2, 40)), ImuBias())
        sigmas = np.sqrt(np.diag(increment.preintMeasCov()))
        assert np.abs(so3.log(increment.deltaRij().matrix().T @ truth[0])).max() < 0.2 * sigmas[:3].min()
        assert np.abs(increment.deltaPij() - truth[2]).max() < 0.2 * sigmas[3:6].min()
        assert np.abs(increment.deltaVij() - truth[1]).max() < 0.2 * sigmas[6:9].min()


def test_increment_and_its_covariance_are_those_of_our_integrator():
    imu = samples(even_stamps(0.3, 0.5, 40))
    bias = ImuBias(gyro=np.array([0.02, -0.01, 0.03]), accel=np.array([0.1, 0.2, -0.1]))
    ours = Preintegration()
    ours.setup(make_rig(NOISE))
    delta, theirs = ours.integrate(imu, bias), collected(imu, bias)
    np.testing.assert_allclose(theirs.deltaRij().matrix(), delta.delta_R, atol=1e-6)
    np.testing.assert_allclose(theirs.deltaVij(), delta.delta_v, atol=1e-5)
    np.testing.assert_allclose(theirs.deltaPij(), delta.delta_p, atol=1e-5)
    # gtsam: order (θ, p, v), and the walk of the biases and its own discretisation on top.
    order = np.r_[0:3, 6:9, 3:6]
    covariance = theirs.preintMeasCov()[:9, :9][np.ix_(order, order)]
    sigmas = np.sqrt(np.diag(delta.covariance))
    np.testing.assert_allclose(np.sqrt(np.diag(covariance))[:6], sigmas[:6], rtol=0.05)


def test_a_hole_between_samples_widens_the_increment():
    imu = samples(np.concatenate([even_stamps(0.0, 0.1, 20), even_stamps(0.3, 0.4, 20)]))
    trust = InertialTrust()
    integrator = SampleIntegrator(NOISE, GRAVITY, trust)
    integrator.begin(ImuBias())
    integrator.push(window_of(imu, gap_ns=200_000_000), NOISE)
    sigmas = np.sqrt(np.diag(integrator.take().preintMeasCov()))
    np.testing.assert_allclose(sigmas[:3], trust.gap_rate_sigma * 0.2, rtol=0.1)
    assert (sigmas[6:9] > 0.7 * trust.gap_accel_sigma * 0.2).all()
    integrator.begin(ImuBias())
    integrator.push(window_of(samples(even_stamps(0.4, 0.5, 20))), NOISE)
    assert np.sqrt(np.diag(integrator.take().preintMeasCov()))[:3].max() < 1e-3
