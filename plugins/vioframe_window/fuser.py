"""Fixed-lag smoothing of inertial samples and points, with a causal state at every image."""

from collections.abc import Mapping

import numpy as np

from vioframe.checks import Array, Mask, Stamps
from vioframe.conventions import NANOSECONDS, seconds
from vioframe.error_state import InertialFilter
from vioframe.errors import ConfigError
from vioframe.fusion_options import StandstillOptions
from vioframe.geometry import se3, so3
from vioframe.tight.fuser import TightFuser
from vioframe.tight.options import CalibrationOptions, FailureOptions, InertialTrust
from vioframe.tight.start import TightStartOptions
from vioframe.tight.step import Start, Step, Support
from vioframe.types import Measurement, NavState, SensorRig, Trajectory
from vioframe_window.keyframes import Keyframe, Turn, View, focal_length
from vioframe_window.library import require_gtsam
from vioframe_window.loop_interface import LoopCloser
from vioframe_window.options import LandmarkOptions, WindowOptions
from vioframe_window.triangulation import Doubts, NewPoints, find_new_points, reprojection_errors
from vioframe_window.turning import find_turn

# With fewer points than this in view, what may enter is judged by a wider gate.
_FEW = 20
_SLACK = 3.0
# Points out of sight stay until the lag has passed; with those in view they are at most so many times the wanted.
_HELD_IN_ALL = 2
# A point of the window may be this much further off, in a predicted view, than a new one in the views it has.
_TRACKED = 2.0


