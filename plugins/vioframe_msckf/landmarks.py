"""Points in the state: what the newest image says about them."""

from dataclasses import dataclass

import numpy as np

from vioframe.checks import Array, Mask, Stamps
from vioframe.error_state import THETA
from vioframe.geometry import so3
from vioframe_msckf.correction import correct_by_residuals
from vioframe_msckf.state import CLONES, FilterState
from vioframe_msckf.track_update import point_jacobian


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sightings:
    """Points of the state seen in the newest image.

    Attributes:
        index: (m,) which point.
        R: (m, 3, 3) and p: (m, 3) m, of the camera that saw it.
        measured: (m, 2) on the normalised plane.
        weights: (m,) 1/σ.
    """

    index: Stamps
    R: Array
    p: Array
    measured: Array
    weights: Array


def correct_by_sightings(
    state: FilterState, sightings: Sightings, limit: float, nearest_m: float, gate_noise: float = 1.0
) -> Mask:
    """Correct by all sightings that fit one by one; say which did, (m,).

    Args:
        state: its newest clone is the image's.
        sightings: at most one a point and camera.
        limit: largest χ² of a sighting that is used.
        gate_noise: variance of a sighting's noise that the gate assumes, in units of what the correction assumes.
        nearest_m: a point that comes nearer than this to the camera, or behind it, does not fit.
    """
    f = state.points[sightings.index]
    depth = ((f - sightings.p) * sightings.R[:, :, 2]).sum(axis=-1)
    ahead = depth > nearest_m
    fits = np.zeros(len(f), dtype=bool)
    if not ahead.any():
        return fits
    f, index, weights = f[ahead], sightings.index[ahead], sightings.weights[ahead]
    uv, J = point_jacobian(sightings.R[ahead], sightings.p[ahead], f)
    J = weights[:, None, None] * J
    residual = weights[:, None] * (sightings.measured[ahead] - uv)
    crossed = so3.hat(f)

    P = state.covariance
    clone = state.clone_errors.stop - 6
    turns = P[THETA] - P[clone : clone + 3]
    points = P[state.point_errors].reshape(-1, 3, len(P))[index]
    HP = J @ (points - crossed @ turns - P[clone + 3 : clone + 6])
    flat = HP.reshape(-1, len(P))
    turns_t = flat[:, THETA] - flat[:, clone : clone + 3]
    at_points = flat[:, state.point_errors].reshape(len(flat), -1, 3)[:, index]
    HPH = (
        at_points
        - (turns_t[:, None, None, :] @ crossed.transpose(0, 2, 1))[:, :, 0]
        - flat[:, None, clone + 3 : clone + 6]
    )
    S = (HPH[:, :, None, :] @ J.transpose(0, 2, 1))[:, :, 0].reshape(len(flat), -1)
    S[np.diag_indices_from(S)] += 1.0

    each = np.arange(len(f))
    # Slow drift of a tracker is noise that a correction must not count often, yet no excuse for an outlier.
    blocks = S.reshape(len(f), 2, len(f), 2)[each, :, each] - (1.0 - gate_noise) * np.eye(2)
    chi = (residual * np.linalg.solve(blocks, residual[..., None])[..., 0]).sum(axis=-1)
    good = chi < limit
    if good.any():
        rows = np.repeat(good, 2)
        used = correct_by_residuals(state, flat[rows], S[np.ix_(rows, rows)], residual[good].reshape(-1))
        fits[ahead] = good & used
    return fits


def add_landmarks(state: FilterState, ids: Stamps, found: Array, by_clones: Array, noise: Array) -> None:
    """Take points into the state that were found from all clones.

    Args:
        state: grows.
        ids: (N,) of the tracks.
        found: (N, 3) m.
        by_clones: (N, 3, 6M) error of each point by those of the clones.
        noise: (N, 3, 3), of the rest of its error.
    """
    J = np.zeros((len(ids), 3, len(state.covariance)))
    J[:, :, CLONES : CLONES + by_clones.shape[2]] = by_clones
    # A point's error in the state is told beyond the turn of the body's.
    J[:, :, THETA] += so3.hat(found)
    state.add_points(ids, found, J, noise)
