"""The window as gtsam solves it: variables, factors, solutions, and starting over when a solution fails.

A keyframe has a pose, a velocity and biases, joined to the keyframe before by the inertial samples between them
(Forster et al. 2017; gtsam's combined factor, whose biases walk). Where extrinsics or delay are estimated it also has
the pose of camera 0, tied to them by :func:`~vioframe_window.factors.camera_tie`: one small factor a keyframe is
written in Python, and the many projections stay gtsam's own. Variables older than the lag are marginalised
(:class:`gtsam.IncrementalFixedLagSmoother`: Kaess et al., "iSAM2", IJRR 2012).
"""

import logging
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import SupportsFloat, SupportsIndex, SupportsInt

import gtsam
import numpy as np

from vioframe.checks import Array, Stamps
from vioframe.conventions import seconds
from vioframe.fusion_options import StandstillOptions
from vioframe.geometry import se3, so3
from vioframe.types import Camera, ImuBias, NavState
from vioframe_window import factors
from vioframe_window.graph_writer import Calibration, GraphWriter
from vioframe_window.keyframes import Keyframe, focal_length
from vioframe_window.options import LandmarkOptions, WindowOptions
from vioframe_window.triangulation import gather, reprojection_errors

log = logging.getLogger(__name__)

# Fewer points do not say where an old image was taken.
_FEWEST_SEEN_AGAIN = 6