class WindowFuser(TightFuser):
    """Keyframes at a few hertz in a fixed-lag smoother; between them the inertial samples.

    Args:
        window: keyframes and solver.
        landmarks: points and their observations.
        inertial: trust in the inertial increments.
        calibration: what of the calibration is estimated.
        standstill: measuring no motion at rest.
        start: how it begins.
        failure: when it is not believed any more.
        stereo: True needs the points in camera 1 too, False leaves them out, None takes what the front end gives.
        loop: recognises places; None, or the empty choice ``loop=none``, for no loop closure.
        loop_corrects_states: give causal states in the map that the loop closer keeps; else in the odometry frame,
            which drifts and does not jump.

    Raises:
        ConfigError: ``loop`` is something else.
        PluginError: gtsam is not installed.
    """

    def __init__(
        self,
        *,
        window: WindowOptions | None = None,
        landmarks: LandmarkOptions | None = None,
        inertial: InertialTrust | None = None,
        calibration: CalibrationOptions | None = None,
        standstill: StandstillOptions | None = None,
        start: TightStartOptions | None = None,
        failure: FailureOptions | None = None,
        stereo: bool | None = None,
        loop: LoopCloser | None = None,
        loop_corrects_states: bool = True,
    ) -> None:
        super().__init__(
            stereo=stereo,
            inertial=inertial,
            calibration=calibration,
            standstill=standstill,
            start=start,
            failure=failure,
        )
        require_gtsam()
        self._window = window or WindowOptions()
        self._landmarks = landmarks or LandmarkOptions()
        if loop and not isinstance(loop, LoopCloser):
            raise ConfigError(f"fuser.loop must be a loop closer, such as loop=bow, or none; got {loop!r}")
        self._rest_limit = self._standstill.gate()
        self._loop = loop or None
        self._loop_corrects_states = loop_corrects_states

    def setup(self, rig: SensorRig) -> None:
        """Forget the last sequence and take the next one's calibration."""
        from vioframe_window.relocalisation import Relocalisation
        from vioframe_window.samples import SampleIntegrator
        from vioframe_window.smoother import Smoother

        super().setup(rig)
        self._focal_px = focal_length(rig.cameras[0])
        self._samples = SampleIntegrator(self._noise, rig.gravity, self._inertial)
        self._smoother = Smoother(rig.cameras[:2], self._window, self._landmarks, self._standstill)
        self._filter = InertialFilter(extra=0, noise=self._noise, gravity=rig.gravity)
        self._settled: dict[int, Array] = {}
        self._now_ns = 0
        self._rested = True
        self._relocalisation = None
        if self._loop is not None:
            self._loop.setup(rig)
            self._relocalisation = Relocalisation(self._loop, self._smoother)

    def counters(self) -> Mapping[str, int]:
        """What the shell and the loop closer count, and windows that had to be built again."""
        counts = dict(super().counters())
        return counts if self._loop is None else counts | dict(self._loop.counters())

    def update(self, measurement: Measurement) -> list[NavState]:
        """Move on by one window; see :meth:`vioframe.tight.fuser.TightFuser.update`."""
        states = super().update(measurement)
        if self._loop is None or not self._loop_corrects_states:
            return states
        from vioframe_window.relocalisation import in_map

        return [in_map(state, self._loop.T_map_world) for state in states]

    def flush(self) -> list[NavState]:
        """The recording has ended; there is no state that was not given."""
        if self._loop is not None and self._ready:
            self._loop.finish()
        return super().flush()

    def T_body_cam(self) -> Array:
        """Place of camera 0 on the body, (4, 4), as estimated now."""
        return self._smoother.T_body_cam if self._running else super().T_body_cam()

    def camera_delay_ns(self) -> int | None:
        """The estimated delay of the camera, where it is estimated."""
        if not (self._calibration.time_offset and self._ready and self._running):
            return None
        return round(self._smoother.delay_s * NANOSECONDS)

    def smoothed(self) -> Trajectory | None:
        """Keyframes as they were when they left the window; with loop closure, as its pose graph has them."""
        if not self._ready or not self._settled:
            return None
        if self._running:
            self._settle()
        stamps_ns = np.array(sorted(self._settled), dtype=np.int64)
        poses = np.array([self._settled[stamp_ns] for stamp_ns in stamps_ns.tolist()])
        trajectory = Trajectory(stamps_ns=stamps_ns, T_world_body=poses, causal=False)
        return trajectory if self._loop is None else self._loop.correct(trajectory)

    def _begin(self, start: Start) -> None:
        from vioframe_window.graph_writer import Calibration

        options = self._calibration
        camera = self._rig.cameras[0]
        found = start.T_body_cam is not None
        rotation_sigma, position_sigma = options.rotation_sigma, options.position_sigma
        if not options.estimates_extrinsics:
            rotation_sigma = position_sigma = 0.0
        elif found:
            rotation_sigma = max(start.rotation_sigma, 1e-3)
        delay_s = seconds(self._rig.camera_delay_ns) if start.camera_delay_s is None else start.camera_delay_s
        state = start.state
        covariance = 1e-6 * np.eye(15) if state.covariance is None else state.covariance
        first = Keyframe(
            index=0,
            stamp_ns=state.stamp_ns,
            views=(),
            increment=None,
            at_rest=False,
            delay_s=delay_s,
            rate=state.bias.gyro,
            T_world_body=state.T_world_body,
            v_world_body=state.v_world_body,
            bias=state.bias,
        )
        calibration = Calibration(
            T_body_cam=camera.T_body_cam if start.T_body_cam is None else start.T_body_cam,
            sigmas=np.repeat([rotation_sigma, position_sigma], 3),
            delay_s=delay_s,
            delay_sigma=options.time_offset_sigma_s if options.time_offset else None,
            is_estimated=options.estimates_extrinsics or options.time_offset,
        )
        first.T_world_cam = first.T_world_body @ calibration.T_body_cam
        if self._relocalisation is not None and self._settled:
            self._relocalisation.interrupt()
        self._smoother.begin(first, state, covariance, calibration)
        self._continue()

    def _advance(self, step: Step) -> Support:
        self._samples.push(step.window, step.noise)
        self._filter.propagate(step.delta)
        self._now_ns = step.stamp_ns
        self._rested = self._rested and step.at_rest
        views = (View.of(step.tracks), *([] if step.stereo is None else [View.of(step.stereo)]))
        if self._is_keyframe(views[0]):
            return self._add_keyframe(step, views)
        agrees = self._known(views[0], self._camera_poses()[0])[1]
        used = int(agrees.sum())
        if used < _FEW:
            turn = self._turn(views[0])
            used = max(used, 0 if turn is None else turn.agreeing)
        return Support(used=used, points=len(self._smoother.point_ids), at_rest=step.at_rest)

    def _estimate(self) -> NavState:
        return self._filter.nav_state(self._now_ns, "tracking")

    def _continue(self) -> None:
        """Go on from the newest keyframe."""
        newest = self._smoother.newest
        covariance = self._smoother.covariance
        if not self._smoother.has_covariance:
            # That of the inertial samples since; an image takes only a little off it.
            predicted = self._estimate().covariance
            covariance = covariance if predicted is None else predicted
        self._now_ns = newest.stamp_ns
        self._rested = True
        self._filter.start(
            NavState(
                stamp_ns=newest.stamp_ns,
                T_world_body=se3.from_parts(so3.normalise(newest.T_world_body[:3, :3]), newest.T_world_body[:3, 3]),
                v_world_body=newest.v_world_body,
                bias=newest.bias,
            ),
            covariance,
        )
        # For the gate of a standstill: has it moved since?
        self._filter.clone_pose()
        self._samples.begin(newest.bias)

    def _fits_standstill(self) -> bool:
        """Whether the inertial samples since the last keyframe allow that there was no motion.

        A standstill is told by the last half second; this tells its end.
        """
        options = self._standstill
        H, residual, noise = self._filter.standstill_measurement(
            options.rotation_sigma, options.position_sigma, options.velocity_sigma
        )
        _, distance = self._filter.innovation(H, residual, noise)
        return distance <= self._rest_limit

    def _is_keyframe(self, view: View) -> bool:
        newest = self._smoother.newest
        # Half an image early is as near to the wanted time as half an image late.
        elapsed_s = seconds(self._now_ns - newest.stamp_ns)
        if elapsed_s > self._window.keyframe_s - 0.01:
            return True
        if not newest.views or not len(newest.views[0].ids):
            return False
        _, kept = view.find(newest.views[0].ids)
        return bool(kept.mean() < self._window.sparse_below)

    def _camera_poses(self) -> Array:
        """Cameras (C, 4, 4) in the world where the body is now."""
        return self._smoother.camera_poses(self._filter.body.T_world_body @ self._smoother.T_body_cam)

    def _known(self, view: View, T_world_cam: Array) -> tuple[Stamps, Mask]:
        """Rows (N,) of a view that show points of the window, and which (N,) of them agree with their points."""
        ids, points_world = self._smoother.point_ids, self._smoother.points_world
        rows, seen = view.find(ids)
        rows, points_world = rows[seen], points_world[seen]
        errors = reprojection_errors(T_world_cam[None], points_world, view.bearings[None, rows])[0]
        depths = (points_world - T_world_cam[:3, 3]) @ T_world_cam[:3, 2]
        limit = (_SLACK if len(rows) < _FEW else 1.0) * _TRACKED * self._landmarks.max_error_px / self._focal_px
        return rows, (errors < limit) & (depths > self._landmarks.min_depth)

    def _turn(self, view: View) -> Turn | None:
        """How camera 0 has turned since the last keyframe, if that is all that its points show.

        Without parallax no point can enter the window; a body that stands or turns on the spot is not lost for
        that, and its turn shows the bias of the gyro.
        """
        newest = self._smoother.newest
        if not newest.views:
            return None
        return find_turn(newest.views[0], view, np.radians(self._landmarks.min_parallax_deg))

    def _add_keyframe(self, step: Step, views: tuple[View, ...]) -> Support:
        smoother, body = self._smoother, self._filter.body
        keyframe = Keyframe(
            index=smoother.newest.index + 1,
            stamp_ns=step.stamp_ns,
            views=views,
            increment=self._samples.take(),
            at_rest=self._rested and self._fits_standstill(),
            delay_s=seconds(step.window.camera_delay_ns),
            rate=step.window.imu.gyro[-1],
            T_world_body=body.T_world_body,
            v_world_body=body.v,
            bias=body.bias,
        )
        smoother.predict(keyframe)
        observed, refused = {}, 0
        for camera, (view, T_world_cam) in enumerate(
            zip(views, smoother.camera_poses(keyframe.T_world_cam), strict=False)
        ):
            rows, agrees = self._known(view, T_world_cam)
            observed[camera] = rows[agrees]
            refused += int((~agrees).sum())
        held = len(observed[0])
        keyframe.turn = self._turn(views[0]) if held < _FEW else None
        far = 0 if keyframe.turn is None else keyframe.turn.agreeing
        new = self._find_new(keyframe, held)
        self._settle()
        if not smoother.add(keyframe, observed, new.ids, new.points_world):
            self._count("windows solved again")
        self._continue()
        if self._relocalisation is not None and step.window.current.images:
            self._relocalisation.take_keyframe(step.window.current.images[0], step.tracks, step.untracked)
        return Support(
            used=max(sum(len(rows) for rows in observed.values()) + len(new.ids), far),
            refused=refused + new.refused,
            points=len(smoother.point_ids),
            at_rest=step.at_rest,
        )

    def _find_new(self, keyframe: Keyframe, held: int) -> NewPoints:
        """Points of the newest keyframe to take in, in front of all cameras that saw them."""
        smoother = self._smoother
        covariance = self._filter.nav_state(self._now_ns, "tracking").covariance
        sigmas = np.zeros(15) if covariance is None else np.sqrt(np.diag(covariance))
        cameras = [
            (T_world_cam, view, seconds(past.stamp_ns - keyframe.stamp_ns))
            for past in (*smoother.keyframes, keyframe)
            for T_world_cam, view in zip(smoother.camera_poses(past.T_world_cam), past.views, strict=False)
        ]
        ids = keyframe.views[0].ids
        return find_new_points(
            np.stack([camera[0] for camera in cameras]),
            [camera[1] for camera in cameras],
            ids[~np.isin(ids, smoother.point_ids)],
            self._landmarks,
            most=min(
                self._landmarks.most - held,
                _HELD_IN_ALL * self._landmarks.most - len(smoother.point_ids),
                self._landmarks.most_new,
            ),
            focal_px=self._focal_px,
            slack=_SLACK if held < _FEW else 1.0,
            doubts=Doubts(
                times_s=np.array([camera[2] for camera in cameras]),
                rate_sigma=float(sigmas[9:12].max()),
            ),
        )

    def _settle(self) -> None:
        """Keep the estimates of the window's keyframes, which are better the older they are."""
        for keyframe in self._smoother.keyframes:
            self._settled[keyframe.stamp_ns] = keyframe.T_world_body
