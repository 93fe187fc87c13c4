"""What the filter believes: body, calibration, past camera poses and points, with one covariance.

Errors are ordered: the body's 15 (:mod:`vioframe.error_state`), the place of camera 0 on the body (6), the camera's
delay (1), the clones (6 each, oldest first), the points (3 each). Clones are poses of camera 0 in the world with
``T_true = Exp(ξ) T``; points share the body's rotation error φ,

    f_true = Exp(φ) f + J_l(φ) ε,

so that a turn about gravity and a shift of the world are the same constant vectors whatever the estimate is
(Barrau & Bonnabel, "An EKF-SLAM algorithm with consistency properties", 2015; Zhang et al., IEEE RA-L 2017);
the camera's place has ``T_body_cam_true = T_body_cam Exp(ζ)``.
"""

import numpy as np

from vioframe.checks import Array, Mask, Stamps
from vioframe.conventions import gravity_vector
from vioframe.error_state import (
    BIAS,
    INERTIAL,
    POSITION,
    SIZE,
    THETA,
    VELOCITY,
    Body,
    invariant_from_local,
    local_from_invariant,
    process_noise,
    propagate,
    retract,
    symmetrised,
    transition,
)
from vioframe.geometry import se3, so3
from vioframe.types import ImuNoise, InertialDelta, NavState

CAMERA, DELAY, CLONES = slice(15, 21), 21, 22
# Far from the origin a turn of the world moves everything, which costs digits.
_FAR_M = 20.0


