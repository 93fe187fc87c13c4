"""``vo=local_map``: monocular motion in one unit, against a local map."""

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
from vioframe_geometric.bundle import BundleProblem, adjust
from vioframe_geometric.epipolar import Pairs, fit_rotation, fit_two_view, pair, parallax_px
from vioframe_geometric.landmarks import Landmarks
from vioframe_geometric.pose import View, cauchy_weights
from vioframe_geometric.rays import Rays, observe, residuals
from vioframe_geometric.tracking import INLIER, Fix, PixelNoise, locate, relative_covariance, select_view
from vioframe_geometric.two_view import common_points, first_camera, require_positive

log = logging.getLogger(__name__)

# The unit of length is the median depth of the first points; none is taken to be further than a thousand of them.
_MIN_INVERSE_DEPTH = 1e-3
_MAX_STRIKES = 2
# A first map with a more uncertain direction of motion is not begun.
_MAX_DIRECTION = np.radians(6.0)
_MIN_AHEAD = 0.6
# Share of points that the oldest view kept for a start must have in common with the present one.
_MIN_COMMON = 0.5
_MAX_EARLIER = 12
_RETRY = 1.15
_SETTLED = 3.0
_MAX_MISSED = 10
_ITERATIONS = 4
_ROBUST = 2.0
_CONTRADICTED = 4.0
_KNOWN_DEPTH = 0.3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Keyframe:
    """A located view: pose (4, 4), ids (M,) ascending, and their rays."""

    T_map_cam: Array
    ids: Stamps
    rays: Rays


