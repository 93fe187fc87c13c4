"""The camera's path from bearings and known rotations, and what brings it into metres and upright: two linear steps.

*Path.* Seen along a ray r from the place c of a view, a point x gives (I − r rᵀ)(x − c) = 0. Points are eliminated;
of one camera the path is then the eigenvector of the smallest eigenvalue (after Cai et al., "Pose-only solution to
visual reconstruction and navigation", IEEE TPAMI 45(1), 2023), of a rig with a baseline the solution in metres.
Its size is fixed while it is solved: minimised together with the accelerometer's equations, whose lengths are
fixed, noise in the bearings would shrink it.

*Alignment.* In the body at the first instant, with the specific force integrated twice, P(t) = ∬ R f, and its
derivative −D(t) by the accelerometer bias,

    s c(t) = v t + ½ g t² + P(t) − D(t) b_a + R(t) p_body_cam − p_body_cam

is linear in (s, v, g, b_a); b_a has a prior. Then the known magnitude of g is imposed, on the 2-D tangent of its
direction (Qin, Li, Shen, "VINS-Mono", IEEE T-RO 34(4), 2018, section V-B). Were the accelerometer's sign wrong,
s would come out negative.
"""

from dataclasses import dataclass

import numpy as np

from vioframe.checks import Array, Mask

_REWEIGHTED = 3
_TANGENT_STEPS = 4
# Loose, so that an accelerometer of the wrong sign still shows.
_METRIC_SCALE_SIGMA = 0.5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Views:
    """What the cameras saw, turned into the body at the first instant.

    Attributes:
        instants: (V,) index of the instant of each view.
        direction: (V, M, 3) unit rays to M points.
        seen: (V, M).
        lever: (V, 3) m, place of the camera from the body at that instant, in this frame.
        metric: whether two cameras look at the same instants, so that lengths are known.
    """

    instants: Array
    direction: Array
    seen: Mask
    lever: Array
    metric: bool


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Path:
    """Where the body (metric) or the camera (one unknown unit) was.

    Attributes:
        places: (K, 3), the first zero; in metres, or of unit spread.
        points: (M, 3) in the same unit; NaN where a point's rays are parallel.
        ahead: share of the points that lie ahead along their rays.
        metric: whether the unit is the metre.
    """

    places: Array
    points: Array
    ahead: float
    metric: bool


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Alignment:
    """The linear answer, in the body at the first instant.

    Attributes:
        scale: metres per unit of the path; negative where force and path contradict each other in sign.
        scale_sigma: its standard deviation, for the stated uncertainty of the path.
        velocity: (3,) m/s.
        gravity: (3,) m/s², of the known magnitude, pointing down.
        accel_bias: (3,) m/s².
        free_gravity: m/s², magnitude of gravity before it was imposed.
        residual: m, rms over the path.
    """

    scale: float
    scale_sigma: float
    velocity: Array
    gravity: Array
    accel_bias: Array
    free_gravity: float
    residual: float


def solve_path(views: Views) -> Path:
    """The path and the points that the rays agree on best."""
    count = int(views.instants.max()) + 1
    projector = np.eye(3) - views.direction[..., :, None] * views.direction[..., None, :]
    depth = np.ones(views.seen.shape)
    for _ in range(_REWEIGHTED):
        weighted = projector * (views.seen / depth**2)[..., None, None]
        N, point_of = _eliminate(weighted)
        places, per_view = _places(N, views, count)
        points = point_of(per_view)
        from_view = points[None] - per_view[:, None]
        distance = np.linalg.norm(from_view, axis=-1)
        typical = float(np.nanmedian(distance)) if np.isfinite(distance).any() else 1.0
        # Relative to the scene, so that a small scene is no cheaper than a large one.
        depth = np.clip(np.nan_to_num(distance / max(typical, 1e-9), nan=1.0), 0.2, 10.0)
    way = np.einsum("vmi,vmi->vm", from_view, views.direction) * views.seen
    along = way.sum(axis=0)[np.isfinite(points).all(axis=1)]
    ahead = float(np.mean(along > 0.0)) if len(along) else 0.0
    if not views.metric and ahead < 0.5:
        # The eigenvector has no sign of its own: points lie ahead of a camera.
        return Path(places=-places, points=-points, ahead=1.0 - ahead, metric=False)
    return Path(places=places, points=points, ahead=ahead, metric=views.metric)


def _places(N: Array, views: Views, count: int) -> tuple[Array, Array]:
    """Places (K, 3) of the instants and (V, 3) of the views, from the normal equations of the views."""
    to_view = np.zeros((3 * len(views.instants), 3 * count))
    for view, instant in enumerate(views.instants):
        to_view[3 * view : 3 * view + 3, 3 * instant : 3 * instant + 3] = np.eye(3)
    # The first instant is the origin.
    reduced = (to_view.T @ N @ to_view)[3:, 3:]
    if views.metric:
        lever = views.lever.ravel()
        free = np.linalg.solve(reduced + 1e-9 * np.trace(reduced) * np.eye(len(reduced)), -(to_view.T @ N @ lever)[3:])
    else:
        lever = np.zeros(3 * len(views.instants))
        free = np.linalg.eigh(reduced)[1][:, 0]
    places = np.concatenate([np.zeros(3), free])
    return places.reshape(-1, 3), (to_view @ places + lever).reshape(-1, 3)


