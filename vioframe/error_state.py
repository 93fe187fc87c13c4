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
from vioframe.conventions import NANOSECONDS, gravity_vector
from vioframe.errors import StateError
from vioframe.geometry import se3, so3
from vioframe.inertial import bias_walk_covariance
from vioframe.initialisation import StillnessDetector
from vioframe.types import ImuBias, ImuNoise, InertialDelta, NavState, Status, SyncedWindow

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


def chi_square_limit(probability: float, degrees: int) -> float:
    """Value that a χ² variable with this many degrees of freedom stays below with this probability."""
    from scipy.special import chdtri

    return float(chdtri(degrees, 1.0 - probability))


def part_of(delta: InertialDelta, start_s: float, end_s: float) -> InertialDelta:
    """The increment over [start, end] seconds of a window.

    The motion comes from ``delta.path``, linear between samples; without a path the rate and the specific
    force are taken as constant. Covariance and bias Jacobian are those of constant noise and slow rotation:
    they grow with the powers of time of a short interval (θ, v: √T and T; p: T√T and T²).
    """
    T = delta.duration_s
    if start_s <= 0.0 and end_s >= T:
        return delta
    (R0, v0, p0), (R1, v1, p1) = _point_of(delta, start_s), _point_of(delta, end_s)
    step = end_s - start_s
    share = step / T
    growth = np.repeat([np.sqrt(share), np.sqrt(share), share * np.sqrt(share)], 3)
    bias_jacobian = delta.bias_jacobian.copy()
    bias_jacobian[0:3] *= share
    bias_jacobian[3:6, 0:3] *= share**2
    bias_jacobian[3:6, 3:6] *= share
    bias_jacobian[6:9, 0:3] *= share**3
    bias_jacobian[6:9, 3:6] *= share**2
    # Jacobians of v and p are in the frame at the window's start; turn them into that of the part.
    bias_jacobian[3:6] = R0.T @ bias_jacobian[3:6]
    bias_jacobian[6:9] = R0.T @ bias_jacobian[6:9]
    return replace(
        delta,
        delta_R=R0.T @ R1,
        delta_v=R0.T @ (v1 - v0),
        delta_p=R0.T @ (p1 - p0 - v0 * step),
        path=None,
        duration_s=step,
        covariance=growth[:, None] * delta.covariance * growth,
        bias_jacobian=bias_jacobian,
        reintegrate=None,
    )


def _point_of(delta: InertialDelta, at_s: float) -> tuple[Array, Array, Array]:
    """Increment (R, v, p) from the start of the window to ``at_s`` seconds after it."""
    path = delta.path
    if path is None:
        share = at_s / delta.duration_s
        force = delta.delta_v / delta.duration_s
        rest = delta.delta_p - 0.5 * force * delta.duration_s**2
        turn = so3.exp(share * so3.log(delta.delta_R))
        return turn, force * at_s, 0.5 * force * at_s**2 + rest * share**2
    elapsed = (path.stamps_ns - path.stamps_ns[0]) / NANOSECONDS
    after = int(np.clip(np.searchsorted(elapsed, at_s), 1, len(elapsed) - 1))
    before = after - 1
    span = elapsed[after] - elapsed[before]
    into = at_s - elapsed[before]
    share = into / span
    turn = path.delta_R[before] @ so3.exp(share * so3.log(path.delta_R[before].T @ path.delta_R[after]))
    force = (path.delta_v[after] - path.delta_v[before]) / span
    v = path.delta_v[before] + force * into
    rest = path.delta_p[after] - path.delta_p[before] - path.delta_v[before] * span - 0.5 * force * span**2
    p = path.delta_p[before] + path.delta_v[before] * into + 0.5 * force * into**2 + rest * share**2
    return turn, v, p


def add_gap(delta: InertialDelta, gap_s: float, rate_sigma: float, accel_sigma: float) -> InertialDelta:
    """Widen the increment's covariance for a hole in the samples.

    Inside the hole the rate and the specific force are off by an unknown constant of these sigmas.

    Args:
        delta: over the window with the hole.
        gap_s: length of the hole.
        rate_sigma: rad/s.
        accel_sigma: m/s².
    """
    gap = min(gap_s, delta.duration_s)
    covariance = delta.covariance.copy()
    covariance[0:3, 0:3] += (rate_sigma * gap) ** 2 * np.eye(3)
    # The hole's place in the window is not known: the velocity error acts for half the window on average.
    velocity, position = accel_sigma * gap, 0.5 * accel_sigma * gap * delta.duration_s
    for a, sigma_a in ((3, velocity), (6, position)):
        for b, sigma_b in ((3, velocity), (6, position)):
            covariance[a : a + 3, b : b + 3] += sigma_a * sigma_b * np.eye(3)
    covariance[6:9, 6:9] += position**2 / 3.0 * np.eye(3)
    # Integrating again would lose what was added.
    return replace(delta, covariance=covariance, reintegrate=None)


