"""A robocentric error-state Kalman filter on tensors, differentiable from measurement to pose.

Li & Waslander, "Towards End-to-End Learning of Visual Inertial Odometry with an EKF", CRV 2020, after Bloesch et al.,
"Iterated extended Kalman filter based visual-inertial odometry using direct photometric feedback", IJRR 2017.

Gravity and velocity are held in the body, so that nothing the filter predicts with depends on where or which way the
body is. Over one window the reference is the body at its first image, and with the preintegrated increment
(ΔR, Δv, Δp) of T seconds the prediction is linear, without any approximation in T::

    R = ΔR      r = v T + ½ g T² + Δp      v' = v + g T + Δv      (all in the reference)

After the correction the motion (R, r) is composed onto the pose in the world, and g and v are turned into the new
body. Errors, with first-order maps between them::

    at an image   (ζ, ζ_position, g, v, b_gyro, b_accel), 18:  R_true = Exp(ζ) R, p_true = Exp(ζ) p + ζ_position
    in a window   the same, and (φ, r), 24 in all:             R_true = R Exp(φ), r_true = r + δr

ζ is the error of the pose in the world. Nothing measures it, but it is correlated with all else, so that a velocity
that was wrong is put right in the past too. Since ζ of one image is ζ of the one before plus what the window added,
the filter cannot believe that it has learned its heading.

Rotations are corrected by the Cayley map, which is Exp to second order and smooth everywhere.

All tensors are float64 with one leading axis B; smaller types lose the covariance.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from vioframe.learning.motion import inverse as inverse_motion

WORLD, GRAVITY, VELOCITY, BIAS = slice(0, 6), slice(6, 9), slice(9, 12), slice(12, 18)
TURN, SHIFT, MOTION = slice(18, 21), slice(21, 24), slice(18, 24)
AT_IMAGE, IN_WINDOW = 18, 24

# hat(a) is a @ this, reshaped: one small operation instead of seven, of which a step of the filter has many.
_SKEW = torch.zeros(3, 9, dtype=torch.float64)
for _axis, (_row, _column) in enumerate(((2, 1), (0, 2), (1, 0))):
    _SKEW[_axis, 3 * _row + _column] = 1.0
    _SKEW[_axis, 3 * _column + _row] = -1.0
_EYE = torch.eye(IN_WINDOW, dtype=torch.float64)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class State:
    """What the filter believes at an image.

    Attributes:
        R: (B, 3, 3) R_world_body; p: (B, 3) m, in the world.
        gravity: (B, 3) m/s² and v: (B, 3) m/s, in the body.
        bias: (B, 6) of gyro rad/s and accelerometer m/s².
        covariance: (B, 18, 18).
    """

    R: Tensor
    p: Tensor
    gravity: Tensor
    v: Tensor
    bias: Tensor
    covariance: Tensor


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Moved:
    """What the filter believes inside a window, at its second image and before it is settled.

    Attributes:
        before: at the first image; its gravity and bias may be corrected here, its covariance is no longer.
        R: (B, 3, 3) R_reference_body; r: (B, 3) m and v: (B, 3) m/s, in the reference.
        covariance: (B, 24, 24).
    """

    before: State
    R: Tensor
    r: Tensor
    v: Tensor
    covariance: Tensor


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Increment:
    """What the inertial samples of a window say, and how errors pass through it; any leading axes.

    Attributes:
        R: (..., 3, 3), v and p: (..., 3), at the bias ``reference``, gravity not applied.
        duration_s: (...).
        jacobian: (..., 9, 6), order (R, v, p) by (gyro, accel), per change of the subtracted bias.
        reference: (..., 6) that was subtracted.
        transition: (..., 24, 18) and noise: (..., 24, 24), of :func:`passing`.
    """

    R: Tensor
    v: Tensor
    p: Tensor
    duration_s: Tensor
    jacobian: Tensor
    reference: Tensor
    transition: Tensor
    noise: Tensor


def hat(vector: Tensor) -> Tensor:
    """Skew matrix (..., 3, 3) of vectors (..., 3)."""
    return (vector @ _SKEW.to(vector)).reshape(*vector.shape, 3)


def turn(vector: Tensor) -> Tensor:
    """Rotation (..., 3, 3) of small vectors (..., 3) rad, by the Cayley map."""
    half = 0.5 * vector
    skew = hat(half)
    gain = 2.0 / (1.0 + half.square().sum(-1))[..., None, None]
    return _EYE[:3, :3].to(vector) + gain * (skew + skew @ skew)


def turn_between(R: Tensor) -> Tensor:
    """Inverse of :func:`turn`, (..., 3), for rotations below 170°; finite beyond."""
    skew = R - R.transpose(-1, -2)
    trace = R.diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True)
    return (
        2.0 * torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], dim=-1) / (1.0 + trace).clamp_min(0.03)
    )


def apply(matrix: Tensor, vector: Tensor) -> Tensor:
    """Matrices (..., I, J) times vectors (..., J)."""
    return (matrix @ vector[..., None])[..., 0]


def passing(duration_s: Tensor, jacobian: Tensor, covariance: Tensor, walk: Tensor) -> tuple[Tensor, Tensor]:
    """How errors pass through a window; any leading axes.

    A bias that walks shifts the mean bias of the window by a third of its variance, correlated with where it ends.

    Args:
        duration_s: (...) T.
        jacobian: (..., 9, 6) of the increment by the bias.
        covariance: (..., 9, 9) of the increment, order (R, v, p).
        walk: (6,) variances that the biases gain in a second.

    Returns:
        (..., 24, 18) from the errors at an image to those in the window, and (..., 24, 24), what is added.
    """
    eye = _EYE.to(covariance)
    # Rows of the increment's errors (R, v, p) among the window's.
    place = eye[:, [18, 19, 20, 9, 10, 11, 21, 22, 23]]
    by_bias = place @ jacobian
    T = duration_s[..., None, None]
    move = eye[:, :AT_IMAGE] + T * (eye[:, VELOCITY] @ eye[GRAVITY, :AT_IMAGE])
    move = move + eye[:, SHIFT] @ (T * eye[VELOCITY, :AT_IMAGE] + 0.5 * T * T * eye[GRAVITY, :AT_IMAGE])
    move = move + by_bias @ eye[BIAS, :AT_IMAGE]
    into_bias = eye[:, BIAS]
    gained = T * walk.diag_embed()
    cross = by_bias @ (0.5 * gained) @ into_bias.T
    noise = place @ covariance @ place.T + by_bias @ (gained / 3.0) @ by_bias.transpose(-1, -2)
    noise = noise + cross + cross.transpose(-1, -2) + into_bias @ gained @ into_bias.T
    return move, noise


def propagate(state: State, increment: Increment) -> Moved:
    """Predict over a window; the increment is brought to the present bias to first order."""
    change = apply(increment.jacobian, state.bias - increment.reference)
    T = increment.duration_s[..., None]
    fall = state.gravity * T
    return Moved(
        before=state,
        R=increment.R @ turn(change[..., :3]),
        r=(state.v + 0.5 * fall) * T + increment.p + change[..., 6:],
        v=state.v + fall + increment.v + change[..., 3:6],
        covariance=increment.transition @ state.covariance @ increment.transition.transpose(-1, -2) + increment.noise,
    )


def motion_residual(moved: Moved, T_reference_body: Tensor) -> Tensor:
    """Residual (B, 6) of a measured motion (B, 4, 4) of the body against (φ, r), of which H picks the last six."""
    R, r = T_reference_body[..., :3, :3], T_reference_body[..., :3, 3]
    return torch.cat([turn_between(moved.R.transpose(-1, -2) @ R), r - moved.r], dim=-1)


def motion_noise(T_prev_cur: Tensor, T_body_cam: Tensor, covariance: Tensor) -> tuple[Tensor, Tensor]:
    """Motion of a camera as one of the body, with the noise of :func:`motion_residual`; any leading axes.

    Args:
        T_prev_cur: (..., 4, 4) of the camera.
        T_body_cam: (..., 4, 4).
        covariance: (..., 6, 6) in the tangent of the camera.

    Returns:
        T_reference_body (..., 4, 4) and (..., 6, 6).
    """
    T_cam_body = inverse_motion(T_body_cam)
    moved = T_body_cam @ T_prev_cur @ T_cam_body
    R_body_cam, p_body_cam = T_body_cam[..., :3, :3], T_body_cam[..., :3, 3]
    R = moved[..., :3, :3] @ R_body_cam
    # Ad(T_body_cam), the translation then turned into the reference, where the residual is.
    top = torch.cat([R_body_cam, torch.zeros_like(R_body_cam)], dim=-1).expand(*R.shape[:-1], 6)
    lever = moved[..., :3, :3] @ hat(p_body_cam) @ R_body_cam
    into = torch.cat([top, torch.cat([lever, R], dim=-1)], dim=-2)
    return moved, into @ covariance @ into.transpose(-1, -2)


def motion_rows(like: Tensor) -> Tensor:
    """H (6, 24) of :func:`motion_residual`."""
    return _EYE[MOTION].to(like)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Innovation:
    """How far a measurement is from what was expected.

    Attributes:
        chi_square: (B,) squared Mahalanobis length.
        sound: (B,) bool, False where the covariance of the innovation is not positive definite.
        gain: (B, 24) error that the measurement implies.
        shrink: (B, m, 24), Wᵀ W is what the covariance loses.
    """

    chi_square: Tensor
    sound: Tensor
    gain: Tensor
    shrink: Tensor


def innovate(moved: Moved, H: Tensor, residual: Tensor, noise: Tensor) -> Innovation:
    """Compare a linear measurement ``residual = H · error + noise`` with the filter.

    Args:
        moved: inside a window.
        H: (m, 24) or (B, m, 24).
        residual: (B, m).
        noise: (B, m, m).
    """
    HP = H @ moved.covariance
    S = HP @ H.transpose(-1, -2) + noise
    L, info = torch.linalg.cholesky_ex(0.5 * (S + S.transpose(-1, -2)))
    sound = info == 0
    if not bool(sound.all()):
        # One window of a batch must not spoil the gradient of the others.
        L = torch.where(sound[:, None, None], L, _EYE[: S.shape[-1], : S.shape[-1]].to(L).expand_as(L))
    solved = torch.linalg.solve_triangular(L, torch.cat([residual[..., None], HP], dim=-1), upper=False)
    white, shrink = solved[..., :1], solved[..., 1:]
    return Innovation(
        chi_square=white.square().sum((-2, -1)),
        sound=sound,
        gain=(shrink.transpose(-1, -2) @ white)[..., 0],
        shrink=shrink,
    )


def correct(moved: Moved, innovation: Innovation, used: Tensor) -> Moved:
    """Take a measurement where ``used`` (B,) says so."""
    error = torch.where(used[:, None], innovation.gain, torch.zeros_like(innovation.gain))
    shrink = torch.where(used[:, None, None], innovation.shrink, torch.zeros_like(innovation.shrink))
    before = moved.before
    turns = turn(torch.stack([error[:, :3], error[:, TURN]], dim=1))
    return Moved(
        before=replace(
            before,
            R=turns[:, 0] @ before.R,
            p=apply(turns[:, 0], before.p) + error[:, 3:6],
            gravity=before.gravity + error[:, GRAVITY],
            bias=before.bias + error[:, BIAS],
        ),
        R=moved.R @ turns[:, 1],
        r=moved.r + error[:, SHIFT],
        v=moved.v + error[:, VELOCITY],
        # Equal to Joseph's form where the gain is the optimal one, and symmetric by construction.
        covariance=moved.covariance - shrink.transpose(-1, -2) @ shrink,
    )


def settle(moved: Moved) -> State:
    """Compose the motion onto the pose, and make the body at the second image the reference."""
    before, P = moved.before, moved.covariance
    back = moved.R.transpose(-1, -2)
    gravity, v = apply(back, before.gravity), apply(back, moved.v)
    R = before.R @ moved.R
    p = apply(before.R, moved.r) + before.p
    skews = hat(torch.stack([gravity, v, p], dim=1))
    B = len(P)
    eye = _EYE.to(P)
    into = eye[:AT_IMAGE].expand(B, AT_IMAGE, IN_WINDOW).clone()
    into[:, GRAVITY, GRAVITY] = back
    into[:, VELOCITY, VELOCITY] = back
    into[:, GRAVITY, TURN] = skews[:, 0]
    into[:, VELOCITY, TURN] = skews[:, 1]
    into[:, 0:3, TURN] = R
    into[:, 3:6, TURN] = skews[:, 2] @ R
    into[:, 3:6, SHIFT] = before.R
    covariance = into @ P @ into.transpose(-1, -2)
    return State(
        R=R,
        p=p,
        gravity=gravity,
        v=v,
        bias=before.bias,
        covariance=0.5 * (covariance + covariance.transpose(-1, -2)),
    )
