"""Bundle adjustment of a short window with inertial increments: the refinement of a start in motion.

Unknown are attitude, position and velocity at K instants, both biases, the rest of the camera's delay, and the
inverse depth of every point along the ray of its first view. Residuals are angles between seen and predicted rays,
with Cauchy's loss, and the inertial increments (Forster et al., IEEE T-RO 33(1), 2017, eqs. 45 and A.24 to A.30).
Position and heading at the first instant are held. Levenberg–Marquardt; points are eliminated.

Errors are local for attitudes (R ← R Exp(θ)) and additive for the rest, ordered instant by instant (θ, p, v), then
(b_g, b_a, delay).
"""

from dataclasses import dataclass

import numpy as np

from vioframe.checks import Array, Stamps
from vioframe.geometry import so3
from vioframe.tight.inertial_window import Increments
from vioframe.types import ImuBias

_ITERATIONS = 10
_CAUCHY = 2.5
_SETTLED = 1e-3
_GAUGE = 1e8
# A point at infinity has an inverse depth of zero; beyond 500 m nothing is lost.
_LEAST_INVERSE_DEPTH = 2e-3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sightings:
    """Rays in N sightings of M points; every point's first view is its anchor.

    Attributes:
        point: (N,) index of the point.
        view: (N,) index into the views.
        anchor: (M,) view in which the point is anchored, of camera 0.
        ray: (N, 3) unit, in the camera.
        anchor_ray: (M, 3).
        instant: (V,) instant of each view.
        R_body_cam: (V, 3, 3) and p_body_cam: (V, 3) of each view's camera.
        sigma: rad, of a ray.
    """

    point: Stamps
    view: Stamps
    anchor: Stamps
    ray: Array
    anchor_ray: Array
    instant: Stamps
    R_body_cam: Array
    p_body_cam: Array
    sigma: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WindowState:
    """The unknowns; the world's z axis is up.

    Attributes:
        R: (K, 3, 3), body to world; p: (K, 3) m; v: (K, 3) m/s.
        bias: of the inertial sensor.
        delay_s: the images were taken so much later than stamped.
        inverse_depth: (M,) 1/m.
    """

    R: Array
    p: Array
    v: Array
    bias: ImuBias
    delay_s: float
    inverse_depth: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BundlePriors:
    """What is known beforehand.

    Attributes:
        gravity: m/s².
        gyro_bias_sigma: rad/s, about the bias to begin with.
        accel_bias_sigma: m/s², about zero.
        delay_sigma_s: s, about zero.
    """

    gravity: float
    gyro_bias_sigma: float
    accel_bias_sigma: float
    delay_sigma_s: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BundleResult:
    """The refined window.

    Attributes:
        state: the unknowns.
        covariance: (9K + 7, 9K + 7), by the stated noise.
        visual: rms of the ray residuals in sigmas, robustly weighted.
        inliers: share of the sightings within three sigmas.
        inertial: rms of the inertial residuals in sigmas.
        scale_sigma: relative standard deviation of the size of the path.
    """

    state: WindowState
    covariance: Array
    visual: float
    inliers: float
    inertial: float
    scale_sigma: float


def refine(
    start: WindowState, sightings: Sightings, increments: Increments, rates: Array, priors: BundlePriors
) -> BundleResult | None:
    """Refine ``start``; None where the equations cannot be solved.

    Args:
        start: unknowns to begin with.
        sightings: what the cameras saw, apart from the anchors' own rays.
        increments: K − 1, between successive instants.
        rates: (K, 3) rad/s of the body at the instants, measured.
        priors: what is known beforehand.
    """
    problem = _Problem(sightings, increments, rates, priors, start)
    state, damping = start, 1e-4
    system = problem.linearise(state)
    for _ in range(_ITERATIONS):
        step = system.solve(damping)
        if step is None:
            return None
        tried = problem.moved(state, *step)
        cost = problem.cost(tried)
        if cost < system.cost:
            gained = (system.cost - cost) / max(system.cost, 1e-9)
            state, damping = tried, 0.1 * damping
            system = problem.linearise(state)
            if gained < _SETTLED:
                break
        else:
            damping *= 30.0
            if damping > 1e6:
                break
    covariance = system.covariance()
    if covariance is None:
        return None
    return problem.summary(state, covariance)


