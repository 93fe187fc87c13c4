"""``vo=local_map``: monocular motion in one unit, against a local map of landmarks."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from vioframe.checks import Array, Stamps
from vioframe.errors import ConfigError, StateError
from vioframe.geometry import se3
from vioframe.geometry.triangulation import triangulate
from vioframe.interfaces import CONSISTENT_SCALE, RELATIVE_POSE, TRACKS, VOEstimator
from vioframe.types import Camera, RelativePose, SensorRig, Tracks, VisualFeatures
from vioframe_geometric.epipolar import Pairs, fit_rotation, fit_two_view, pair, parallax_px
from vioframe_geometric.landmarks import Landmarks
from vioframe_geometric.bundle import BundleProblem, adjust
from vioframe_geometric.pose import View, cauchy_weights
from vioframe_geometric.rays import Rays, observe, residuals
from vioframe_geometric.tracking import Fix, PixelNoise, locate, relative_covariance, select_view
from vioframe_geometric.two_view import common_points, first_camera, require_positive

log = logging.getLogger(__name__)

# The unit of length of a map is the median depth of its first points; nothing is further than a thousand of them.
_MIN_INVERSE_DEPTH = 1e-3
_MAX_STRIKES = 2
_MAX_DIRECTION = np.radians(6.0)
_INLIER = 3.0
_MIN_COMMON = 0.5
_MAX_EARLIER = 12


def _stretch(T: Array, factor: float, centre: Array) -> Array:
    out = T.copy()
    out[:3, 3] = centre + factor * (T[:3, 3] - centre)
    return out


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Keyframe:
    """A located view: ids (M,) ascending, and their rays."""

    T_map_cam: Array
    ids: Stamps
    rays: Rays


class LocalMapVO(VOEstimator):
    """Monocular: map, locate, extend."""

    requires: ClassVar[frozenset[str]] = frozenset({TRACKS})
    provides: ClassVar[frozenset[str]] = frozenset({RELATIVE_POSE, CONSISTENT_SCALE})

    def __init__(
        self,
        *,
        sigma_px: float = 0.5,
        adapt_sigma: bool = True,
        min_points: int = 12,
        start_parallax_px: float = 15.0,
        start_points: int = 30,
        keyframe_parallax_px: float = 10.0,
        keyframe_share: float = 0.7,
        window: int = 8,
        fixed: int = 2,
        drift_px: float = 0.05,
        covariance_scale: float = 1.0,
    ) -> None:
        require_positive(sigma_px=sigma_px, start_parallax_px=start_parallax_px, covariance_scale=covariance_scale)
        self._start_sigma = sigma_px
        self._adapt = adapt_sigma
        self._min_points = min_points
        self._start_parallax = start_parallax_px
        self._start_points = start_points
        self._keyframe_parallax = keyframe_parallax_px
        self._keyframe_share = keyframe_share
        self._window = window
        self._fixed = fixed
        self._drift = drift_px
        self._covariance_scale = covariance_scale
        self._camera: Camera | None = None

    def setup(self, rig: SensorRig) -> None:
        self._camera = first_camera(rig, "local_map")
        self._focal = float(np.mean(self._camera.intrinsics_px[:2]))
        self._unit = 1.0
        self._noise = PixelNoise(self._start_sigma)
        self._stamp_ns: int | None = None
        self._forget()

    def _forget(self) -> None:
        self._landmarks = Landmarks(_MIN_INVERSE_DEPTH)
        self._keyframes: list[Keyframe] = []
        self._scale_held = False
        self._earlier: list[Tracks] = []
        self._tried_px = 0.0
        self._fix: Fix | None = None
        self._motion = np.eye(4)
        self._missed = 0

    def estimate(self, previous: VisualFeatures, current: VisualFeatures) -> RelativePose:
        if self._camera is None:
            raise StateError("LocalMapVO.estimate was called before setup(rig): set it up first")
        if previous.tracks is None or current.tracks is None:
            return RelativePose.invalid()
        if self._stamp_ns != previous.frame.stamp_ns:
            self._advance(previous.tracks)
        before = self._fix
        after = self._advance(current.tracks, previous.tracks)
        self._stamp_ns = current.frame.stamp_ns
        if before is None:
            before = self._fix_before
        if before is None or after is None:
            return RelativePose.invalid()
        T_prev_cur = se3.inverse(before.T_map_cam) @ after.T_map_cam
        self._motion = T_prev_cur
        covariance = self._covariance_scale * relative_covariance(before.covariance, after.covariance, T_prev_cur)
        return RelativePose(T_prev_cur=T_prev_cur, covariance=covariance, valid=True, inliers=after.inliers)

    def _advance(self, tracks: Tracks, previous: Tracks | None = None) -> Fix | None:
        self._fix_before = None
        if len(self._landmarks) == 0:
            self._start(tracks)
            if len(self._landmarks) == 0:
                return None
            if previous is not None:
                self._fix_before = self._locate(previous, [self._T_map_cam, np.eye(4)])
                if self._fix_before is not None:
                    self._motion = se3.inverse(self._fix_before.T_map_cam) @ self._T_map_cam
        fix = self._locate(tracks, [self._T_map_cam @ self._motion, self._T_map_cam])
        self._fix = fix
        if fix is None:
            self._missed += 1
            self._motion = np.eye(4)
            if self._missed > 10:
                self._forget()
            return None
        if self._adapt:
            self._noise.learn(fix.errors)
        self._missed = 0
        self._T_map_cam = fix.T_map_cam
        view = self._view(tracks)
        self._landmarks.update(
            fix.index, fix.T_map_cam, [select_view(view, fix.rows)], sigma_px=self._noise.sigma_px, pose_covariance=fix.covariance
        )
        self._extend(tracks, view)
        if self._window and self._is_keyframe(tracks):
            self._add_keyframe(tracks, view)
            self._fix = replace(fix, T_map_cam=self._T_map_cam)
            return self._fix
        return fix

    def _is_keyframe(self, tracks: Tracks) -> bool:
        """Whether the view has moved, or changed, enough since the last keyframe."""
        if not self._keyframes:
            return True
        last = self._keyframes[-1]
        _, first, second = np.intersect1d(last.ids, tracks.ids, assume_unique=True, return_indices=True)
        if len(first) < self._keyframe_share * len(tracks):
            return True
        R_last_cam = last.T_map_cam[:3, :3].T @ self._T_map_cam[:3, :3]
        apart = last.rays.axes[first] - tracks.bearings[second] @ R_last_cam.T
        return bool(np.median(np.linalg.norm(apart, axis=-1)) * self._focal > self._keyframe_parallax)

    def _add_keyframe(self, tracks: Tracks, view: View) -> None:
        order = np.argsort(tracks.ids, kind="stable")
        self._keyframes.append(
            Keyframe(T_map_cam=self._T_map_cam, ids=tracks.ids[order], rays=view.rays.select(order))
        )
        if len(self._keyframes) > self._window:
            self._retire(self._keyframes.pop(0))
            self._scale_held = True
        self._adjust()
        self._T_map_cam = self._keyframes[-1].T_map_cam

    def _retire(self, keyframe: Keyframe) -> None:
        """Turn what a keyframe saw into prior knowledge of the points, its pose taken as known."""
        landmarks = self._landmarks
        index, known = landmarks.find(keyframe.ids)
        rows = np.flatnonzero(known)
        index = index[rows]
        R = keyframe.T_map_cam[:3, :3]
        points_cam = (landmarks.points(index) - keyframe.T_map_cam[:3, 3]) @ R
        error, slope, ahead = residuals(keyframe.rays.select(rows), points_cam)
        sigma = self._noise.sigma_px
        squared = 0.5 * np.sum(error * error, axis=-1) / sigma**2
        weight = np.where(ahead, cauchy_weights(squared, 2.0), 0.0) / sigma**2
        J = slope @ (R.T @ landmarks.slopes(index))
        weighted = np.swapaxes(J, -1, -2) * weight[:, None, None]
        prior = landmarks.prior_information[index]
        off = landmarks.q[index] - landmarks.prior_q[index]
        gradient = (prior @ off[..., None] + weighted @ error[..., None])[..., 0]
        total = prior + weighted @ J
        step = np.linalg.solve(total + 1e-9 * np.eye(3), gradient[..., None])[..., 0]
        landmarks.prior_information[index] = total
        landmarks.prior_q[index] = landmarks.q[index] - step

    def _adjust(self) -> None:
        keyframes, landmarks = self._keyframes, self._landmarks
        if len(keyframes) < 2:
            return
        found = [landmarks.find(keyframe.ids) for keyframe in keyframes]
        seen_by = np.zeros(len(landmarks), dtype=np.int64)
        for index, known in found:
            seen_by[index[known]] += 1
        chosen = np.flatnonzero(seen_by >= 2)
        if len(chosen) < self._min_points:
            return
        slot = np.full(len(landmarks), -1)
        slot[chosen] = np.arange(len(chosen))
        views, count = len(keyframes), len(chosen)
        seen = np.zeros((views, count), dtype=bool)
        rows = np.zeros((views, count, 2, 3))
        axes = np.zeros((views, count, 3))
        for k, ((index, known), keyframe) in enumerate(zip(found, keyframes, strict=True)):
            which = np.flatnonzero(known & (slot[index] >= 0))
            where = slot[index[which]]
            seen[k, where] = True
            rows[k, where] = keyframe.rays.rows[which]
            axes[k, where] = keyframe.rays.axes[which]
        rays = Rays(rows=rows.reshape(-1, 2, 3), axes=axes.reshape(-1, 3), origins=np.zeros((views * count, 3)))
        fixed = max(1, min(self._fixed, views - 1)) if views == self._window else 1
        result = adjust(
            BundleProblem(
                T_map_cam=np.stack([keyframe.T_map_cam for keyframe in keyframes]),
                free=np.arange(views) >= fixed,
                origins=landmarks.origins[chosen],
                rotations=landmarks.rotations[chosen],
                q=landmarks.q[chosen],
                prior_q=landmarks.prior_q[chosen],
                prior_information=landmarks.prior_information[chosen],
                rays=rays,
                seen=seen,
                sigma_px=self._noise.sigma_px,
                min_inverse_depth=_MIN_INVERSE_DEPTH,
            )
        )
        before = landmarks.q[chosen, 2].copy()
        landmarks.q[chosen] = result.q
        landmarks.covariance[chosen] = result.q_covariance
        # A point that most of its keyframes contradict is no point.
        bad = (result.errors > 4.0).sum(axis=0) > 0.5 * seen.sum(axis=0)
        landmarks.strikes[chosen[bad]] = _MAX_STRIKES
        self._keyframes = [
            replace(keyframe, T_map_cam=T) for keyframe, T in zip(keyframes, result.T_map_cam, strict=True)
        ]
        if not self._scale_held:
            # Nothing but the damping holds the scale yet: put it back where it was.
            known = np.sqrt(landmarks.covariance[chosen, 2, 2]) < 0.3 * landmarks.q[chosen, 2]
            if known.sum() >= self._min_points:
                self._rescale(float(np.median(landmarks.q[chosen, 2][known] / before[known])))

    def _rescale(self, factor: float) -> None:
        """Multiply all lengths of the map by ``factor``, about the oldest keyframe."""
        centre = self._keyframes[0].T_map_cam[:3, 3].copy()
        self._landmarks.rescale(factor, centre)
        self._keyframes = [replace(k, T_map_cam=_stretch(k.T_map_cam, factor, centre)) for k in self._keyframes]

    def _view(self, tracks):
        return View(rays=observe(self._camera, tracks.bearings), seen=np.ones(len(tracks), dtype=bool))

    def _locate(self, tracks: Tracks, starts: list[Array]) -> Fix | None:
        return locate(
            self._landmarks, tracks.ids, [self._view(tracks)], starts, sigma_px=self._noise.sigma_px, min_inliers=self._min_points
        )

    def _start(self, tracks: Tracks) -> None:
        """Make a map from this view and an earlier one, once they are far enough apart."""
        while self._earlier:
            first, second = common_points(self._earlier[0], tracks)
            if len(first) >= max(self._start_points, _MIN_COMMON * min(len(self._earlier[0]), len(tracks))):
                break
            self._earlier.pop(0)
            self._tried_px = 0.0
        if self._earlier:
            pairs = pair(self._camera, self._earlier[0].bearings[first], tracks.bearings[second])
            parallax = float(np.percentile(parallax_px(pairs, fit_rotation(pairs), self._focal), 75.0))
            if parallax > max(self._start_parallax, 1.15 * self._tried_px):
                self._tried_px = parallax
                if self._make_map(pairs, self._earlier[0], first, tracks, second):
                    return
            last, now = common_points(self._earlier[-1], tracks)
            moved = np.linalg.norm(self._earlier[-1].pixels[last] - tracks.pixels[now], axis=-1)
            if len(moved) and np.median(moved) < 0.15 * self._start_parallax:
                return
        self._earlier.append(tracks)
        if len(self._earlier) > _MAX_EARLIER:
            # The oldest stays: it has the longest baseline.
            del self._earlier[1]

    def _make_map(self, pairs: Pairs, earlier: Tracks, first: np.ndarray, tracks: Tracks, second: np.ndarray) -> bool:
        fit = fit_two_view(pairs, focal_px=self._focal, sigma_px=self._noise.sigma_px, threshold_px=2.0 * self._noise.sigma_px)
        if fit is None or np.linalg.eigvalsh(fit.covariance[3:, 3:])[-1] > _MAX_DIRECTION**2:
            return False
        T_ref_cur = se3.from_parts(fit.R_prev_cur, fit.t)
        rays = np.stack([earlier.bearings[first], tracks.bearings[second]])
        _, depths = triangulate(np.stack([np.eye(4), T_ref_cur]), rays)
        good = (fit.errors < _INLIER) & (np.nan_to_num(depths, nan=-1.0) > 0.0).all(axis=0)
        if good.sum() < max(self._start_points, 0.6 * len(first)):
            return False
        scale = self._unit / float(np.median(depths[0][good]))
        T_ref_cur[:3, 3] *= scale
        rows = np.flatnonzero(good)
        ids = tracks.ids[second[rows]]
        reference = observe(self._camera, earlier.bearings[first[rows]])
        self._add(ids, np.eye(4), reference, 1.0 / (scale * depths[0][rows]), 1.0 / self._unit)
        index, _ = self._landmarks.find(ids)
        self._landmarks.update(
            index, T_ref_cur, [select_view(self._view(tracks), second[rows])], sigma_px=self._noise.sigma_px
        )
        self._T_map_cam = T_ref_cur
        self._seed_window(earlier, tracks, T_ref_cur)
        self._earlier = []
        return True

    def _seed_window(self, earlier: Tracks, tracks: Tracks, T_ref_cur: Array) -> None:
        """Make keyframes of the first view, some between, and this one, and adjust them."""
        spaced = np.unique(np.linspace(1, len(self._earlier) - 1, self._window - 2).astype(int)) if self._window else []
        located = [(earlier, np.eye(4))]
        for k in spaced:
            if 0 < k < len(self._earlier):
                fix = self._locate(self._earlier[k], [T_ref_cur, np.eye(4)])
                if fix is not None:
                    located.append((self._earlier[k], fix.T_map_cam))
        located.append((tracks, T_ref_cur))
        if not self._window:
            return
        for view, T in located:
            order = np.argsort(view.ids, kind="stable")
            self._keyframes.append(
                Keyframe(T_map_cam=T, ids=view.ids[order], rays=self._view(view).rays.select(order))
            )
        self._adjust()
        self._T_map_cam = self._keyframes[-1].T_map_cam

    def _add(self, ids, T_map_cam, rays, inverse_depth, spread):
        depth = rays.axes[:, 2:]
        inverse_slope = np.linalg.inv(rays.rows[:, :, :2] * depth[..., None])
        covariance = np.zeros((len(ids), 3, 3))
        covariance[:, :2, :2] = self._noise.sigma_px**2 * inverse_slope @ np.swapaxes(inverse_slope, -1, -2)
        covariance[:, 2, 2] = spread**2
        self._landmarks.add(ids, T_map_cam, rays.axes[:, :2] / depth, np.maximum(inverse_depth, _MIN_INVERSE_DEPTH), covariance)

    def _extend(self, tracks: Tracks, view: View) -> None:
        landmarks = self._landmarks
        wanted = np.isin(landmarks.ids, tracks.ids)
        if self._keyframes:
            wanted |= np.isin(landmarks.ids, np.concatenate([keyframe.ids for keyframe in self._keyframes]))
        landmarks.keep(wanted & (landmarks.strikes < _MAX_STRIKES))
        slide = (self._drift / self._focal) ** 2
        landmarks.covariance[:, 0, 0] += slide
        landmarks.covariance[:, 1, 1] += slide
        index, known = landmarks.find(tracks.ids)
        T = self._T_map_cam
        depth = (landmarks.points(index[known]) - T[:3, 3]) @ T[:3, 2]
        depth = depth[depth > 0]
        if len(depth):
            typical = float(np.median(1.0 / depth))
            rows = np.flatnonzero(~known)
            self._add(tracks.ids[rows], T, view.rays.select(rows), np.full(len(rows), typical), typical)
