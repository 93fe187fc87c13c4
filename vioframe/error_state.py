"""The inertial core of a loosely coupled error-state Kalman filter, shared by the filters' plugins.

The error of the body is right-invariant on the extended pose (Barrau & Bonnabel, "The Invariant Extended
Kalman Filter as a Stable Observer", IEEE TAC 2017). With ξ = (φ, ρ, ν)::

    R_true = Exp(φ) R,    p_true = Exp(φ) p + J_l(φ) ρ,    v_true = Exp(φ) v + J_l(φ) ν

and biases additive. A turn about gravity and a shift of the world are then the same constant vectors
whatever the estimate is, so relative measurements cannot make the filter believe that it knows its heading
(the inconsistency of the usual error), and the transition of (φ, ρ, ν) does not depend on the state at all.
What leaves the filter is in the error of :class:`~vioframe.types.NavState`: θ local, p and v in the world.

Error vectors are ordered (φ, ρ, ν, b_gyro, b_accel), 15 in all, then what a filter appends.
"""

from dataclasses import dataclass, replace

import numpy as np

from vioframe.checks import Array
from vioframe.conventions import gravity_vector
from vioframe.errors import StateError
from vioframe.geometry import se3, so3
from vioframe.inertial import bias_walk_covariance
from vioframe.types import ImuBias, ImuNoise, InertialDelta, NavState, Status

THETA, POSITION, VELOCITY = slice(0, 3), slice(3, 6), slice(6, 9)
BIAS_GYRO, BIAS_ACCEL = slice(9, 12), slice(12, 15)
POSE, BIAS = slice(0, 6), slice(9, 15)
INERTIAL = slice(0, 15)
SIZE = 15


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Body:
    """What an inertial filter believes of the body: R_world_body (3, 3), p and v (3,) in the world, bias."""

    R: Array
    p: Array
    v: Array
    bias: ImuBias

    @property
    def T_world_body(self) -> Array:
        """Pose (4, 4)."""
        return se3.from_parts(self.R, self.p)

    @staticmethod
    def of(state: NavState) -> "Body":
        """The body of a navigation state."""
        T = state.T_world_body
        return Body(R=T[:3, :3].copy(), p=T[:3, 3].copy(), v=state.v_world_body.copy(), bias=state.bias)


def retract(body: Body, error: Array) -> Body:
    """Apply an error (15,), so that ``retract(estimate, error)`` is the truth."""
    phi = error[THETA]
    turn, jacobian = so3.exp(phi), so3.left_jacobian(phi)
    return Body(
        R=turn @ body.R,
        p=turn @ body.p + jacobian @ error[POSITION],
        v=turn @ body.v + jacobian @ error[VELOCITY],
        bias=ImuBias(gyro=body.bias.gyro + error[BIAS_GYRO], accel=body.bias.accel + error[BIAS_ACCEL]),
    )


def difference(estimate: Body, truth: Body) -> Array:
    """Inverse of :func:`retract`: the error (15,) that leads from the estimate to the truth."""
    turn = truth.R @ estimate.R.T
    phi = so3.log(turn)
    inverse = so3.left_jacobian_inverse(phi)
    return np.concatenate(
        [
            phi,
            inverse @ (truth.p - turn @ estimate.p),
            inverse @ (truth.v - turn @ estimate.v),
            truth.bias.gyro - estimate.bias.gyro,
            truth.bias.accel - estimate.bias.accel,
        ]
    )


def propagate(body: Body, delta: InertialDelta, gravity: Array) -> Body:
    """Move the body over a window (Forster et al. 2017, eq. 33); ``delta`` must hold at ``body.bias``.

    Args:
        body: at the start of the window.
        delta: over the window.
        gravity: (3,) m/s², in the world.
    """
    T = delta.duration_s
    return Body(
        R=body.R @ delta.delta_R,
        p=body.p + body.v * T + 0.5 * T * T * gravity + body.R @ delta.delta_p,
        v=body.v + gravity * T + body.R @ delta.delta_v,
        bias=body.bias,
    )


