"""Rigid motions in torch: against the numpy ones, against the group axioms, and by numerical gradients."""

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs torch: pip install 'vioframe[learn]'")

import torch
from torch.autograd import gradcheck

from vioframe.geometry import se3, so3
from vioframe.learning import motion

# From where the series are used to beyond where they are not, and to nearly half a turn.
ANGLES = (0.0, 1e-9, 1e-5, 1e-3, 0.03, 0.4999, 0.5001, 1.5, 3.0, 3.1415)


def rotation_vectors(seed=0, each=20):
    rng = np.random.default_rng(seed)
    axes = rng.normal(size=(len(ANGLES) * each, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    return axes * np.repeat(ANGLES, each)[:, None]


def test_agrees_with_the_numpy_geometry_of_the_core():
    phi = rotation_vectors()
    tensor = torch.from_numpy(phi)
    np.testing.assert_allclose(motion.exp_so3(tensor).numpy(), so3.exp(phi), atol=1e-14)
    np.testing.assert_allclose(motion.right_jacobian(tensor).numpy(), so3.right_jacobian(phi), atol=1e-12)
    np.testing.assert_allclose(motion.log_so3(torch.from_numpy(so3.exp(phi))).numpy(), phi, atol=1e-9)
    np.testing.assert_allclose(motion.hat(tensor).numpy(), so3.hat(phi))


@pytest.mark.parametrize(("rotation", "bound"), [("log", 3.0), ("euler", 1.5)])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 3e-6)])
def test_vector_round_trip(rotation, bound, dtype, tolerance):
    torch.manual_seed(1)
    vector = torch.empty(4, 50, 6, dtype=dtype).uniform_(-1, 1)
    vector[..., :3] *= bound / 3**0.5
    vector[0] *= 1e-4
    vector[1, 0] = 0.0
    again = motion.vector_from_motion(motion.motion_from_vector(vector, rotation), rotation)
    torch.testing.assert_close(again, vector, rtol=0, atol=tolerance)


def test_euler_angles_turn_about_x_first_and_z_last():
    angles = torch.tensor([0.3, -0.4, 0.5], dtype=torch.float64)
    axes = torch.eye(3, dtype=torch.float64)
    x, y, z = (motion.exp_so3(axes[k] * angles[k]) for k in range(3))
    torch.testing.assert_close(motion.exp_euler(angles), z @ y @ x)


def test_composition_is_the_product_and_relative_undoes_it():
    torch.manual_seed(2)
    steps = motion.motion_from_vector(torch.randn(3, 7, 6, dtype=torch.float64))
    poses = motion.compose(steps)
    assert poses.shape == (3, 8, 4, 4)
    expected = np.eye(4)
    for k in range(7):
        expected = expected @ steps[1, k].numpy()
        np.testing.assert_allclose(poses[1, k + 1].numpy(), expected, atol=1e-12)
    torch.testing.assert_close(motion.relative(poses), steps)
    torch.testing.assert_close(motion.inverse(poses).numpy(), se3.inverse(poses.numpy()))


def test_composition_is_associative():
    torch.manual_seed(3)
    steps = motion.motion_from_vector(torch.randn(5, 6, dtype=torch.float64))
    head, tail = motion.compose(steps[:2])[-1], motion.compose(steps[2:])[-1]
    torch.testing.assert_close(head @ tail, motion.compose(steps)[-1])


@pytest.mark.parametrize("scale", [0.0, 1e-6, 0.2, 1.0])
def test_gradients_are_the_numerical_ones_at_rest_too(scale):
    torch.manual_seed(4)
    vector = (scale * torch.randn(2, 3, 6, dtype=torch.float64)).requires_grad_()
    assert gradcheck(lambda v: motion.compose(motion.motion_from_vector(v)), (vector,))
    assert gradcheck(lambda v: motion.compose(motion.motion_from_vector(v, "euler")), (vector,))
    round_trip = (scale * torch.randn(4, 3, dtype=torch.float64)).requires_grad_()
    assert gradcheck(lambda phi: motion.log_so3(motion.exp_so3(phi)), (round_trip,), atol=1e-4)
    assert gradcheck(lambda phi: motion.right_jacobian(phi), (round_trip,))


def test_gradient_of_a_whole_trajectory_reaches_its_first_motion():
    vector = torch.zeros(1, 20, 6, requires_grad=True)
    motion.compose(motion.motion_from_vector(vector))[0, -1, :3, 3].sum().backward()
    assert torch.isfinite(vector.grad).all()
    # A turn at the first step swings all that follows; here nothing follows but rests.
    torch.testing.assert_close(vector.grad[0, :, 3:], torch.ones(20, 3))


def test_mixed_precision_leaves_the_geometry_alone():
    vector = torch.randn(2, 5, 6)
    with torch.autocast("cpu", torch.bfloat16):
        mixed = motion.compose(motion.motion_from_vector(vector))
    assert mixed.dtype == torch.float32
    assert torch.equal(mixed, motion.compose(motion.motion_from_vector(vector)))


def test_covariance_is_that_of_drawn_errors():
    torch.manual_seed(5)
    vector = torch.tensor([0.4, -0.9, 0.6, 1.0, -2.0, 3.0], dtype=torch.float64)
    log_variances = torch.tensor([1e-6, 4e-6, 9e-6, 1e-4, 4e-4, 1e-6], dtype=torch.float64).log()
    stated = motion.covariance_from_log_variances(vector, log_variances)
    count = 200_000
    drawn = vector + torch.randn(count, 6, dtype=torch.float64) * (0.5 * log_variances).exp()
    error = motion.product(motion.inverse(motion.motion_from_vector(vector)), motion.motion_from_vector(drawn))
    tangent = se3.log(error.numpy())
    sigma = np.sqrt(np.diag(stated.numpy()))
    scale = np.outer(sigma, sigma)
    np.testing.assert_allclose(np.cov(tangent.T) / scale, stated.numpy() / scale, atol=0.02)
