"""The bundle adjustment of a start: Jacobians against differences, and what it recovers."""

from dataclasses import replace

import numpy as np
import pytest

from moving_scene import GRAVITY, Scene, rig
from vioframe.geometry import so3
from vioframe.tight import start_bundle
from vioframe.tight.inertial_window import InertialWindow
from vioframe.tight.start_bundle import BundlePriors, Sightings, WindowState, refine
from vioframe.types import ImuBias

PRIORS = BundlePriors(gravity=GRAVITY, gyro_bias_sigma=0.05, accel_bias_sigma=0.2, delay_sigma_s=0.01)
TIMES = np.arange(0.0, 1.6, 0.2)


def problem(cameras=1):
    """The true state of a window, what is seen of 30 points, and the increments."""
    scene = Scene(noise=False)
    R, p = scene.pose(TIMES)
    rng = np.random.default_rng(0)
    T_body_cams = [camera.T_body_cam for camera in rig(cameras).cameras]
    T = np.array(T_body_cams)[:, None].repeat(len(TIMES), axis=1).reshape(-1, 4, 4)
    instant = np.tile(np.arange(len(TIMES)), cameras)
    R_cam = R[instant] @ T[:, :3, :3]
    centre = p[instant] + (R[instant] @ T[:, :3, 3:])[..., 0]
    points = centre[0] + rng.uniform([-2.0, -2.0, 3.0], [2.0, 2.0, 6.0], size=(30, 3)) @ R_cam[0].T
    rays = (points[None] - centre[:, None]) @ R_cam
    depth = np.linalg.norm(rays, axis=-1)
    rays = rays / depth[..., None]
    view, point = np.repeat(np.arange(len(T)), 30), np.tile(np.arange(30), len(T))
    sightings = Sightings(
        point=point,
        view=view,
        anchor=np.zeros(30, dtype=np.int64),
        ray=rays[view, point],
        anchor_ray=rays[0],
        instant=instant,
        R_body_cam=T[:, :3, :3],
        p_body_cam=T[:, :3, 3],
        sigma=1e-3,
    )
    bias = ImuBias(gyro=np.array(scene.gyro_bias), accel=np.array(scene.accel_bias))
    window = InertialWindow([scene.imu(2.0)], 0)
    increments = window.increments(TIMES[:-1], TIMES[1:], bias, rig().imu)
    rates = np.stack([np.interp(TIMES, window.elapsed, w) for w in window.gyro.T], axis=1)
    state = WindowState(R=R, p=p, v=scene.velocity(TIMES), bias=bias, delay_s=0.0, inverse_depth=1.0 / depth[0])
    return state, sightings, increments, rates


def disturbed(state, seed=1, size=0.02):
    rng = np.random.default_rng(seed)
    return replace(
        state,
        R=state.R @ so3.exp(size * rng.normal(size=(len(state.R), 3))),
        p=state.p + size * rng.normal(size=state.p.shape),
        v=state.v + size * rng.normal(size=state.v.shape),
        bias=ImuBias(gyro=state.bias.gyro + 0.1 * size, accel=state.bias.accel + size),
        delay_s=0.002,
        inverse_depth=state.inverse_depth * (1.0 + size * rng.normal(size=state.inverse_depth.shape)),
    )


@pytest.mark.parametrize("cameras", [1, 2])
def test_gradient_is_that_of_the_cost(cameras):
    state, sightings, increments, rates = problem(cameras)
    state = disturbed(state, size=2e-3)
    whole = start_bundle._Problem(sightings, increments, rates, PRIORS, state)
    system = whole.linearise(state)
    size, count = len(system._g), len(system._g_d)
    rng = np.random.default_rng(2)
    for _ in range(12):
        step, depth_step = rng.normal(size=size), 0.1 * rng.normal(size=count)
        # What is held has no gradient of its own: it is moved by no step.
        step[:6] = 0.0
        h = 1e-6
        forward = whole.cost(whole.moved(state, h * step, h * depth_step))
        backward = whole.cost(whole.moved(state, -h * step, -h * depth_step))
        slope = 2.0 * (system._g @ step + system._g_d @ depth_step)
        assert (forward - backward) / (2.0 * h) == pytest.approx(slope, rel=2e-3)


@pytest.mark.parametrize("cameras", [1, 2])
def test_the_true_state_is_recovered(cameras):
    truth, sightings, increments, rates = problem(cameras)
    result = refine(disturbed(truth), sightings, increments, rates, PRIORS)
    assert result is not None
    assert result.visual < 0.2
    assert result.scale_sigma < 0.1
    # Position and heading of the first instant stay where they were put.
    size = np.linalg.norm(result.state.p - result.state.p.mean(axis=0)) / np.linalg.norm(truth.p - truth.p.mean(axis=0))
    assert size == pytest.approx(1.0, abs=3.0 * result.scale_sigma + 5e-3)
    assert np.linalg.norm(result.state.bias.gyro - truth.bias.gyro) < 2e-3
    up = result.state.R[0].T[:, 2] @ truth.R[0].T[:, 2]
    assert np.degrees(np.arccos(min(up, 1.0))) < 0.5


def test_a_second_camera_sharpens_the_scale():
    sigmas = []
    for cameras in (1, 2):
        truth, sightings, increments, rates = problem(cameras)
        result = refine(truth, sightings, increments, rates, PRIORS)
        sigmas.append(result.scale_sigma)
    assert sigmas[1] < 0.7 * sigmas[0]