def transition(before: Body, after: Body, delta: InertialDelta, gravity: Array) -> tuple[Array, Array]:
    """How errors pass through a window, to first order.

    Returns:
        Φ (15, 15), from the error before to the error after, and G (15, 9), from the error of ``delta``
        (R, v, p; θ local) to the error after.
    """
    T = delta.duration_s
    skew_gravity = so3.hat(gravity)
    noise_map = np.zeros((SIZE, 9))
    noise_map[THETA, 0:3] = after.R
    noise_map[POSITION, 0:3] = so3.hat(after.p) @ after.R
    noise_map[POSITION, 6:9] = before.R
    noise_map[VELOCITY, 0:3] = so3.hat(after.v) @ after.R
    noise_map[VELOCITY, 3:6] = before.R
    phi = np.eye(SIZE)
    phi[POSITION, THETA] = 0.5 * T * T * skew_gravity
    phi[POSITION, VELOCITY] = T * np.eye(3)
    phi[VELOCITY, THETA] = T * skew_gravity
    phi[:, BIAS] += noise_map @ delta.bias_jacobian
    return phi, noise_map


def process_noise(noise_map: Array, delta: InertialDelta, noise: ImuNoise) -> Array:
    """Covariance (15, 15) that a window adds: white noise of the samples and walk of the biases.

    A bias that walks from b by a variance σ² T shifts the window's mean bias by σ² T/3, with the correlation
    of a Brownian path and its mean; the effect on the increment is that of the mean.
    """
    walk = bias_walk_covariance(noise, delta.duration_s)
    along = noise_map @ delta.bias_jacobian
    out = noise_map @ delta.covariance @ noise_map.T + along @ (walk / 3.0) @ along.T
    cross = along @ (walk / 2.0)
    out[:, BIAS] += cross
    out[BIAS, :] += cross.T
    out[BIAS, BIAS] += walk
    return out


def local_from_invariant(body: Body) -> Array:
    """Map (15, 15) from the filter's error to that of ``NavState.covariance`` (θ local; p, v additive)."""
    out = np.eye(SIZE)
    out[THETA, THETA] = body.R.T
    out[POSITION, THETA] = -so3.hat(body.p)
    out[VELOCITY, THETA] = -so3.hat(body.v)
    return out


def invariant_from_local(body: Body) -> Array:
    """Inverse of :func:`local_from_invariant`."""
    out = np.eye(SIZE)
    out[THETA, THETA] = body.R
    out[POSITION, THETA] = so3.hat(body.p) @ body.R
    out[VELOCITY, THETA] = so3.hat(body.v) @ body.R
    return out


def symmetrised(covariance: Array) -> Array:
    """The symmetric part, so that rounding cannot accumulate."""
    out: Array = 0.5 * (covariance + covariance.T)
    return out


