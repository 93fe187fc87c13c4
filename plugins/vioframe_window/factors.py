"""Factors of the window that gtsam has not, the prior of a start, and names of variables."""

from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from vioframe.checks import Array
from vioframe.geometry import so3
from vioframe.types import NavState

_LETTER = 56
_BODY, _VELOCITY, _BIAS, _CAMERA, _POINT, _EXTRINSICS, _DELAY, _LOOP = (ord(c) << _LETTER for c in "xvbclesz")
EXTRINSICS, DELAY = _EXTRINSICS, _DELAY
"""Pose of camera 0 on the body, and the camera's delay in seconds."""

# What a start is never believed beyond, so that the first system can be solved: rad, m, m/s, m/s², rad/s.
_START_FLOOR = np.array([3e-4, 1e-3, 3e-3, 3e-3, 3e-5])
_UNIT, _MINUS = np.eye(3), -np.eye(3)
# How rigidly a camera is tied to its body: far below a pixel, and above what rounding needs.
_TIE_SIGMAS = np.array([1e-4] * 3 + [1e-4] * 3)


def body_key(index: int) -> int:
    """Pose of the body at a keyframe."""
    return _BODY | index


def velocity_key(index: int) -> int:
    """Velocity in the world at a keyframe."""
    return _VELOCITY | index


def bias_key(index: int) -> int:
    """Biases at a keyframe."""
    return _BIAS | index


def camera_key(index: int) -> int:
    """Pose of camera 0 at a keyframe."""
    return _CAMERA | index


def point_key(track_id: int) -> int:
    """A landmark in the world."""
    return _POINT | track_id


def loop_key(match_id: int) -> int:
    """Pose of camera 0 at an old keyframe that a loop closer found again."""
    return _LOOP | match_id


def start_prior(index: int, state: NavState, covariance: Array) -> gtsam.NonlinearFactorGraph:
    """Correlated prior of pose, velocity and biases at a keyframe.

    Args:
        index: of the keyframe.
        state: mean.
        covariance: (15, 15), order and error of ``NavState.covariance``.
    """
    # gtsam: position in body axes, biases ordered (accel, gyro).
    into = np.zeros((15, 15))
    into[0:3, 0:3] = np.eye(3)
    into[3:6, 3:6] = state.T_world_body[:3, :3].T
    into[6:9, 6:9] = np.eye(3)
    into[9:12, 12:15] = into[12:15, 9:12] = np.eye(3)
    mapped = into @ covariance @ into.T + np.diag(np.repeat(_START_FLOOR, 3) ** 2)
    # W whitens: Wᵀ W = mapped⁻¹.
    values, vectors = np.linalg.eigh(0.5 * (mapped + mapped.T))
    W = vectors.T / np.sqrt(np.maximum(values, 1e-14))[:, None]
    keys = body_key(index), velocity_key(index), bias_key(index)
    linear = gtsam.JacobianFactor(
        keys[0], W[:, :6], keys[1], W[:, 6:9], keys[2], W[:, 9:], np.zeros(15), gtsam.noiseModel.Unit.Create(15)
    )
    at = gtsam.Values()
    at.insert(keys[0], gtsam.Pose3(state.T_world_body))
    at.insert(keys[1], state.v_world_body)
    at.insert(keys[2], gtsam.imuBias.ConstantBias(state.bias.accel, state.bias.gyro))
    graph = gtsam.NonlinearFactorGraph()
    graph.push_back(gtsam.LinearContainerFactor(linear, at))
    return graph


