"""Group axioms of rigid motions and their tangents, against the matrix exponential and differences."""

import numpy as np
import pytest

from geometry_tolerances import NUMERICAL, ROUNDING
from vioframe.geometry import se3, so3


def tangents(count: int = 30, seed: int = 0, angle: float = 1.5) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, 6)) * np.repeat([angle / np.sqrt(3), 2.0], 3)


def hat(xi: np.ndarray) -> np.ndarray:
    out = np.zeros((4, 4))
    out[:3, :3] = so3.hat(xi[:3])
    out[:3, 3] = xi[3:]
    return out


def test_exp_is_the_matrix_exponential() -> None:
    from scipy.linalg import expm

    for xi in tangents():
        np.testing.assert_allclose(se3.exp(xi), expm(hat(xi)), atol=ROUNDING)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.1, 1.5])
def test_log_inverts_exp(angle: float) -> None:
    xi = tangents(angle=angle)
    xi[:, :3] *= np.minimum(1.0, 3.0 / np.maximum(np.linalg.norm(xi[:, :3], axis=1, keepdims=True), 1e-9))
    np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, atol=1e-7)


def test_group_axioms() -> None:
    a, b, c = (se3.exp(tangents(seed=seed)) for seed in (1, 2, 3))
    identity = np.broadcast_to(np.eye(4), a.shape)
    np.testing.assert_allclose((a @ b) @ c, a @ (b @ c), atol=1e-11)
    np.testing.assert_allclose(a @ se3.inverse(a), identity, atol=ROUNDING)
    np.testing.assert_allclose(se3.inverse(a) @ a, identity, atol=ROUNDING)
    np.testing.assert_allclose(se3.inverse(a @ b), se3.inverse(b) @ se3.inverse(a), atol=1e-11)


def test_tangent_order_is_rotation_then_translation() -> None:
    quarter_turn = se3.exp(np.array([0, 0, np.pi / 2, 0, 0, 0]))
    np.testing.assert_allclose(quarter_turn[:3, :3] @ [1, 0, 0], [0, 1, 0], atol=ROUNDING)
    np.testing.assert_allclose(se3.exp(np.array([0, 0, 0, 1.0, 2.0, 3.0]))[:3, 3], [1, 2, 3])


def test_adjoint_moves_a_perturbation_across() -> None:
    T, xi = se3.exp(tangents(seed=4)), tangents(seed=5)
    moved = (se3.adjoint(T) @ xi[..., None])[..., 0]
    np.testing.assert_allclose(T @ se3.exp(xi) @ se3.inverse(T), se3.exp(moved), atol=1e-10)
    there_and_back = se3.adjoint(T) @ se3.adjoint(se3.inverse(T))
    np.testing.assert_allclose(there_and_back, np.broadcast_to(np.eye(6), (30, 6, 6)), atol=1e-11)


def test_adjoint_is_the_derivative_of_conjugation() -> None:
    T, step = se3.exp(tangents(1, seed=6)[0]), 1e-5

    def conjugated(xi: np.ndarray) -> np.ndarray:
        return se3.log(T @ se3.exp(xi) @ se3.inverse(T))

    columns = [(conjugated(step * e) - conjugated(-step * e)) / (2 * step) for e in np.eye(6)]
    numeric = np.stack(columns, axis=1)
    np.testing.assert_allclose(se3.adjoint(T), numeric, atol=NUMERICAL)


def test_transform_maps_points_and_composes() -> None:
    a, b = se3.exp(tangents(2, seed=7))
    points = np.random.default_rng(8).normal(size=(10, 3))
    np.testing.assert_allclose(se3.transform(a, points), points @ a[:3, :3].T + a[:3, 3], atol=ROUNDING)
    np.testing.assert_allclose(se3.transform(a, se3.transform(b, points)), se3.transform(a @ b, points), atol=ROUNDING)
    many = se3.transform(np.stack([a, b]), np.stack([points, points]))
    np.testing.assert_allclose(many[1], se3.transform(b, points), atol=ROUNDING)


def test_from_parts_broadcasts() -> None:
    T = se3.from_parts(np.eye(3), np.arange(6.0).reshape(2, 3))
    assert T.shape == (2, 4, 4)
    np.testing.assert_array_equal(T[:, 3], [[0, 0, 0, 1], [0, 0, 0, 1]])