class InertialFilter:
    """Body, covariance and the two steps of a Kalman filter; a plugin appends its own errors.

    The covariance is (15 + extra, 15 + extra), plus 6 while a clone of the body's pose is held at the end.

    Args:
        extra: number of errors the plugin appends after the body's.
        noise: densities of the inertial sensor.
        gravity: magnitude, m/s².
    """

    def __init__(self, *, extra: int, noise: ImuNoise, gravity: float) -> None:
        self.extra = extra
        self.noise = noise
        self.gravity = gravity_vector(gravity)
        self.body = Body(R=np.eye(3), p=np.zeros(3), v=np.zeros(3), bias=ImuBias())
        self.covariance: Array = np.zeros((SIZE + extra, SIZE + extra))
        self.T_world_clone: Array | None = None

    def start(self, state: NavState, covariance: Array) -> None:
        """Take a state, and its covariance (15, 15) in the order and error of ``NavState.covariance``."""
        self.body = Body.of(state)
        into = invariant_from_local(self.body)
        self.covariance = np.zeros((SIZE + self.extra, SIZE + self.extra))
        self.covariance[INERTIAL, INERTIAL] = symmetrised(into @ covariance @ into.T)
        self.T_world_clone = None

    def copy(self) -> "InertialFilter":
        """An independent filter in the same state."""
        twin = InertialFilter(extra=self.extra, noise=self.noise, gravity=-float(self.gravity[2]))
        twin.body = self.body
        twin.covariance = self.covariance.copy()
        twin.T_world_clone = self.T_world_clone
        return twin

    def clone_pose(self) -> None:
        """Append the present pose of the body, fully correlated (Roumeliotis & Burdick, ICRA 2002)."""
        size = SIZE + self.extra
        grown = np.empty((size + 6, size + 6))
        grown[:size, :size] = self.covariance
        grown[size:, :size] = self.covariance[POSE]
        grown[:size, size:] = self.covariance[:, POSE]
        grown[size:, size:] = self.covariance[POSE, POSE]
        self.covariance = grown
        self.T_world_clone = self.body.T_world_body

    def drop_clone(self) -> None:
        """Marginalise the clone."""
        size = SIZE + self.extra
        self.covariance = self.covariance[:size, :size].copy()
        self.T_world_clone = None

    def propagate(self, delta: InertialDelta) -> None:
        """Move body and covariance over a window."""
        before = self.body
        if not (
            np.array_equal(delta.bias.gyro, before.bias.gyro) and np.array_equal(delta.bias.accel, before.bias.accel)
        ):
            delta = delta.at(before.bias)
        self.body = propagate(before, delta, self.gravity)
        phi, noise_map = transition(before, self.body, delta, self.gravity)
        covariance = self.covariance.copy()
        covariance[INERTIAL, :] = phi @ covariance[INERTIAL, :]
        covariance[:, INERTIAL] = covariance[:, INERTIAL] @ phi.T
        covariance[INERTIAL, INERTIAL] += process_noise(noise_map, delta, self.noise)
        self.covariance = symmetrised(covariance)

    def innovation(self, H: Array, residual: Array, noise: Array) -> tuple[Array, float]:
        """Covariance (m, m) of a residual (m,), and its squared Mahalanobis length."""
        S = symmetrised(H @ self.covariance @ H.T + noise)
        return S, float(residual @ np.linalg.solve(S, residual))

    def correct(self, H: Array, residual: Array, noise: Array) -> Array:
        """Update with a linear measurement ``residual = H · error + noise``, in Joseph's form.

        The body (and nothing else) is corrected here.

        Returns:
            The whole estimated error (n,), of which a plugin applies its own part.
        """
        P = self.covariance
        PHt = P @ H.T
        S = symmetrised(H @ PHt + noise)
        gain = np.linalg.solve(S, PHt.T).T
        error = gain @ residual
        keep = np.eye(len(P)) - gain @ H
        self.covariance = symmetrised(keep @ P @ keep.T + gain @ noise @ gain.T)
        self.body = retract(self.body, error[INERTIAL])
        if self.T_world_clone is not None:
            self.T_world_clone = se3.exp(error[-6:]) @ self.T_world_clone
        return error

    def standstill_measurement(
        self, rotation_sigma: float, position_sigma: float, velocity_sigma: float
    ) -> tuple[Array, Array, Array]:
        """H (9, n), residual (9,), noise (9, 9): the body has not moved since the clone and has no velocity.

        Stated as a relative motion, it uses the gyro's samples once: as propagation, never again as a reading.
        """
        if self.T_world_clone is None:
            raise StateError("standstill_measurement needs clone_pose before propagate")
        n = len(self.covariance)
        H = np.zeros((9, n))
        residual = np.zeros(9)
        T_world_body = self.body.T_world_body
        residual[:6] = se3.log(se3.inverse(T_world_body) @ self.T_world_clone)
        back = se3.adjoint(se3.inverse(T_world_body))
        H[:6, POSE] = back
        H[:6, n - 6 :] = -back
        residual[6:] = -self.body.v
        H[6:, VELOCITY] = np.eye(3)
        H[6:, THETA] = -so3.hat(self.body.v)
        sigmas = np.repeat([rotation_sigma, position_sigma, velocity_sigma], 3)
        return H, residual, np.diag(sigmas**2)

    def doubt(self, tilt_sigma: float, velocity_sigma: float) -> None:
        """Admit to be wrong by more than the covariance says: widen roll, pitch (rad) and velocity (m/s)."""
        local = np.zeros((SIZE, SIZE))
        upright = np.diag([tilt_sigma**2, tilt_sigma**2, 0.0])
        local[THETA, THETA] = self.body.R.T @ upright @ self.body.R
        local[VELOCITY, VELOCITY] = velocity_sigma**2 * np.eye(3)
        into = invariant_from_local(self.body)
        self.covariance[INERTIAL, INERTIAL] += symmetrised(into @ local @ into.T)

    def nav_state(self, stamp_ns: int, status: Status) -> NavState:
        """The state in the convention of :class:`~vioframe.types.NavState`."""
        into = local_from_invariant(self.body)
        return NavState(
            stamp_ns=stamp_ns,
            T_world_body=self.body.T_world_body,
            v_world_body=self.body.v.copy(),
            bias=self.body.bias,
            covariance=symmetrised(into @ self.covariance[INERTIAL, INERTIAL] @ into.T),
            status=status,
        )

    def normalise(self) -> None:
        """Take rounding off the rotation."""
        self.body = replace(self.body, R=so3.normalise(self.body.R))