def camera_tie(index: int, rate: Array, delay_s: float, *, with_delay: bool) -> gtsam.CustomFactor:
    """Ties camera 0 at a keyframe to the body, the extrinsics and the delay.

    The image was taken δ = d − ``delay_s`` after the keyframe's stamp, d the estimated delay; with the rate ω and
    the velocity v of the keyframe the camera is then at

        R̂ = R_x Exp(ω δ) R_e,    p̂ = p_x + v δ + R_x Exp(ω δ) t_e

    and the error is (Log(R_cᵀ R̂), R_cᵀ (p̂ − p_c)).

    Args:
        index: of the keyframe.
        rate: (3,) rad/s, bias taken off.
        delay_s: that the keyframe's stamp contains.
        with_delay: whether d is a variable; else the stamp is right.
    """
    keys = [body_key(index), camera_key(index), EXTRINSICS]
    if with_delay:
        keys += [velocity_key(index), DELAY]

    turned: dict[float, Array] = {}

    def turn_of(shift_s: float) -> Array:
        if shift_s not in turned:
            turned.clear()
            turned[shift_s] = so3.exp(rate * shift_s)
        return turned[shift_s]

    def error(factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: Any | None) -> NDArray[np.float64]:
        velocity, shift = np.zeros(3), 0.0
        if with_delay:
            velocity = values.atVector(keys[3])
            shift = float(values.atVector(DELAY)[0]) - delay_s
        residual, derivatives = tie_error(
            values.atPose3(keys[0]).matrix(),
            values.atPose3(keys[1]).matrix(),
            values.atPose3(EXTRINSICS).matrix(),
            velocity,
            rate,
            shift,
            turn_of(shift),
        )
        if jacobians is not None:
            for slot in range(len(keys)):
                jacobians[slot] = derivatives[slot]
        return np.asarray(residual, dtype=np.float64)

    return gtsam.CustomFactor(gtsam.noiseModel.Diagonal.Sigmas(_TIE_SIGMAS), keys, error)


def _hat(v: Array) -> Array:
    x, y, z = v.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _small_log(R: Array) -> tuple[Array, Array]:
    """Log (3,) of a rotation that is small, and the inverse (3, 3) of its right Jacobian, to second order."""
    rotation = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    return rotation, _UNIT + 0.5 * _hat(rotation)


def tie_error(
    T_world_body: Array,
    T_world_cam: Array,
    T_body_cam: Array,
    velocity: Array,
    rate: Array,
    shift_s: float,
    turn: Array,
) -> tuple[Array, tuple[Array, ...]]:
    """Error (6,) of :func:`camera_tie` and its derivatives, to second order in the error.

    Written for one keyframe at a time and without the batched functions of :mod:`vioframe.geometry`: gtsam asks for
    it some thirty times a keyframe.

    Args:
        T_world_body, T_world_cam, T_body_cam: (4, 4).
        velocity: (3,) m/s.
        rate: (3,) rad/s.
        shift_s: δ.
        turn: (3, 3), Exp(ω δ).

    Returns:
        The error and its derivatives by body, camera, extrinsics (6, 6), velocity (6, 3) and delay (6, 1); poses
        move on the right, tangent order (rotation, translation).
    """
    R_world_body, R_cam_world = T_world_body[:3, :3], T_world_cam[:3, :3].T
    R_e, t_e = T_body_cam[:3, :3], T_body_cam[:3, 3]
    R_body_cam = turn @ R_e
    lever = turn @ t_e
    R_cam_body = R_cam_world @ R_world_body
    R_error = R_cam_body @ R_body_cam
    rotation, inverse = _small_log(R_error)
    apart = R_cam_world @ (T_world_body[:3, 3] + velocity * shift_s - T_world_cam[:3, 3]) + R_cam_body @ lever
    by_body, by_camera, by_extrinsics = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros((6, 6))
    by_body[:3, :3] = inverse @ R_body_cam.T
    by_body[3:, :3] = -R_cam_body @ _hat(lever)
    by_body[3:, 3:] = R_cam_body
    by_camera[:3, :3] = -inverse @ R_error.T
    by_camera[3:, :3] = _hat(apart)
    by_camera[3:, 3:] = _MINUS
    by_extrinsics[:3, :3] = inverse
    by_extrinsics[3:, 3:] = R_error
    by_velocity, by_delay = np.zeros((6, 3)), np.zeros((6, 1))
    by_velocity[3:] = R_cam_world * shift_s
    by_delay[:3, 0] = inverse @ (R_e.T @ rate)
    by_delay[3:, 0] = R_cam_world @ velocity + R_cam_body @ (turn @ (_hat(rate) @ t_e))
    return np.concatenate([rotation, apart]), (by_body, by_camera, by_extrinsics, by_velocity, by_delay)
