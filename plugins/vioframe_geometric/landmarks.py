"""Points of the map: inverse depth from a fixed anchor, with a covariance, all in parallel arrays.

``x = o + R_o (a, b, 1)ᵀ / ρ`` (Civera, Davison, Montiel 2008, without the anchor's pose as a state: o and R_o are
constants that only choose coordinates in which the error of a young point is normal). In these coordinates the pixel
of a point is nearly linear in ρ, also where its depth is hardly known.
"""

from collections.abc import Sequence

import numpy as np

from vioframe.checks import Array, Stamps
from vioframe_geometric.pose import View, pose_jacobian, stack_residuals

# χ² of four and two degrees of freedom at 99.9 %.
_REGULARITY = 0.01
_GATE = {2: 13.8, 4: 18.5}


class Landmarks:
    """A growing and shrinking set of points.

    Attributes:
        ids: (N,) of the tracks, ascending.
        origins: (N, 3) o, in the map frame.
        rotations: (N, 3, 3) R_o.
        q: (N, 3) of (a, b, ρ).
        covariance: (N, 3, 3) of q.
        strikes: (N,) observations rejected in a row.
        views: (N,) observations used.
        prior_q, prior_information: (N, 3), (N, 3, 3) what is known of q besides the keyframes of the window.
    """

    __slots__ = (
        "covariance",
        "ids",
        "min_inverse_depth",
        "origins",
        "prior_information",
        "prior_q",
        "q",
        "rotations",
        "strikes",
        "views",
    )

    def __init__(self, min_inverse_depth: float) -> None:
        """Make an empty set; no point is taken to be further away than ``1 / min_inverse_depth``."""
        self.min_inverse_depth = min_inverse_depth
        self.ids: Stamps = np.zeros(0, dtype=np.int64)
        self.origins = np.zeros((0, 3))
        self.rotations = np.zeros((0, 3, 3))
        self.q = np.zeros((0, 3))
        self.covariance = np.zeros((0, 3, 3))
        self.strikes = np.zeros(0, dtype=np.int64)
        self.views = np.zeros(0, dtype=np.int64)
        self.prior_q = np.zeros((0, 3))
        self.prior_information = np.zeros((0, 3, 3))

    def __len__(self) -> int:
        return len(self.ids)

    def keep(self, which: np.ndarray) -> None:
        """Drop all but a mask (N,)."""
        for name in self.__slots__:
            if name != "min_inverse_depth":
                setattr(self, name, getattr(self, name)[which])

    def add(self, ids: Stamps, T_map_cam: Array, ideal: Array, inverse_depth: Array, covariance: Array) -> None:
        """Add points first seen from ``T_map_cam`` (4, 4), with ids larger than any before.

        Args:
            ids: (K,) ascending.
            T_map_cam: (4, 4) becomes their anchor.
            ideal: (K, 2) normalised coordinates.
            inverse_depth: (K,).
            covariance: (K, 3, 3) of (a, b, ρ).
        """
        count = len(ids)
        self.ids = np.concatenate([self.ids, ids])
        self.origins = np.concatenate([self.origins, np.tile(T_map_cam[:3, 3], (count, 1))])
        self.rotations = np.concatenate([self.rotations, np.tile(T_map_cam[:3, :3], (count, 1, 1))])
        self.q = np.concatenate([self.q, np.concatenate([ideal, inverse_depth[:, None]], axis=-1)])
        self.covariance = np.concatenate([self.covariance, covariance])
        self.strikes = np.concatenate([self.strikes, np.zeros(count, dtype=np.int64)])
        self.views = np.concatenate([self.views, np.ones(count, dtype=np.int64)])
        self.prior_q = np.concatenate([self.prior_q, self.q[-count:] if count else self.q[:0]])
        information = np.zeros((count, 3, 3))
        # Enough to keep the equations regular where a point shows no parallax, too weak to bend the scale.
        information[:, 2, 2] = _REGULARITY / covariance[:, 2, 2]
        self.prior_information = np.concatenate([self.prior_information, information])
        order = np.argsort(self.ids, kind="stable")
        if np.any(order[1:] < order[:-1]):
            self.keep(order)

    def find(self, ids: Stamps) -> tuple[np.ndarray, np.ndarray]:
        """Index of each id (M,), and known (M,): False where there is no such point (the index is then 0)."""
        if len(self.ids) == 0:
            return np.zeros(len(ids), dtype=np.int64), np.zeros(len(ids), dtype=bool)
        index = np.minimum(np.searchsorted(self.ids, ids), len(self.ids) - 1)
        known = self.ids[index] == ids
        return np.where(known, index, 0), known

    def points(self, index: np.ndarray) -> Array:
        """Positions (M, 3) in the map frame."""
        q = self.q[index]
        ray = np.concatenate([q[:, :2], np.ones((len(q), 1))], axis=-1) / q[:, 2:]
        points: Array = self.origins[index] + (self.rotations[index] @ ray[..., None])[..., 0]
        return points

    def slopes(self, index: np.ndarray) -> Array:
        """∂x/∂q (M, 3, 3)."""
        q = self.q[index]
        inverse = 1.0 / q[:, 2]
        out = np.zeros((len(q), 3, 3))
        out[:, 0, 0] = out[:, 1, 1] = inverse
        out[:, 0, 2] = -q[:, 0] * inverse**2
        out[:, 1, 2] = -q[:, 1] * inverse**2
        out[:, 2, 2] = -(inverse**2)
        slope: Array = self.rotations[index] @ out
        return slope

    def point_covariance(self, index: np.ndarray) -> Array:
        """Covariance (M, 3, 3) of the positions."""
        slope = self.slopes(index)
        covariance: Array = slope @ self.covariance[index] @ np.swapaxes(slope, -1, -2)
        return covariance

    def point_root(self, index: np.ndarray) -> Array:
        """S (M, 3, 3) with S Sᵀ the covariance of the positions."""
        root: Array = self.slopes(index) @ _root(self.covariance[index])
        return root

    def rescale(self, factor: float, centre: Array) -> None:
        """Multiply all distances from ``centre`` (3,) by ``factor``."""
        self.origins = centre + factor * (self.origins - centre)
        self.q[:, 2] /= factor
        self.prior_q[:, 2] /= factor
        self.covariance[:, 2, :] /= factor
        self.covariance[:, :, 2] /= factor
        self.prior_information[:, 2, :] *= factor
        self.prior_information[:, :, 2] *= factor

    def update(
        self,
        index: np.ndarray,
        T_map_cam: Array,
        views: Sequence[View],
        *,
        sigma_px: float,
        pose_covariance: Array | None = None,
    ) -> np.ndarray:
        """Kalman update of each point by its observations from a pose, one by one but all at once.

        Args:
            index: (M,) distinct.
            T_map_cam: (4, 4).
            views: of M rays each.
            sigma_px: of a pixel coordinate.
            pose_covariance: (6, 6) of the pose, widens the innovation.

        Returns:
            accepted (M,): seen, before the camera and inside the χ² gate. Others are left alone and get a strike.
        """
        R, p = T_map_cam[:3, :3], T_map_cam[:3, 3]
        points_cam = (self.points(index) - p) @ R
        error, slope, ahead = stack_residuals(views, points_cam)
        size = error.shape[-1]
        H = slope @ (R.T @ self.slopes(index))
        P = self.covariance[index]
        noise = np.broadcast_to(sigma_px**2 * np.eye(size), (len(index), size, size))
        if pose_covariance is not None:
            J = slope @ pose_jacobian(points_cam)
            noise = noise + J @ pose_covariance @ np.swapaxes(J, -1, -2)
        PHt = P @ np.swapaxes(H, -1, -2)
        inverse = np.linalg.inv(H @ PHt + noise)
        gain = PHt @ inverse
        weighted = (inverse @ error[..., None])[..., 0]
        distance = np.sum(error * weighted, axis=-1)
        seen = np.stack([view.seen for view in views])
        gate = np.where(seen.sum(axis=0) > 1, _GATE[4], _GATE[2])
        accepted: np.ndarray = ahead & seen.any(axis=0) & (distance < gate)
        step = -(gain @ error[..., None])[..., 0]
        shrunk = P - gain @ np.swapaxes(PHt, -1, -2)
        chosen = index[accepted]
        self.q[chosen] += step[accepted]
        self.q[chosen, 2] = np.maximum(self.q[chosen, 2], self.min_inverse_depth)
        self.covariance[chosen] = 0.5 * (shrunk + np.swapaxes(shrunk, -1, -2))[accepted]
        self.views[chosen] += 1
        self.strikes[chosen] = 0
        self.strikes[index[~accepted & seen.any(axis=0)]] += 1
        return accepted


def _root(covariance: Array) -> Array:
    """Square roots (M, 3, 3) of covariances, also of one that rounding has made slightly indefinite."""
    try:
        return np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(covariance)
        root: Array = vectors * np.sqrt(np.maximum(values, 1e-14))[:, None, :]
        return root