class LocalMapVO(VOEstimator):
    """Locates every image in a map of landmarks, and keeps the map by small bundle adjustments at keyframes.

    The unit of length is the median depth of the first map. It is kept until all points are lost at once; a map begun
    after that takes over the median depth of the last one, and ``counters`` tells how often. No motion is given
    before two views are far enough apart, nor while lost.

    Args:
        sigma_px: standard deviation of a tracked point's coordinate.
        adapt_sigma: learn it from the errors, beginning with ``sigma_px``.
        min_points: fewer agreeing points give no motion.
        start_parallax_px: upper quartile of the displacement beyond rotation at which a map is begun.
        start_points: fewest points of a first map.
        keyframe_parallax_px: median displacement beyond rotation since the last keyframe that asks for a new one.
        keyframe_share: share of points in common with the last keyframe below which there is a new one.
        window: keyframes adjusted together.
        fixed: of them, the oldest, that stay where they are once the window is full.
        drift_px: how far the patch of a point slides over the scene from image to image.
        covariance_scale: by which the covariance from the errors is multiplied.

    Raises:
        ConfigError: an option outside its range.
    """

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
        covariance_scale: float = 0.7,
    ) -> None:
        require_positive(
            sigma_px=sigma_px,
            start_parallax_px=start_parallax_px,
            keyframe_parallax_px=keyframe_parallax_px,
            covariance_scale=covariance_scale,
        )
        if min_points < 6:
            raise ConfigError(f"vo.min_points must be at least 6, got {min_points}")
        if start_points < min_points:
            raise ConfigError(f"vo.start_points must be at least min_points={min_points}, got {start_points}")
        if not 0.0 < keyframe_share < 1.0:
            raise ConfigError(f"vo.keyframe_share must be between 0 and 1, got {keyframe_share}")
        if not 3 <= window <= 30:
            raise ConfigError(f"vo.window must be from 3 to 30, got {window}")
        if not 1 <= fixed < window:
            raise ConfigError(f"vo.fixed must be from 1 to window - 1 = {window - 1}, got {fixed}")
        if drift_px < 0.0:
            raise ConfigError(f"vo.drift_px must not be negative, got {drift_px}")
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
        """Forget the map and take the calibration of camera 0."""
        self._camera = first_camera(rig, "local_map")
        self._calibration = self._camera
        self._focal = float(np.mean(self._camera.intrinsics_px[:2]))
        self._noise = PixelNoise(self._start_sigma)
        self._unit = 1.0
        self._maps_lost = 0
        self._stamp_ns: int | None = None
        self._forget()

    def counters(self) -> Mapping[str, int]:
        """How often the map was lost; the unit of length after that is a guess."""
        return {"maps lost": self._maps_lost} if self._camera is not None and self._maps_lost else {}

    def estimate(self, previous: VisualFeatures, current: VisualFeatures) -> RelativePose:
        """Motion of camera 0 in the unit of the map; invalid where there is no map yet, or none any more.

        Raises:
            StateError: called before ``setup``.
        """
        if self._camera is None:
            raise StateError("LocalMapVO.estimate was called before setup(rig): set it up first")
        if previous.tracks is None or current.tracks is None:
            return RelativePose.invalid()
        if self._stamp_ns != previous.frame.stamp_ns:
            self._advance(previous.tracks, None)
        before, after = self._advance(current.tracks, previous.tracks)
        self._stamp_ns = current.frame.stamp_ns
        if before is None or after is None:
            return RelativePose.invalid()
        T_prev_cur = se3.inverse(before.T_map_cam) @ after.T_map_cam
        covariance = self._covariance_scale * relative_covariance(before.covariance, after.covariance, T_prev_cur)
        return RelativePose(T_prev_cur=T_prev_cur, covariance=covariance, valid=True, inliers=after.inliers)

    def _forget(self) -> None:
        self._landmarks = Landmarks(_MIN_INVERSE_DEPTH)
        self._keyframes: list[Keyframe] = []
        self._scale_held = False
        self._earlier: list[Tracks] = []
        self._tried_px = 0.0
        self._fix: Fix | None = None
        self._T_map_cam: Array = np.eye(4)
        self._motion: Array = np.eye(4)
        self._missed = 0

    def _advance(self, tracks: Tracks, previous: Tracks | None) -> tuple[Fix | None, Fix | None]:
        """Take the next view; return where the one before and this one were found."""
        before = self._fix
        if len(self._landmarks) == 0:
            if not self._start(tracks):
                return None, None
            before = None if previous is None else self._locate(previous, [self._T_map_cam, np.eye(4)])
            if before is not None:
                self._motion = se3.inverse(before.T_map_cam) @ self._T_map_cam
        fix = self._locate(tracks, [self._T_map_cam @ self._motion, self._T_map_cam])
        if fix is None:
            self._miss(tracks)
            return before, None
        if self._adapt:
            self._noise.learn(fix.errors)
        self._missed = 0
        self._T_map_cam = fix.T_map_cam
        view = self._view(tracks)
        self._landmarks.update(
            fix.index,
            fix.T_map_cam,
            [select_view(view, fix.rows)],
            sigma_px=self._noise.sigma_px,
            pose_covariance=fix.covariance,
        )
        self._extend(tracks, view)
        told = fix
        if self._is_keyframe(tracks):
            self._add_keyframe(tracks, view)
            told = _corrected(fix, self._T_map_cam)
        self._motion = se3.inverse(before.T_map_cam) @ told.T_map_cam if before is not None else np.eye(4)
        self._fix = replace(fix, T_map_cam=self._T_map_cam)
        return before, told

    def _miss(self, tracks: Tracks) -> None:
        """No pose was found: wait for better images while points are still followed, else begin anew."""
        self._fix = None
        self._motion = np.eye(4)
        self._missed += 1
        _, known = self._landmarks.find(tracks.ids)
        if known.sum() >= self._min_points and self._missed <= _MAX_MISSED:
            return
        self._maps_lost += 1
        depth = self._depths(self._landmarks)
        if len(depth):
            self._unit = float(np.median(depth))
        log.warning("local_map: the map was lost; the next one takes over its median depth as a guess of the scale")
        self._forget()
        self._start(tracks)

    def _depths(self, landmarks: Landmarks) -> Array:
        """Depths of the points before the camera at its last pose."""
        points = landmarks.points(np.arange(len(landmarks)))
        depth: Array = (points - self._T_map_cam[:3, 3]) @ self._T_map_cam[:3, 2]
        return depth[depth > 0.0]

    def _view(self, tracks: Tracks) -> View:
        return View(rays=observe(self._calibration, tracks.bearings), seen=np.ones(len(tracks), dtype=bool))

    def _locate(self, tracks: Tracks, starts: list[Array]) -> Fix | None:
        return locate(
            self._landmarks,
            tracks.ids,
            [self._view(tracks)],
            starts,
            sigma_px=self._noise.sigma_px,
            min_inliers=self._min_points,
        )

    def _start(self, tracks: Tracks) -> bool:
        """Make a map from this view and an earlier one, once they are far enough apart."""
        first = second = np.zeros(0, dtype=np.int64)
        while self._earlier:
            first, second = common_points(self._earlier[0], tracks)
            if len(first) >= max(self._start_points, _MIN_COMMON * min(len(self._earlier[0]), len(tracks))):
                break
            self._earlier.pop(0)
            self._tried_px = 0.0
        if self._earlier:
            pairs = pair(self._calibration, self._earlier[0].bearings[first], tracks.bearings[second])
            parallax = float(np.percentile(parallax_px(pairs, fit_rotation(pairs), self._focal), 75.0))
            if parallax > max(self._start_parallax, _RETRY * self._tried_px):
                self._tried_px = parallax
                if self._make_map(pairs, first, tracks, second, settled=parallax > _SETTLED * self._start_parallax):
                    return True
            last, now = common_points(self._earlier[-1], tracks)
            moved = np.linalg.norm(self._earlier[-1].pixels[last] - tracks.pixels[now], axis=-1)
            if len(moved) and np.median(moved) < 0.15 * self._start_parallax:
                return False
        self._earlier.append(tracks)
        if len(self._earlier) > _MAX_EARLIER:
            # The oldest stays: it has the longest baseline.
            del self._earlier[1]
        return False

    def _make_map(
        self, pairs: Pairs, first: np.ndarray, tracks: Tracks, second: np.ndarray, *, settled: bool
    ) -> bool:
        """Make landmarks and keyframes from the oldest view kept and this one, if their motion is certain.

        Args:
            pairs: the points seen in both.
            first, second: their rows in either.
            settled: take the likelier of two motions that a single plane allows; waiting longer would not help.
        """
        sigma = self._noise.sigma_px
        fit = fit_two_view(pairs, focal_px=self._focal, sigma_px=sigma, threshold_px=2.0 * sigma)
        # A rotation, or points on one plane, leave the direction open.
        if fit is None or (fit.ambiguous and not settled):
            return False
        if np.linalg.eigvalsh(fit.covariance[3:, 3:])[-1] > _MAX_DIRECTION**2:
            return False
        earlier = self._earlier[0]
        T_map_cam = se3.from_parts(fit.R_prev_cur, fit.t)
        rays = np.stack([earlier.bearings[first], tracks.bearings[second]])
        _, depths = triangulate(np.stack([np.eye(4), T_map_cam]), rays)
        good = (fit.errors < INLIER) & (np.nan_to_num(depths, nan=-1.0) > 0.0).all(axis=0)
        if good.sum() < max(self._start_points, _MIN_AHEAD * len(first)):
            return False
        scale = self._unit / float(np.median(depths[0][good]))
        T_map_cam[:3, 3] *= scale
        rows = np.flatnonzero(good)
        ids = tracks.ids[second[rows]]
        seen_before = observe(self._calibration, earlier.bearings[first[rows]])
        self._add(ids, np.eye(4), seen_before, 1.0 / (scale * depths[0][rows]), 1.0 / self._unit)
        index, _ = self._landmarks.find(ids)
        self._landmarks.update(index, T_map_cam, [select_view(self._view(tracks), second[rows])], sigma_px=sigma)
        self._seed_window(tracks, T_map_cam)
        self._earlier = []
        return True

    def _seed_window(self, tracks: Tracks, T_map_cam: Array) -> None:
        """Make keyframes of the first view, of some between, and of this one, and adjust them."""
        self._keyframes = [self._keyframe(self._earlier[0], np.eye(4))]
        spaced = np.unique(np.linspace(1, len(self._earlier) - 1, self._window - 2).astype(int))
        for k in spaced[(spaced > 0) & (spaced < len(self._earlier))]:
            fix = self._locate(self._earlier[k], [T_map_cam, np.eye(4)])
            if fix is not None:
                self._keyframes.append(self._keyframe(self._earlier[k], fix.T_map_cam))
        self._keyframes.append(self._keyframe(tracks, T_map_cam))
        self._adjust()
        self._T_map_cam = self._keyframes[-1].T_map_cam

    def _keyframe(self, tracks: Tracks, T_map_cam: Array) -> Keyframe:
        order = np.argsort(tracks.ids, kind="stable")
        return Keyframe(T_map_cam=T_map_cam, ids=tracks.ids[order], rays=self._view(tracks).rays.select(order))

    def _add(self, ids: Stamps, T_map_cam: Array, rays: Rays, inverse_depth: Array, spread: float) -> None:
        """Add landmarks anchored at a view, with a standard deviation ``spread`` of their inverse depth."""
        depth = rays.axes[:, 2:]
        inverse_slope = np.linalg.inv(rays.rows[:, :, :2] * depth[..., None])
        covariance = np.zeros((len(ids), 3, 3))
        covariance[:, :2, :2] = self._noise.sigma_px**2 * inverse_slope @ np.swapaxes(inverse_slope, -1, -2)
        covariance[:, 2, 2] = spread**2
        inverse_depth = np.maximum(inverse_depth, _MIN_INVERSE_DEPTH)
        self._landmarks.add(ids, T_map_cam, rays.axes[:, :2] / depth, inverse_depth, covariance)

    def _extend(self, tracks: Tracks, view: View) -> None:
        """Drop what neither this view nor a keyframe sees, let patches slide, take new points at a typical depth."""
        landmarks = self._landmarks
        seen = [tracks.ids, *(keyframe.ids for keyframe in self._keyframes)]
        wanted = np.isin(landmarks.ids, np.concatenate(seen))
        landmarks.keep(wanted & (landmarks.strikes < _MAX_STRIKES))
        slide = (self._drift / self._focal) ** 2
        landmarks.covariance[:, 0, 0] += slide
        landmarks.covariance[:, 1, 1] += slide
        depth = self._depths(landmarks)
        if len(depth) == 0:
            return
        typical = float(np.median(1.0 / depth))
        _, known = landmarks.find(tracks.ids)
        rows = np.flatnonzero(~known)
        self._add(tracks.ids[rows], self._T_map_cam, view.rays.select(rows), np.full(len(rows), typical), typical)

    def _is_keyframe(self, tracks: Tracks) -> bool:
        """Whether the view has moved, or changed, enough since the last keyframe."""
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
        variance = self._noise.sigma_px**2
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

    def _adjust(self) -> None:
        """Bundle-adjust the window."""
        keyframes, landmarks = self._keyframes, self._landmarks
        found = [landmarks.find(keyframe.ids) for keyframe in keyframes]
        seen_by = np.zeros(len(landmarks), dtype=np.int64)
        for index, known in found:
            seen_by[index[known]] += 1
        chosen = np.flatnonzero(seen_by >= 2)
        if len(chosen) < self._min_points:
            return
        rays, seen = _grid(keyframes, found, chosen, len(landmarks))
        full = len(keyframes) == self._window
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
                sigma_px=self._noise.sigma_px,
                min_inverse_depth=_MIN_INVERSE_DEPTH,
            ),
            iterations=_ITERATIONS,
            robust_scale=_ROBUST,
        )
        before = landmarks.q[chosen, 2].copy()
        landmarks.q[chosen] = result.q
        landmarks.covariance[chosen] = result.q_covariance
        # A point that most of its keyframes contradict is no point.
        bad = (result.errors > _CONTRADICTED).sum(axis=0) > 0.5 * seen.sum(axis=0)
        landmarks.strikes[chosen[bad]] = _MAX_STRIKES
        self._keyframes = [
            replace(keyframe, T_map_cam=T) for keyframe, T in zip(keyframes, result.T_map_cam, strict=True)
        ]
        if not self._scale_held:
            # Until a keyframe has retired, only the damping holds the scale: put it back where it was.
            known = np.sqrt(landmarks.covariance[chosen, 2, 2]) < _KNOWN_DEPTH * landmarks.q[chosen, 2]
            if known.sum() >= self._min_points:
                self._rescale(float(np.median(landmarks.q[chosen, 2][known] / before[known])))

    def _rescale(self, factor: float) -> None:
        """Multiply all lengths of the map by ``factor``, about the oldest keyframe."""
        centre = self._keyframes[0].T_map_cam[:3, 3].copy()
        self._landmarks.rescale(factor, centre)
        self._keyframes = [
            replace(
                keyframe,
                T_map_cam=se3.from_parts(
                    keyframe.T_map_cam[:3, :3], centre + factor * (keyframe.T_map_cam[:3, 3] - centre)
                ),
            )
            for keyframe in self._keyframes
        ]


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


def _corrected(fix: Fix, T_map_cam: Array) -> Fix:
    """A fix moved by a bundle adjustment.

    The correction makes good the errors of earlier steps, and so is itself an error of this one: its mean square is
    added to the covariance.
    """
    jump = se3.log(se3.inverse(fix.T_map_cam) @ T_map_cam)
    spread = np.repeat([np.mean(jump[:3] ** 2), np.mean(jump[3:] ** 2)], 3)
    return replace(fix, T_map_cam=T_map_cam, covariance=fix.covariance + np.diag(spread))
