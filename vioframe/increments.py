"""Inertial increments cut into parts, widened for holes, and made up where no sample came."""

from dataclasses import replace

import numpy as np

from vioframe.checks import Array
from vioframe.conventions import NANOSECONDS
from vioframe.error_state import Body
from vioframe.geometry import so3
from vioframe.types import InertialDelta


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


def coasting(
    body: Body, duration_s: float, gravity: Array, rate_sigma: float, accel_sigma: float, since_s: float = 0.0
) -> InertialDelta:
    """The increment of a stretch without any sample: constant velocity and attitude, and little trust in it.

    Args:
        body: at the start of the stretch.
        duration_s: of the stretch.
        gravity: (3,) m/s², in the world.
        rate_sigma: rad/s, of an unknown constant rate.
        accel_sigma: m/s², of an unknown constant acceleration.
        since_s: how long there had been no measurement at all before it. Rate and acceleration are the same unknown
            ones all the time, so variances grow with the square of the time: in pieces as at once.
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
    # (since + duration)² − since², beside duration².
    more = float(np.sqrt(1.0 + 2.0 * since_s / duration_s))
    return add_gap(blank, duration_s, more * rate_sigma, more * accel_sigma)
