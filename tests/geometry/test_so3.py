"""Group axioms, closed forms at their edges, and derivatives by differences."""

import numpy as np
import pytest

from geometry_tolerances import NEAR_PI, NUMERICAL, ROUNDING
from vioframe.geometry import so3

ANGLES = [0.0, 1e-12, 1e-8, 0.99e-4, 1.01e-4, 1e-2, 0.5, 2.0, 3.0, np.pi - 1e-3]


def vectors(angle: float, count: int = 50, seed: int = 0) -> np.ndarray:
    directions = np.random.default_rng(seed).normal(size=(count, 3))
    return angle * directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_is_a_rotation(angle: float) -> None:
    R = so3.exp(vectors(angle))
    np.testing.assert_allclose(R @ np.swapaxes(R, -1, -2), np.broadcast_to(np.eye(3), R.shape), atol=ROUNDING)
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=ROUNDING)
    np.testing.assert_allclose(np.trace(R, axis1=-2, axis2=-1), 1 + 2 * np.cos(angle), atol=ROUNDING)


@pytest.mark.parametrize("angle", ANGLES)
def test_log_inverts_exp(angle: float) -> None:
    phi = vectors(angle)
    np.testing.assert_allclose(so3.log(so3.exp(phi)), phi, atol=1e-9 * max(angle, 1e-3))


@pytest.mark.parametrize("below_pi", [0.0, 1e-12, 1e-9, 1e-6])
def test_log_at_half_a_turn(below_pi: float) -> None:
    phi = vectors(np.pi - below_pi)
    found = so3.log(so3.exp(phi))
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), np.pi - below_pi, atol=NEAR_PI)
    # Both directions of the axis are the same rotation there.
    same = np.minimum(np.abs(found - phi).max(axis=1), np.abs(found + phi).max(axis=1))
    assert same.max() < NEAR_PI
    # About each axis exactly, where one pivot alone is left.
    for axis in np.eye(3):
        np.testing.assert_allclose(np.abs(so3.log(2 * np.outer(axis, axis) - np.eye(3))), np.pi * axis, atol=NEAR_PI)


def test_group_axioms() -> None:
    a, b, c = (so3.exp(np.random.default_rng(seed).normal(0, 1.5, (50, 3))) for seed in (1, 2, 3))
    np.testing.assert_allclose((a @ b) @ c, a @ (b @ c), atol=ROUNDING)
    np.testing.assert_allclose(so3.exp(-so3.log(a)), np.swapaxes(a, -1, -2), atol=1e-9)
    product = a @ b
    np.testing.assert_allclose(so3.exp(so3.log(product)), product, atol=1e-9)


def test_exp_is_the_matrix_exponential() -> None:
    from scipy.linalg import expm

    for phi in np.random.default_rng(4).normal(0, 1.5, (20, 3)):
        np.testing.assert_allclose(so3.exp(phi), expm(so3.hat(phi)), atol=ROUNDING)


def test_hat_is_the_cross_product_and_vee_its_inverse() -> None:
    a, b = np.random.default_rng(5).normal(size=(2, 30, 3))
    np.testing.assert_allclose((so3.hat(a) @ b[..., None])[..., 0], np.cross(a, b), atol=ROUNDING)
    np.testing.assert_array_equal(so3.vee(so3.hat(a)), a)


def test_adjoint_turns_the_vector() -> None:
    random = np.random.default_rng(6)
    phi, R = random.normal(size=(20, 3)), so3.exp(random.normal(size=(20, 3)))
    turned = (R @ phi[..., None])[..., 0]
    np.testing.assert_allclose(R @ so3.exp(phi) @ np.swapaxes(R, -1, -2), so3.exp(turned), atol=ROUNDING)


def difference(function, phi: np.ndarray, step: float = 1e-5) -> np.ndarray:
    """Central differences of function(phi, delta) by delta, columns."""
    columns = []
    for axis in np.eye(3):
        columns.append((function(phi, step * axis) - function(phi, -step * axis)) / (2 * step))
    return np.stack(columns, axis=-1)


