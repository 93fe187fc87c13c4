"""Quaternions against rotations, with the order of their parts pinned down."""

import numpy as np
import pytest

from geometry_tolerances import ROUNDING
from vioframe.geometry import quaternion, so3


def test_the_scalar_comes_first() -> None:
    half = np.sqrt(0.5)
    np.testing.assert_allclose(quaternion.to_matrix(np.array([half, 0, 0, half])) @ [1, 0, 0], [0, 1, 0], atol=ROUNDING)
    np.testing.assert_allclose(quaternion.from_matrix(so3.rotation_z(np.pi / 2)), [half, 0, 0, half], atol=ROUNDING)
    np.testing.assert_allclose(quaternion.from_matrix(np.eye(3)), [1, 0, 0, 0], atol=ROUNDING)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.3, 2.0, 3.1, np.pi])
def test_round_trip(angle: float) -> None:
    direction = np.random.default_rng(0).normal(size=(40, 3))
    phi = angle * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    R = so3.exp(phi)
    quat_wxyz = quaternion.from_matrix(R)
    np.testing.assert_allclose(np.linalg.norm(quat_wxyz, axis=1), 1.0, atol=ROUNDING)
    assert np.all(quat_wxyz[:, 0] >= -1e-9)
    np.testing.assert_allclose(quaternion.to_matrix(quat_wxyz), R, atol=1e-10)


def test_sign_and_length_do_not_matter() -> None:
    quat_wxyz = np.random.default_rng(1).normal(size=(20, 4))
    R = quaternion.to_matrix(quat_wxyz)
    np.testing.assert_allclose(R @ np.swapaxes(R, -1, -2), np.broadcast_to(np.eye(3), R.shape), atol=ROUNDING)
    np.testing.assert_allclose(quaternion.to_matrix(-3.0 * quat_wxyz), R, atol=ROUNDING)


def test_against_scipy() -> None:
    from scipy.spatial.transform import Rotation

    quat_wxyz = np.random.default_rng(2).normal(size=(20, 4))
    theirs = Rotation.from_quat(quat_wxyz[:, [1, 2, 3, 0]]).as_matrix()
    np.testing.assert_allclose(quaternion.to_matrix(quat_wxyz), theirs, atol=ROUNDING)