def _eliminate(weighted: Array) -> "tuple[Array, _PointSolver]":
    """Normal equations (3V, 3V) of the views' places with the points eliminated."""
    V, M = weighted.shape[:2]
    values, vectors = np.linalg.eigh(weighted.sum(axis=0))
    # Parallel rays fix no depth: along that direction nothing is concluded.
    usable = values > 1e-5 * values[:, 2:]
    root = vectors * np.where(usable, 1.0 / np.sqrt(np.where(usable, values, 1.0)), 0.0)[:, None, :]
    towards = weighted.transpose(1, 0, 2, 3).reshape(M, 3 * V, 3)
    gain = (towards @ root).transpose(1, 0, 2).reshape(3 * V, 3 * M)
    N = -gain @ gain.T
    diagonal = weighted.sum(axis=1)
    for view in range(V):
        N[3 * view : 3 * view + 3, 3 * view : 3 * view + 3] += diagonal[view]
    return N, _PointSolver(towards, root, ~usable[:, 0])


class _PointSolver:
    """Points from the places of the views."""

    def __init__(self, towards: Array, root: Array, degenerate: Mask) -> None:
        self._towards, self._root, self._degenerate = towards, root, degenerate

    def __call__(self, per_view: Array) -> Array:
        right = self._towards.swapaxes(-1, -2) @ per_view.ravel()
        points: Array = (self._root @ (self._root.swapaxes(-1, -2) @ right[..., None]))[..., 0]
        points[self._degenerate] = np.nan
        return points


def align(
    path: Path,
    times: Array,
    known: Array,
    bias_lever: Array,
    *,
    gravity: float,
    accel_bias_sigma: float,
    path_sigma: float,
) -> Alignment:
    """Scale, velocity, gravity and accelerometer bias that bring a path and the accelerometer together.

    Args:
        path: at K instants; one in metres is expected to keep its scale of 1.
        times: (K,) s.
        known: (K, 3) m, P(t) + R(t) p − p with the lever arm p of what moves along the path.
        bias_lever: (K, 3, 3) D(t), s².
        gravity: magnitude, m/s².
        accel_bias_sigma: of the bias beforehand, m/s² an axis.
        path_sigma: uncertainty of the path's places, m.
    """
    K = len(times)
    A = np.zeros((3 * K, 10))
    A[:, 0] = -path.places.ravel()
    A[:, 1:4] = (times[:, None, None] * np.eye(3)).reshape(-1, 3)
    A[:, 4:7] = (0.5 * times[:, None, None] ** 2 * np.eye(3)).reshape(-1, 3)
    A[:, 7:] = -bias_lever.reshape(-1, 3)
    b = -known.ravel()
    prior = np.zeros((10, 10))
    prior[7:, 7:] = (path_sigma / accel_bias_sigma) ** 2 * np.eye(3)
    N, right = A.T @ A + prior, A.T @ b
    if path.metric:
        N[0, 0] += (path_sigma / _METRIC_SCALE_SIGMA) ** 2
        right[0] += (path_sigma / _METRIC_SCALE_SIGMA) ** 2
    z = np.linalg.lstsq(N, right, rcond=None)[0]
    free = float(np.linalg.norm(z[4:7]))
    # What the accelerometer reads on average is upwards within a few degrees, however badly the rest is determined.
    g = z[4:7] if free > 0.5 * gravity else -_mean_force(known, times)
    g = gravity * g / max(float(np.linalg.norm(g)), 1e-9)
    for _ in range(_TANGENT_STEPS):
        reduce = np.zeros((10, 9))
        reduce[:4, :4], reduce[4:7, 4:6], reduce[7:, 6:] = np.eye(4), tangent(g), np.eye(3)
        fixed = np.concatenate([np.zeros(4), g, np.zeros(3)])
        z = fixed + reduce @ np.linalg.lstsq(reduce.T @ N @ reduce, reduce.T @ (right - N @ fixed), rcond=None)[0]
        g = gravity * z[4:7] / np.linalg.norm(z[4:7])
    residual = A[:, :4] @ z[:4] + A[:, 4:7] @ g + A[:, 7:] @ z[7:] - b
    return Alignment(
        scale=float(z[0]),
        scale_sigma=path_sigma * float(np.sqrt(max(np.linalg.pinv(N)[0, 0], 0.0))),
        velocity=z[1:4],
        gravity=g,
        accel_bias=z[7:],
        free_gravity=free,
        residual=float(np.sqrt(np.mean(residual**2) * 3.0)),
    )


def _mean_force(known: Array, times: Array) -> Array:
    """Direction (3,) of the specific force that was integrated to ``known``."""
    force: Array = known[-1] - known[0]
    return force


def tangent(g: Array) -> Array:
    """Two unit vectors (3, 2) across g."""
    other = np.eye(3)[int(np.argmin(np.abs(g)))]
    first = np.cross(g, other)
    first /= np.linalg.norm(first)
    second = np.cross(g / np.linalg.norm(g), first)
    return np.stack([first, second], axis=1)