class Smoother:
    """Keyframes and points of the last seconds.

    Args:
        cameras: of the rig; the place of camera 1 relative to camera 0 is taken as calibrated.
        window: lag and iterations.
        landmarks: noise and gates.
        standstill: sigmas of no motion.
    """

    def __init__(
        self,
        cameras: tuple[Camera, ...],
        window: WindowOptions,
        landmarks: LandmarkOptions,
        standstill: StandstillOptions,
    ) -> None:
        self._window = window
        self._landmarks = landmarks
        self._focal_px = focal_length(cameras[0])
        self._writer = GraphWriter(cameras, landmarks, standstill)

    @property
    def newest(self) -> Keyframe:
        """The last keyframe."""
        return self.keyframes[-1]

    @property
    def has_covariance(self) -> bool:
        """Whether :attr:`covariance` is that of the newest keyframe, or of one a little before."""
        return self._since_covariance == 0

    @property
    def T_body_cam(self) -> Array:
        """Camera 0 on the body, (4, 4), as estimated now."""
        return self._writer.calibration.T_body_cam

    @property
    def delay_s(self) -> float:
        """The camera's delay as estimated now."""
        return self._writer.calibration.delay_s

    def camera_poses(self, T_world_cam: Array) -> Array:
        """All cameras of the rig (C, 4, 4) in the world, of camera 0's pose."""
        return np.stack([T_world_cam @ T for T in self._writer.T_cam0_camera])

    def begin(self, keyframe: Keyframe, state: NavState, covariance: Array, calibration: Calibration) -> None:
        """Forget everything; start from one keyframe.

        Args:
            keyframe: the first, at ``state``.
            state: where the body is.
            covariance: (15, 15) of it.
            calibration: of the camera.
        """
        self._writer.calibration = calibration
        self.keyframes: list[Keyframe] = [keyframe]
        self.point_ids: Stamps = np.zeros(0, dtype=np.int64)
        self.points_world: Array = np.zeros((0, 3))
        self._point_stamps_ns: Stamps = np.zeros(0, dtype=np.int64)
        self.loop_cameras: dict[int, Array] = {}
        self._waiting = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self.covariance = covariance
        self._since_covariance = 0
        self._origin_ns = keyframe.stamp_ns
        self._open(state, covariance)

    def add(
        self, keyframe: Keyframe, observed: Mapping[int, Iterable[int]], new_ids: Stamps, new_points: Array
    ) -> bool:
        """Take the next keyframe and solve.

        Args:
            keyframe: with predicted estimates (:meth:`predict`).
            observed: rows of each camera's view that show known points, by camera.
            new_ids: (N,) points to take in.
            new_points: (N, 3) m, in the world.

        Returns:
            False where the system could not be solved and was built again from the last estimates.
        """
        graph, values = self._waiting
        self._waiting = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._writer.add_motion(graph, values, keyframe, self.newest)
        self.keyframes.append(keyframe)
        for camera, rows in observed.items():
            view = keyframe.views[camera]
            for row in rows:
                self._writer.observe(graph, keyframe, camera, int(view.ids[row]), view.points[row])
        for track_id, point in zip(new_ids.tolist(), new_points, strict=True):
            values.insert(factors.point_key(track_id), point)
            for past in self.keyframes:
                self._writer.observe_if_seen(graph, past, track_id)
        self._hold(new_ids, new_points)
        seen = np.isin(self.point_ids, np.concatenate([view.ids for view in keyframe.views]))
        self._point_stamps_ns[seen] = keyframe.stamp_ns
        try:
            self._solve(graph, values, self.point_ids[seen])
        except RuntimeError:
            self._rebuild_or_fail()
            return False
        return True

    def see_again(self, match_id: int, T_world_cam: Array, ids: Stamps, points: Array) -> bool:
        """Take in, with the next keyframe, an old image that shows points of the window.

        Args:
            match_id: names it in :attr:`loop_cameras`.
            T_world_cam: (4, 4) guess of where camera 0 was.
            ids: (N,) points it shows.
            points: (N, 2) where, in normalised coordinates.

        Returns:
            False where too few of them are still in the window.
        """
        held = np.flatnonzero(np.isin(ids, self.point_ids))
        if len(held) < _FEWEST_SEEN_AGAIN:
            return False
        graph, values = self._waiting
        values.insert(factors.loop_key(match_id), gtsam.Pose3(T_world_cam))
        for row in held.tolist():
            self._writer.observe_from_loop(graph, match_id, int(ids[row]), points[row])
        self.loop_cameras[match_id] = T_world_cam
        return True

    def _solve(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, seen: Stamps) -> None:
        now = self._time(self.newest.stamp_ns)
        stamps: dict[SupportsInt | SupportsIndex, SupportsFloat | SupportsIndex] = dict.fromkeys(values.keys(), now)
        stamps.update(dict.fromkeys([factors.point_key(track_id) for track_id in seen.tolist()], now))
        stamps.update(self._kept_alive())
        self._solver.update(graph, values, stamps)
        for _ in range(self._window.iterations - 1):
            self._solver.update()
        self._read()

    def _kept_alive(self) -> dict[SupportsInt | SupportsIndex, SupportsFloat | SupportsIndex]:
        """Stamps of the variables that never leave the window."""
        if not self._writer.calibration.is_estimated:
            return {}
        keys = [factors.EXTRINSICS, *([factors.DELAY] if self._writer.has_delay else [])]
        return dict.fromkeys(keys, self._time(self.newest.stamp_ns))

    def _read(self) -> None:
        """Refresh every estimate; forget what was marginalised."""
        values = self._solver.calculateEstimate()
        estimated = self._writer.calibration.is_estimated
        if estimated:
            T_body_cam = values.atPose3(factors.EXTRINSICS).matrix()
            delay_s = self._writer.calibration.delay_s
            if self._writer.has_delay:
                delay_s = float(values.atVector(factors.DELAY)[0])
            self._writer.calibration = replace(self._writer.calibration, T_body_cam=T_body_cam, delay_s=delay_s)
        self.keyframes = [k for k in self.keyframes if values.exists(factors.body_key(k.index))]
        for keyframe in self.keyframes:
            keyframe.T_world_body = values.atPose3(factors.body_key(keyframe.index)).matrix()
            keyframe.v_world_body = values.atVector(factors.velocity_key(keyframe.index))
            bias = values.atConstantBias(factors.bias_key(keyframe.index))
            keyframe.bias = ImuBias(gyro=bias.gyroscope(), accel=bias.accelerometer())
            if estimated:
                keyframe.T_world_cam = values.atPose3(factors.camera_key(keyframe.index)).matrix()
            else:
                keyframe.T_world_cam = keyframe.T_world_body @ self.T_body_cam
        keys = [factors.point_key(track_id) for track_id in self.point_ids.tolist()]
        alive = np.array([values.exists(key) for key in keys], dtype=bool)
        points = [values.atPoint3(key) for key, lives in zip(keys, alive.tolist(), strict=True) if lives]
        self.point_ids, self._point_stamps_ns = self.point_ids[alive], self._point_stamps_ns[alive]
        self.points_world = np.array(points).reshape(-1, 3)
        self.loop_cameras = {
            match_id: values.atPose3(factors.loop_key(match_id)).matrix()
            for match_id in self.loop_cameras
            if values.exists(factors.loop_key(match_id))
        }
        self._since_covariance += 1
        if self._since_covariance >= self._window.covariance_every:
            self.covariance = self._marginal()
            self._since_covariance = 0

    def _marginal(self) -> Array:
        """Covariance (15, 15) of the newest keyframe, in the order of ``NavState.covariance``."""
        newest = self.newest
        keys = [kind(newest.index) for kind in (factors.body_key, factors.velocity_key, factors.bias_key)]
        order = gtsam.Ordering()
        for key in keys:
            order.push_back(key)
        # Through the Bayes tree the same costs ten times as much: the newest keyframe is far from its root.
        linear = self._solver.getFactors().linearize(self._solver.getLinearizationPoint())
        information = linear.marginal(keys).hessian(order)[0]
        joint = np.linalg.inv(information)
        into = np.zeros((15, 15))
        into[0:3, 0:3] = into[6:9, 6:9] = np.eye(3)
        into[3:6, 3:6] = newest.T_world_body[:3, :3]
        into[9:12, 12:15] = into[12:15, 9:12] = np.eye(3)
        covariance: Array = into @ joint @ into.T
        return 0.5 * (covariance + covariance.T)

    def _open(self, state: NavState, covariance: Array) -> None:
        """A fresh solver with the oldest keyframe alone, and its priors."""
        try:
            self._open_with(state, covariance, "CHOLESKY")
        except RuntimeError as error:
            # Beside the tie of the camera, a place that is only known to half a metre, as after long dead reckoning,
            # is free in the eyes of gtsam's Cholesky. QR takes it, and a little longer.
            log.debug("the window is solved by QR: %s", error)
            self._open_with(state, covariance, "QR")

    def _open_with(self, state: NavState, covariance: Array, factorisation: str) -> None:
        parameters = gtsam.ISAM2Params()
        parameters.setFactorization(factorisation)
        parameters.setRelinearizeThreshold(self._window.relinearise_above)
        parameters.relinearizeSkip = 1
        parameters.findUnusedFactorSlots = True
        self._solver = gtsam.IncrementalFixedLagSmoother(self._window.lag_s, parameters)
        first = self.keyframes[0]
        graph, values = factors.start_prior(first.index, state, covariance), gtsam.Values()
        self._writer.add_calibration(graph, values)
        self._writer.add_keyframe(graph, values, first)
        self._solver.update(graph, values, dict.fromkeys(values.keys(), self._time(first.stamp_ns)))

    def _rebuild_or_fail(self) -> None:
        """Start over from the last estimates, without points if need be.

        Raises:
            LinAlgError: even the inertial samples alone have no solution.
        """
        self._waiting = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self.loop_cameras.clear()
        for sound in (self._sound_points(), np.zeros(0, dtype=np.int64)):
            try:
                self._rebuild(sound)
            except (RuntimeError, ValueError) as error:
                log.debug("the window could not be built again with %d points: %s", len(sound), error)
            else:
                return
        raise np.linalg.LinAlgError("the window of the smoother has no solution")

    def _rebuild(self, sound: Stamps) -> None:
        """Start over from the last estimates, with the points in rows ``sound``."""
        oldest = self.keyframes[0]
        state = NavState(
            stamp_ns=oldest.stamp_ns,
            T_world_body=se3.from_parts(so3.normalise(oldest.T_world_body[:3, :3]), oldest.T_world_body[:3, 3]),
            v_world_body=oldest.v_world_body,
            bias=oldest.bias,
        )
        self._open(state, self.covariance)
        self.point_ids, self._point_stamps_ns = self.point_ids[sound], self._point_stamps_ns[sound]
        self.points_world = self.points_world[sound]
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        stamps: dict[SupportsInt | SupportsIndex, SupportsFloat | SupportsIndex] = {}
        for before, keyframe in zip(self.keyframes[:-1], self.keyframes[1:], strict=True):
            known = set(values.keys())
            self._writer.add_motion(graph, values, keyframe, before)
            stamps.update(dict.fromkeys(set(values.keys()) - known, self._time(keyframe.stamp_ns)))
        for track_id, point, stamp_ns in zip(
            self.point_ids.tolist(), self.points_world, self._point_stamps_ns.tolist(), strict=True
        ):
            values.insert(factors.point_key(track_id), point)
            stamps[factors.point_key(track_id)] = self._time(stamp_ns)
            for keyframe in self.keyframes:
                self._writer.observe_if_seen(graph, keyframe, track_id)
        stamps.update(self._kept_alive())
        self._solver.update(graph, values, stamps)
        self._solve(gtsam.NonlinearFactorGraph(), gtsam.Values(), self.point_ids[:0])

    def _sound_points(self) -> Stamps:
        """Rows of the points that at least two views see in front of them and near where they project."""
        T_world_cam = np.concatenate([self.camera_poses(k.T_world_cam)[: len(k.views)] for k in self.keyframes])
        bearings, seen = gather([view for k in self.keyframes for view in k.views], self.point_ids)
        errors = reprojection_errors(T_world_cam, self.points_world, bearings) * self._focal_px
        depths = np.einsum("vi,vni->vn", T_world_cam[:, :3, 2], self.points_world[None] - T_world_cam[:, None, :3, 3])
        bad = seen & ((depths < self._landmarks.min_depth) | (errors > 3.0 * self._landmarks.max_error_px))
        return np.flatnonzero(~bad.any(axis=0) & (seen.sum(axis=0) >= 2))

    def predict(self, keyframe: Keyframe) -> None:
        """Fill in camera 0 of a new keyframe, by the present calibration."""
        shift = self.delay_s - keyframe.delay_s if self._writer.has_delay else 0.0
        moved = keyframe.T_world_body.copy()
        moved[:3, :3] = moved[:3, :3] @ so3.exp((keyframe.rate - keyframe.bias.gyro) * shift)
        moved[:3, 3] += keyframe.v_world_body * shift
        keyframe.T_world_cam = moved @ self.T_body_cam

    def _hold(self, ids: Stamps, points: Array) -> None:
        ids = np.concatenate([self.point_ids, ids])
        order = np.argsort(ids, kind="stable")
        stamps_ns = np.concatenate(
            [self._point_stamps_ns, np.full(len(ids) - len(self.point_ids), self.newest.stamp_ns)]
        )
        self.point_ids, self._point_stamps_ns = ids[order], stamps_ns[order]
        self.points_world = np.concatenate([self.points_world, points])[order]

    def _time(self, stamp_ns: int) -> float:
        return seconds(stamp_ns - self._origin_ns)