@pytest.mark.parametrize("angle", [1e-9, 1e-4, 0.3, 1.5, 3.0])
def test_jacobians_are_the_derivatives_of_exp(angle: float) -> None:
    for phi in vectors(angle, 5):
        back = so3.exp(-phi)
        left = difference(lambda p, d, back=back: so3.log(so3.exp(p + d) @ back), phi)
        right = difference(lambda p, d, back=back: so3.log(back @ so3.exp(p + d)), phi)
        np.testing.assert_allclose(so3.left_jacobian(phi), left, atol=NUMERICAL)
        np.testing.assert_allclose(so3.right_jacobian(phi), right, atol=NUMERICAL)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.99e-4, 1.01e-4, 1e-2, 1.0, 3.0, 6.0])
def test_inverse_jacobians_invert(angle: float) -> None:
    phi = vectors(angle)
    identity = np.broadcast_to(np.eye(3), (50, 3, 3))
    # The closed form loses digits like 1e-16/angle² just above the series.
    atol = 1e-7 if 1e-4 < angle < 1e-1 else 1e-10
    np.testing.assert_allclose(so3.left_jacobian(phi) @ so3.left_jacobian_inverse(phi), identity, atol=atol)
    np.testing.assert_allclose(so3.right_jacobian(phi) @ so3.right_jacobian_inverse(phi), identity, atol=atol)


def test_batches_are_the_single_ones() -> None:
    phi = np.random.default_rng(7).normal(size=(2, 3, 3))
    for function in (so3.hat, so3.exp, so3.left_jacobian, so3.right_jacobian, so3.left_jacobian_inverse):
        batched = function(phi)
        assert batched.shape == (2, 3, 3, 3)
        for i in range(2):
            for j in range(3):
                np.testing.assert_allclose(batched[i, j], function(phi[i, j]), atol=ROUNDING)


def test_normalise_finds_the_nearest_rotation() -> None:
    random = np.random.default_rng(8)
    R = so3.exp(random.normal(size=(20, 3)))
    spoilt = R + random.normal(0, 1e-3, R.shape)
    mended = so3.normalise(spoilt)
    np.testing.assert_allclose(mended @ np.swapaxes(mended, -1, -2), np.broadcast_to(np.eye(3), R.shape), atol=ROUNDING)
    for _ in range(20):
        other = mended @ so3.exp(random.normal(0, 1e-3, (20, 3)))
        assert np.all(np.linalg.norm(mended - spoilt, axis=(1, 2)) <= np.linalg.norm(other - spoilt, axis=(1, 2)))
    assert np.linalg.det(so3.normalise(np.diag([1.0, 1.0, -0.9]))) == pytest.approx(1.0)


def test_from_two_vectors_is_the_smallest_turn() -> None:
    random = np.random.default_rng(9)
    for start, end in random.normal(size=(30, 2, 3)):
        R = so3.from_two_vectors(start, 3.0 * end)
        np.testing.assert_allclose(R @ start / np.linalg.norm(start), end / np.linalg.norm(end), atol=ROUNDING)
        cosine = start @ end / np.linalg.norm(start) / np.linalg.norm(end)
        assert so3.angle(R) == pytest.approx(np.arccos(cosine), abs=1e-9)
    along = np.array([0.3, -0.4, 1.2])
    np.testing.assert_allclose(so3.from_two_vectors(along, 2 * along), np.eye(3), atol=ROUNDING)
    np.testing.assert_allclose(so3.from_two_vectors(along, -along) @ along, -along, atol=ROUNDING)


def test_rotation_z_turns_x_towards_y() -> None:
    np.testing.assert_allclose(so3.rotation_z(np.pi / 2) @ [1, 0, 0], [0, 1, 0], atol=ROUNDING)
    assert so3.rotation_z(np.zeros(4)).shape == (4, 3, 3)