class FilterState:
    """The estimate, its covariance, and how both move on, grow and shrink.

    Args:
        noise: densities of the inertial sensor.
        gravity: magnitude, m/s².
    """

    def __init__(self, noise: ImuNoise, gravity: float) -> None:
        self._noise = noise
        self._gravity = gravity_vector(gravity)

    def start(self, state: NavState, covariance: Array, T_body_cam: Array, camera_covariance: Array) -> None:
        """Begin from a state.

        Args:
            state: of the body.
            covariance: (15, 15) in the order and error of ``NavState.covariance``.
            T_body_cam: (4, 4) of camera 0.
            camera_covariance: (7, 7) of its place (rotation, position; right perturbation) and of the delay, s².
        """
        self.body = Body.of(state)
        self.origin: Array = np.zeros(3)
        self.T_body_cam = T_body_cam.copy()
        self.delay_s = 0.0
        """How much later than stamped the images are, beyond what their stamps contain, is the fuser's to say."""
        self.R_clones: Array = np.zeros((0, 3, 3))
        self.p_clones: Array = np.zeros((0, 3))
        self.points: Array = np.zeros((0, 3))
        self.point_ids: Stamps = np.zeros(0, dtype=np.int64)
        into = invariant_from_local(self.body)
        self.covariance: Array = np.zeros((CLONES, CLONES))
        self.covariance[INERTIAL, INERTIAL] = symmetrised(into @ covariance @ into.T)
        self.covariance[SIZE:, SIZE:] = camera_covariance

    @property
    def clone_errors(self) -> slice:
        """Where the clones' errors are."""
        return slice(CLONES, CLONES + 6 * len(self.p_clones))

    @property
    def point_errors(self) -> slice:
        """Where the points' errors are."""
        return slice(self.clone_errors.stop, len(self.covariance))

    def propagate(self, delta: InertialDelta) -> None:
        """Move body and covariance over a window; ``delta`` must hold at the body's bias.

        A point's error is told in the body's rotation error, so what is added to that turns it too.
        """
        before = self.body
        self.body = propagate(before, delta, self._gravity)
        phi, noise_map = transition(before, self.body, delta, self._gravity)
        P = self.covariance
        if len(self.points):
            turned = (so3.hat(self.points) @ self.body.R).reshape(-1, 3)
            noise_map = np.concatenate([noise_map, np.zeros((len(turned), 9))])
            noise_map[SIZE:, 0:3] = turned
            P[self.point_errors] += (noise_map[SIZE:] @ delta.bias_jacobian) @ P[BIAS]
            P[INERTIAL] = phi @ P[INERTIAL]
            P[:, self.point_errors] += P[:, BIAS] @ (noise_map[SIZE:] @ delta.bias_jacobian).T
        else:
            P[INERTIAL] = phi @ P[INERTIAL]
        P[:, INERTIAL] = P[:, INERTIAL] @ phi.T
        added = process_noise(noise_map, delta, self._noise)
        points = self.point_errors
        P[INERTIAL, INERTIAL] += added[INERTIAL, INERTIAL]
        P[INERTIAL, points] += added[INERTIAL, SIZE:]
        P[points, INERTIAL] += added[SIZE:, INERTIAL]
        P[points, points] += added[SIZE:, SIZE:]

    def add_clone(self, later_s: float, rate: Array) -> None:
        """Append the pose of camera 0 at the time of the image.

        Args:
            later_s: s, how much later than the body's state the image was taken, by the estimated delay.
            rate: (3,) rad/s, of the body at the state, without bias.
        """
        T_world_cam, J = self.camera_pose(later_s, rate)
        at = self.clone_errors.stop
        size = len(self.covariance)
        rows = J @ self.covariance[:CLONES]
        corner = symmetrised(rows[:, :CLONES] @ J.T)
        grown = np.empty((size + 6, size + 6))
        old, new = np.r_[0:at, at + 6 : size + 6], slice(at, at + 6)
        grown[np.ix_(old, old)] = self.covariance
        grown[new, old] = rows
        grown[old, new] = rows.T
        grown[new, new] = corner
        self.covariance = grown
        self.R_clones = np.concatenate([self.R_clones, T_world_cam[None, :3, :3]])
        self.p_clones = np.concatenate([self.p_clones, T_world_cam[None, :3, 3]])

    def camera_pose(self, later_s: float, rate: Array) -> tuple[Array, Array]:
        """Pose (4, 4) of camera 0 ``later_s`` after the state, and its Jacobian (6, 22) by body's and camera's errors.

        Args:
            later_s: s, short: rate and velocity are taken as constant.
            rate: (3,) rad/s, of the body.
        """
        body = self.body
        R = body.R @ so3.exp(rate * later_s)
        p = body.p + body.v * later_s
        T_world_cam = se3.from_parts(R, p) @ self.T_body_cam
        J = np.zeros((6, CLONES))
        J[0:3, THETA] = J[3:6, POSITION] = np.eye(3)
        J[3:6, VELOCITY] = later_s * np.eye(3)
        # A bias of the gyro turns the body between its state and the image.
        turned = R @ so3.right_jacobian(rate * later_s) * later_s
        J[0:3, BIAS][:, 0:3] = -turned
        J[3:6, BIAS][:, 0:3] = -so3.hat(p) @ turned
        J[:, CAMERA] = se3.adjoint(T_world_cam)
        world_rate = R @ rate
        J[0:3, DELAY] = world_rate
        J[3:6, DELAY] = body.v + np.cross(p, world_rate)
        return T_world_cam, J

    def drop_clone(self, index: int) -> None:
        """Marginalise a clone."""
        start = CLONES + 6 * index
        self._keep(np.r_[0:start, start + 6 : len(self.covariance)])
        self.R_clones = np.delete(self.R_clones, index, axis=0)
        self.p_clones = np.delete(self.p_clones, index, axis=0)

    def add_points(self, ids: Stamps, points: Array, J: Array, noise: Array) -> None:
        """Append points whose errors are ``J · error + noise``.

        Args:
            ids: (N,) of their tracks.
            points: (N, 3) m.
            J: (N, 3, n) by the errors before.
            noise: (N, 3, 3).
        """
        count = 3 * len(ids)
        J = J.reshape(count, len(self.covariance))
        size = len(self.covariance)
        grown = np.empty((size + count, size + count))
        grown[:size, :size] = self.covariance
        rows = J @ self.covariance
        grown[size:, :size] = rows
        grown[:size, size:] = rows.T
        corner = rows @ J.T
        blocks = np.arange(count).reshape(-1, 3)
        corner[blocks[:, :, None], blocks[:, None, :]] += noise
        grown[size:, size:] = symmetrised(corner)
        self.covariance = grown
        self.points = np.concatenate([self.points, points])
        self.point_ids = np.concatenate([self.point_ids, ids])

    def drop_points(self, drop: Mask) -> None:
        """Marginalise points, (L,)."""
        if not drop.any():
            return
        keep = np.ones(len(self.covariance), dtype=bool)
        keep[self.point_errors] = np.repeat(~drop, 3)
        self._keep(np.flatnonzero(keep))
        self.points = self.points[~drop]
        self.point_ids = self.point_ids[~drop]

    def apply(self, error: Array) -> None:
        """Take an estimated error (n,) into the estimate."""
        self.body = retract(self.body, error[INERTIAL])
        self.T_body_cam = self.T_body_cam @ se3.exp(error[CAMERA])
        self.delay_s += float(error[DELAY])
        if len(self.p_clones):
            T = se3.exp(error[self.clone_errors].reshape(-1, 6))
            self.p_clones = (T[:, :3, :3] @ self.p_clones[..., None])[..., 0] + T[:, :3, 3]
            self.R_clones = T[:, :3, :3] @ self.R_clones
        if len(self.points):
            phi = error[THETA]
            shift = error[self.point_errors].reshape(-1, 3)
            self.points = self.points @ so3.exp(phi).T + shift @ so3.left_jacobian(phi).T

    def tidy(self) -> None:
        """Take rounding off, and move the origin of the equations near the body where it has gone far."""
        self.covariance = symmetrised(self.covariance)
        self.body = Body(R=so3.normalise(self.body.R), p=self.body.p, v=self.body.v, bias=self.body.bias)
        self.T_body_cam[:3, :3] = so3.normalise(self.T_body_cam[:3, :3])
        if np.linalg.norm(self.body.p) > _FAR_M:
            self._move_origin(self.body.p.copy())

    def _move_origin(self, by: Array) -> None:
        """Count places from ``by`` on: an exact change of the errors, ρ ← ρ − hat(by) φ."""
        turn = -so3.hat(by)
        P = self.covariance
        clones = self.clone_errors
        thetas = P[THETA].copy()
        P[POSITION] += turn @ thetas
        P[self.point_errors] += np.tile(turn, (len(self.points), 1)) @ thetas
        blocks = P[clones].reshape(-1, 6, len(P))
        blocks[:, 3:6] += turn @ blocks[:, 0:3]
        P[clones] = blocks.reshape(-1, len(P))
        columns = P[:, THETA].copy()
        P[:, POSITION] += columns @ turn.T
        P[:, self.point_errors] += np.tile(columns @ turn.T, (1, len(self.points)))
        blocks = P[:, clones].reshape(len(P), -1, 6)
        blocks[..., 3:6] += blocks[..., 0:3] @ turn.T
        P[:, clones] = blocks.reshape(len(P), -1)
        self.origin = self.origin + by
        self.body = Body(R=self.body.R, p=self.body.p - by, v=self.body.v, bias=self.body.bias)
        self.p_clones = self.p_clones - by
        self.points = self.points - by

    def _keep(self, places: Stamps) -> None:
        self.covariance = self.covariance[np.ix_(places, places)]

    def nav_state(self, stamp_ns: int) -> NavState:
        """The body in the convention of :class:`~vioframe.types.NavState`."""
        into = local_from_invariant(self.body)
        return NavState(
            stamp_ns=stamp_ns,
            T_world_body=se3.from_parts(self.body.R, self.body.p + self.origin),
            v_world_body=self.body.v.copy(),
            bias=self.body.bias,
            covariance=symmetrised(into @ self.covariance[INERTIAL, INERTIAL] @ into.T),
        )
