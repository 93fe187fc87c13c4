"""The window of keyframes of a local map: when one is due, bundle adjustment, and what the oldest leaves behind."""

from dataclasses import replace

import numpy as np

from vioframe.checks import Array
from vioframe.types import Tracks
from vioframe_geometric.bundle import BundleProblem, adjust
from vioframe_geometric.map_state import MAX_STRIKES, Keyframe, LocalMap, make_keyframe
from vioframe_geometric.pose import View, cauchy_weights
from vioframe_geometric.rays import Rays, residuals

_ITERATIONS = 4
# Width of the Cauchy cost, standard deviations.
_ROBUST = 2.0
# Normalised error at which a keyframe contradicts a point.
_CONTRADICTED = 4.0
# Relative standard deviation of the inverse depth below which a point has a say in the scale.
_KNOWN_DEPTH = 0.3


class KeyframeWindow:
    """Adds keyframes to a map and adjusts them together.

    Args:
        size: keyframes adjusted together.
        fixed: of them, the oldest, that stay where they are once the window is full.
        parallax_px: median displacement beyond rotation since the last keyframe that asks for a new one.
        share: share of points in common with the last keyframe below which there is a new one.
    """

    def __init__(self, *, size: int, fixed: int, parallax_px: float, share: float) -> None:
        self._size = size
        self._fixed = fixed
        self._parallax = parallax_px
        self._share = share

    def is_due(self, local: LocalMap, tracks: Tracks, T_map_cam: Array) -> bool:
        """Whether the view has moved, or changed, enough since the last keyframe."""
        last = local.keyframes[-1]
        _, first, second = np.intersect1d(last.ids, tracks.ids, assume_unique=True, return_indices=True)
        if len(first) < self._share * len(tracks):
            return True
        R_last_cam = last.T_map_cam[:3, :3].T @ T_map_cam[:3, :3]
        apart = last.rays.axes[first] - tracks.bearings[second] @ R_last_cam.T
        return bool(np.median(np.linalg.norm(apart, axis=-1)) * local.focal_px > self._parallax)

    def add(self, local: LocalMap, tracks: Tracks, view: View, T_map_cam: Array) -> None:
        """Make a keyframe of a located view, retire the oldest of a full window, and adjust."""
        local.keyframes.append(make_keyframe(tracks, view.rays, T_map_cam))
        if len(local.keyframes) > self._size:
            _retire(local, local.keyframes.pop(0))
            local.scale_held = True
        self.adjust(local)

    def adjust(self, local: LocalMap) -> None:
        """Bundle-adjust the keyframes and the landmarks that at least two of them see."""
        keyframes, landmarks = local.keyframes, local.landmarks
        found = [landmarks.find(keyframe.ids) for keyframe in keyframes]
        seen_by = np.zeros(len(landmarks), dtype=np.int64)
        for index, known in found:
            seen_by[index[known]] += 1
        chosen = np.flatnonzero(seen_by >= 2)
        if len(chosen) < local.min_points:
            return
        rays, seen = _grid(keyframes, found, chosen, len(landmarks))
        full = len(keyframes) == self._size
        result = adjust(
            BundleProblem(
                T_map_cam=np.stack([keyframe.T_map_cam for keyframe in keyframes]),
                free=np.arange(len(keyframes)) >= (self._fixed if full else 1),
                origins=landmarks.origins[chosen],
                rotations=landmarks.rotations[chosen],
                q=landmarks.q[chosen],
                prior_q=landmarks.prior_q[chosen],
                prior_information=landmarks.prior_information[chosen],
                rays=rays,
                seen=seen,
                sigma_px=local.noise.sigma_px,
                min_inverse_depth=landmarks.min_inverse_depth,
            ),
            iterations=_ITERATIONS,
            robust_scale=_ROBUST,
        )
        before = landmarks.q[chosen, 2].copy()
        landmarks.q[chosen] = result.q
        landmarks.covariance[chosen] = result.q_covariance
        # A point that most of its keyframes contradict is no point.
        bad = (result.errors > _CONTRADICTED).sum(axis=0) > 0.5 * seen.sum(axis=0)
        landmarks.strikes[chosen[bad]] = MAX_STRIKES
        local.keyframes = [
            replace(keyframe, T_map_cam=T) for keyframe, T in zip(keyframes, result.T_map_cam, strict=True)
        ]
        if not local.scale_held:
            # Until a keyframe has retired, only the damping holds the scale: put it back where it was.
            known = np.sqrt(landmarks.covariance[chosen, 2, 2]) < _KNOWN_DEPTH * landmarks.q[chosen, 2]
            if known.sum() >= local.min_points:
                local.rescale(float(np.median(landmarks.q[chosen, 2][known] / before[known])))


def _retire(local: LocalMap, keyframe: Keyframe) -> None:
    """Turn what a keyframe saw into prior knowledge of the points, its pose taken as known."""
    landmarks = local.landmarks
    index, known = landmarks.find(keyframe.ids)
    rows = np.flatnonzero(known)
    index = index[rows]
    R = keyframe.T_map_cam[:3, :3]
    points_cam = (landmarks.points(index) - keyframe.T_map_cam[:3, 3]) @ R
    error, slope, ahead = residuals(keyframe.rays.select(rows), points_cam)
    variance = local.noise.sigma_px**2
    squared = 0.5 * np.sum(error * error, axis=-1) / variance
    weight = np.where(ahead, cauchy_weights(squared, _ROBUST), 0.0) / variance
    J = slope @ (R.T @ landmarks.slopes(index))
    weighted = np.swapaxes(J, -1, -2) * weight[:, None, None]
    prior = landmarks.prior_information[index]
    off = landmarks.q[index] - landmarks.prior_q[index]
    gradient = prior @ off[..., None] + weighted @ error[..., None]
    total = prior + weighted @ J
    # The sum of the two quadratics has its minimum one Newton step from here.
    step = np.linalg.solve(total + 1e-9 * np.eye(3), gradient)[..., 0]
    landmarks.prior_information[index] = total
    landmarks.prior_q[index] = landmarks.q[index] - step


def _grid(
    keyframes: list[Keyframe], found: list[tuple[np.ndarray, np.ndarray]], chosen: np.ndarray, count: int
) -> tuple[Rays, np.ndarray]:
    """Rays of the chosen landmarks in all keyframes (K·M rows), and seen (K, M).

    Args:
        keyframes: K.
        found: index of the landmark of each of their observations, and whether there is one.
        chosen: (M,) of ``count`` landmarks.
    """
    slot = np.full(count, -1)
    slot[chosen] = np.arange(len(chosen))
    shape = (len(keyframes), len(chosen))
    seen = np.zeros(shape, dtype=bool)
    rows = np.zeros((*shape, 2, 3))
    axes = np.zeros((*shape, 3))
    for k, ((index, known), keyframe) in enumerate(zip(found, keyframes, strict=True)):
        which = np.flatnonzero(known & (slot[index] >= 0))
        where = slot[index[which]]
        seen[k, where] = True
        rows[k, where] = keyframe.rays.rows[which]
        axes[k, where] = keyframe.rays.axes[which]
    flat = axes.reshape(-1, 3)
    return Rays(rows=rows.reshape(-1, 2, 3), axes=flat, origins=np.zeros_like(flat)), seen