class _System:
    """Normal equations with the points eliminated."""

    def __init__(self, H: Array, g: Array, H_xd: Array, H_dd: Array, g_d: Array, cost: float) -> None:
        self._H, self._g, self._H_xd, self._H_dd, self._g_d = H, g, H_xd, H_dd, g_d
        self.cost = cost

    def solve(self, damping: float) -> tuple[Array, Array] | None:
        """Steps of the states (D,) and of the inverse depths (M,)."""
        H_dd = self._H_dd * (1.0 + damping) + 1e-9
        gain = self._H_xd / H_dd[:, None]
        reduced = self._H + damping * np.diag(np.diag(self._H)) - self._H_xd.T @ gain
        try:
            step = np.linalg.solve(reduced, -(self._g - gain.T @ self._g_d))
        except np.linalg.LinAlgError:
            return None
        if not np.isfinite(step).all():
            return None
        return step, -(self._g_d + self._H_xd @ step) / H_dd

    def covariance(self) -> Array | None:
        """Of the states, (D, D)."""
        reduced = self._H - self._H_xd.T @ (self._H_xd / (self._H_dd + 1e-9)[:, None])
        try:
            covariance = np.linalg.inv(reduced)
        except np.linalg.LinAlgError:
            return None
        good = np.isfinite(covariance).all() and np.diag(covariance).min() > 0.0
        return 0.5 * (covariance + covariance.T) if good else None