def coasting(body: Body, duration_s: float, gravity: Array, rate_sigma: float, accel_sigma: float) -> InertialDelta:
    """The increment of a stretch without any sample: constant velocity and attitude, and little trust in it.

    Args:
        body: at the start of the stretch.
        duration_s: of the stretch.
        gravity: (3,) m/s², in the world.
        rate_sigma: rad/s, of an unknown constant rate.
        accel_sigma: m/s², of an unknown constant acceleration.
    """
    lift = -body.R.T @ gravity
    blank = InertialDelta(
        delta_R=np.eye(3),
        delta_v=lift * duration_s,
        delta_p=0.5 * lift * duration_s**2,
        duration_s=duration_s,
        covariance=np.zeros((9, 9)),
        bias=body.bias,
        bias_jacobian=np.zeros((9, 6)),
    )
    return add_gap(blank, duration_s, rate_sigma, accel_sigma)


class StandstillTest:
    """Says whether the body is at rest, so that a filter may measure its motion as none.

    A body that coasts smoothly looks the same to its inertial sensors, so the filter must also find its own
    speed near zero; the measurement then still has to pass the filter's χ² gate.

    Args:
        detector: on the inertial samples.
        gyro_limit: rad/s; a mean rate that differs more from the estimated bias is a turn.
        speed_limit: m/s; a larger estimated speed is motion.
    """

    def __init__(self, detector: StillnessDetector, *, gyro_limit: float, speed_limit: float) -> None:
        self._detector = detector
        self._gyro_limit = gyro_limit
        self._speed_limit = speed_limit

    def push(self, window: SyncedWindow, body: Body) -> bool:
        """Take one more window, and what the filter believes at its start."""
        stillness = self._detector.push(window)
        if stillness is None or self._detector.motion(stillness) is not None:
            return False
        return bool(
            np.linalg.norm(stillness.gyro_mean - body.bias.gyro) < self._gyro_limit
            and np.linalg.norm(body.v) < self._speed_limit
        )


class NoiseAdaptation:
    """Raises the stated noise of both sensors while they contradict each other more than it allows.

    Data sheets state the noise of a sensor that does not shake; on a vehicle it is larger, by a factor that
    depends on the vehicle. Odometry states the noise of its points, and its steps share the error of the map.
    A filter that believes both refuses good measurements. Here the logarithm of a variance factor follows the
    innovations (after Mehra, "Approaches to adaptive filtering", IEEE TAC 1972): with χ² that of a block of
    three, over τ seconds it moves by ``min(χ²/3, 9) − 1.6``, never below zero. Where the noise is as stated,
    χ²/3 has a mean of 1, and the factor stays at 1.

    Rotation is where cameras are good, so what contradicts there is the inertial sensor, and what shakes its
    gyro shakes its accelerometer. Translation over one step is where the inertial sensor is good.

    Args:
        time_s: τ.
        most: largest factor on a standard deviation; 1 adapts nothing.
    """

    _TARGET = 1.6
    _CAP = 9.0

    def __init__(self, time_s: float, most: float) -> None:
        self._time_s = time_s
        self._most = 2.0 * float(np.log(most))
        self._logs = np.zeros(2)

    @property
    def inertial(self) -> float:
        """Factor on the standard deviations of the inertial increments."""
        return float(np.exp(0.5 * self._logs[0]))

    @property
    def translation(self) -> float:
        """Factor on the standard deviations of the odometry's translation."""
        return float(np.exp(0.5 * self._logs[1]))

    def learn(self, residual: Array, S: Array, duration_s: float) -> None:
        """Take the innovation (6,), ordered (rotation, translation), of one window, and its covariance (6, 6)."""
        squares = np.array(
            [residual[part] @ np.linalg.solve(S[part, part], residual[part]) for part in (slice(0, 3), slice(3, 6))]
        )
        step = np.minimum(squares / 3.0, self._CAP) - self._TARGET
        self._logs = np.clip(self._logs + duration_s / self._time_s * step, 0.0, self._most)

    def believe_translation(self) -> None:
        """Take the odometry's translation at its word again."""
        self._logs[1] = 0.0


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