class _Problem:
    def __init__(
        self, sightings: Sightings, increments: Increments, rates: Array, priors: BundlePriors, start: WindowState
    ) -> None:
        self._s, self._increments, self._rates, self._priors = sightings, increments, rates, priors
        self._start_bias = start.bias.gyro
        self._down = np.array([0.0, 0.0, -priors.gravity])
        self._whiten = np.linalg.inv(np.linalg.cholesky(increments.covariance))
        self._size = 9 * len(start.p) + 7
        self._tangent = _tangents(sightings.ray)

    def cost(self, state: WindowState) -> float:
        e = self._visual(state)[0]
        visual = _CAUCHY**2 * np.log1p((e**2).sum(axis=1) / _CAUCHY**2).sum()
        return float(visual + (self._inertial(state)[0] ** 2).sum() + self._prior(state)[1])

    def linearise(self, state: WindowState) -> _System:
        e, J, J_depth = self._visual(state, jacobian=True)
        weight = 1.0 / (1.0 + (e**2).sum(axis=1) / _CAUCHY**2)
        root = np.sqrt(weight)[:, None]
        J = (J * root[..., None]).reshape(-1, self._size)
        e_rows, J_rows = (e * root).ravel(), (J_depth * root).ravel()
        r, G = self._inertial(state, jacobian=True)
        G, r = G.reshape(-1, self._size), r.ravel()
        prior_H, prior_cost, prior_g = self._prior(state)
        H = J.T @ J + G.T @ G + prior_H
        g = J.T @ e_rows + G.T @ r + prior_g
        points = np.repeat(self._s.point, 2)
        count = len(self._s.anchor)
        H_dd = np.bincount(points, J_rows**2, minlength=count).astype(float)
        g_d = np.bincount(points, J_rows * e_rows, minlength=count).astype(float)
        H_xd = np.zeros((count, self._size))
        order = np.argsort(points, kind="stable")
        borders = np.flatnonzero(np.diff(points[order], prepend=-1))
        H_xd[points[order][borders]] = np.add.reduceat((J * J_rows[:, None])[order], borders, axis=0)
        cost = _CAUCHY**2 * np.log1p((e**2).sum(axis=1) / _CAUCHY**2).sum() + (r**2).sum() + prior_cost
        return _System(H, g, H_xd, H_dd, g_d, float(cost))

    def moved(self, state: WindowState, step: Array, depth_step: Array) -> WindowState:
        per_instant = step[:-7].reshape(-1, 9)
        return WindowState(
            R=state.R @ so3.exp(per_instant[:, :3]),
            p=state.p + per_instant[:, 3:6],
            v=state.v + per_instant[:, 6:],
            bias=ImuBias(gyro=state.bias.gyro + step[-7:-4], accel=state.bias.accel + step[-4:-1]),
            delay_s=state.delay_s + step[-1],
            inverse_depth=np.maximum(state.inverse_depth + depth_step, _LEAST_INVERSE_DEPTH),
        )

    def summary(self, state: WindowState, covariance: Array) -> BundleResult:
        squares = (self._visual(state)[0] ** 2).sum(axis=1)
        weight = 1.0 / (1.0 + squares / _CAUCHY**2)
        inertial = self._inertial(state)[0]
        # A larger path of the same shape moves every place along its way from the middle.
        shape = np.zeros((len(state.p), 9))
        shape[:, 3:6] = state.p - state.p.mean(axis=0)
        along = np.append(shape.ravel(), np.zeros(7))
        size = float(along @ along)
        return BundleResult(
            state=state,
            covariance=covariance,
            visual=float(np.sqrt((weight * squares).sum() / max(2.0 * weight.sum() - len(self._s.anchor), 1.0))),
            inliers=float(np.mean(squares < 9.0)),
            inertial=float(np.sqrt(np.mean(inertial**2))),
            scale_sigma=float(np.sqrt(along @ covariance @ along) / size) if size > 1e-12 else np.inf,
        )

    def _visual(self, state: WindowState, *, jacobian: bool = False) -> tuple[Array, Array, Array]:
        """Residuals (N, 2) in sigmas; Jacobians (N, 2, D) by the states and (N, 2) by the inverse depth."""
        s = self._s
        rates = self._rates - state.bias.gyro
        R = state.R @ so3.exp(rates * state.delay_s)
        p = state.p + state.v * state.delay_s
        anchor = s.anchor[s.point]
        a, k = s.instant[anchor], s.instant[s.view]
        rho = state.inverse_depth[s.point]
        # All places are multiplied by the inverse depth, so that points at infinity are no exception.
        from_anchor = _turn(s.R_body_cam[anchor], s.anchor_ray[s.point]) + rho[:, None] * s.p_body_cam[anchor]
        R_ka = R[k].swapaxes(-1, -2) @ R[a]
        apart = _turn(R[k].swapaxes(-1, -2), p[a] - p[k])
        in_body = _turn(R_ka, from_anchor) + rho[:, None] * apart
        R_cam_body = s.R_body_cam[s.view].swapaxes(-1, -2)
        in_cam = _turn(R_cam_body, in_body - rho[:, None] * s.p_body_cam[s.view])
        length = np.linalg.norm(in_cam, axis=1)
        unit = in_cam / length[:, None]
        e = np.einsum("nij,ni->nj", self._tangent, unit) / s.sigma
        # Seen from behind, a ray fits as well: such a sighting is worth nothing.
        behind = np.einsum("ni,ni->n", unit, s.ray) < 0.0
        e[behind] = 1.0 / s.sigma
        if not jacobian:
            return e, np.zeros(0), np.zeros(0)
        project = self._tangent.swapaxes(-1, -2) @ (np.eye(3) - unit[:, :, None] * unit[:, None, :])
        project = project @ R_cam_body / (length * s.sigma)[:, None, None]
        project[behind] = 0.0
        by_theta_k = project @ so3.hat(in_body)
        by_theta_a = -project @ R_ka @ so3.hat(from_anchor)
        by_p = (project @ R[k].swapaxes(-1, -2)) * rho[:, None, None]
        by_delay = _turn(by_theta_k, rates[k]) + _turn(by_theta_a, rates[a]) + _turn(by_p, state.v[a] - state.v[k])
        lever = _turn(R_ka, s.p_body_cam[anchor]) + apart - s.p_body_cam[s.view]
        J = np.zeros((len(e), self._size, 2))
        row = np.arange(len(e))[:, None]
        axes = np.arange(3)
        for first, block in ((9 * k, by_theta_k), (9 * a, by_theta_a), (9 * k + 3, -by_p), (9 * a + 3, by_p)):
            J[row, first[:, None] + axes] += block.swapaxes(-1, -2)
        J[:, -1] = by_delay
        return e, J.swapaxes(-1, -2), _turn(project, lever)

    def _inertial(self, state: WindowState, *, jacobian: bool = False) -> tuple[Array, Array]:
        """Whitened residuals (K − 1, 9) and Jacobians (K − 1, 9, D)."""
        inc = self._increments
        change_g, change_a = state.bias.gyro - inc.bias.gyro, state.bias.accel - inc.bias.accel
        by_g, by_a = inc.bias_jacobian[:, :, :3], inc.bias_jacobian[:, :, 3:]
        turn = by_g[:, :3] @ change_g
        T = inc.duration_s[:, None]
        R_i, R_j = state.R[:-1], state.R[1:]
        back = R_i.swapaxes(-1, -2)
        gained_v = _turn(back, state.v[1:] - state.v[:-1] - self._down * T)
        gained_p = _turn(back, state.p[1:] - state.p[:-1] - state.v[:-1] * T - 0.5 * self._down * T**2)
        E = (inc.delta_R @ so3.exp(turn)).swapaxes(-1, -2) @ back @ R_j
        r_theta = so3.log(E)
        r = np.concatenate(
            [
                r_theta,
                gained_v - inc.delta_v - by_g[:, 3:6] @ change_g - by_a[:, 3:6] @ change_a,
                gained_p - inc.delta_p - by_g[:, 6:] @ change_g - by_a[:, 6:] @ change_a,
            ],
            axis=1,
        )
        whitened = _turn(self._whiten, r)
        if not jacobian:
            return whitened, np.zeros(0)
        count = len(r)
        G = np.zeros((count, 9, self._size))
        unbent = so3.right_jacobian_inverse(r_theta)
        for index in range(count):
            i, j = 9 * index, 9 * index + 9
            G[index, :3, i : i + 3] = -unbent[index] @ R_j[index].T @ R_i[index]
            G[index, :3, j : j + 3] = unbent[index]
            G[index, 3:6, i : i + 3] = so3.hat(gained_v[index])
            G[index, 3:6, i + 6 : i + 9] = -back[index]
            G[index, 3:6, j + 6 : j + 9] = back[index]
            G[index, 6:, i : i + 3] = so3.hat(gained_p[index])
            G[index, 6:, i + 3 : i + 6] = -back[index]
            G[index, 6:, i + 6 : i + 9] = -back[index] * inc.duration_s[index]
            G[index, 6:, j + 3 : j + 6] = back[index]
        G[:, :3, -7:-4] = -unbent @ E.swapaxes(-1, -2) @ so3.right_jacobian(turn) @ by_g[:, :3]
        G[:, 3:, -7:-4] = -by_g[:, 3:]
        G[:, 3:, -4:-1] = -by_a[:, 3:]
        return whitened, self._whiten @ G

    def _prior(self, state: WindowState) -> tuple[Array, float, Array]:
        """Normal matrix (D, D), cost and gradient (D,) of what is known beforehand, and of what is held."""
        priors = self._priors
        sigmas = np.repeat([priors.gyro_bias_sigma, priors.accel_bias_sigma, priors.delay_sigma_s], [3, 3, 1])
        off = np.concatenate([state.bias.gyro - self._start_bias, state.bias.accel, [state.delay_s]]) / sigmas
        H = np.zeros((self._size, self._size))
        H[-7:, -7:] = np.diag(1.0 / sigmas**2)
        up = state.R[0, 2]
        H[:3, :3] = _GAUGE * np.outer(up, up)
        H[3:6, 3:6] = _GAUGE * np.eye(3)
        gradient = np.zeros(self._size)
        gradient[-7:] = off / sigmas
        return H, float(off @ off), gradient


def _turn(matrices: Array, vectors: Array) -> Array:
    """Matrices (N, A, 3) times vectors (N, 3)."""
    turned: Array = (matrices @ vectors[..., None])[..., 0]
    return turned


def _tangents(rays: Array) -> Array:
    """Two unit vectors (N, 3, 2) across unit vectors (N, 3)."""
    other = np.eye(3)[np.argmin(np.abs(rays), axis=1)]
    first = np.cross(rays, other)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(rays, first)], axis=-1)
