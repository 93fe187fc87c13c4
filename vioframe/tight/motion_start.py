"""A start in motion: from a few seconds of tracks and inertial samples to a state with its covariance.

Rotations between images give the gyro bias and check the calibration; with the rotations known, the camera's path
follows from the points by linear equations, and velocity, gravity and scale from the path and the accelerometer;
a small bundle adjustment refines all of it and says how certain it is. A state that starts wrongly costs more
than one that starts late, so everything is examined before it is believed.
"""

import numpy as np

from vioframe.checks import Array
from vioframe.conventions import seconds
from vioframe.geometry import se3
from vioframe.tight import doctor
from vioframe.tight.doctor import Examination
from vioframe.tight.gyro_bias import RotationFit, fit_rotations
from vioframe.tight.inertial_window import InertialWindow
from vioframe.tight.linear_alignment import Alignment, Path, align, solve_path
from vioframe.tight.motion_checks import (
    check_excitation,
    check_inertial,
    check_points,
    check_rotations,
    check_standstill,
)
from vioframe.tight.motion_geometry import (
    Geometry,
    keyframes,
    moved,
    paired,
    sightings_of,
    spaced,
    turn_deg,
    views_of,
    window_state,
)
from vioframe.tight.motion_options import MotionStartOptions
from vioframe.tight.motion_window import MotionWindow, Sight
from vioframe.tight.options import CalibrationOptions
from vioframe.tight.rotation_agreement import Agreement, compare_rotations
from vioframe.tight.solved_path import SolvedPath
from vioframe.tight.start_bundle import BundlePriors, BundleResult, WindowState, refine
from vioframe.tight.step import Start
from vioframe.tight.two_view_rotation import relative_rotations
from vioframe.types import ImuBias, InitialisationAttempt, Measurement, NavState, SensorRig

_IMAGE_SPACING_S = 0.1
_PAIR_S = 0.4
# A delay is moved to where the rotations fit if it is this clear; else it is refined with everything.
_DELAY_SIGMAS = 3.0
_LEAST_DELAY_S = 0.008
_DELAY_EXPLAINS = 0.7
_MOST_ROTATION_SIGMA_DEG = 1.0
# The sign of the scale is believed beyond this many standard deviations.
_SIGN_SIGMAS = 4.0


class MotionStart:
    """Looks at the last seconds until they suffice for a start.

    Args:
        rig: calibration.
        options: limits and noise.
        calibration: whether the camera's rotation must be found first, and how far it is trusted else.
    """

    def __init__(self, rig: SensorRig, options: MotionStartOptions, calibration: CalibrationOptions) -> None:
        self._rig = rig
        self._options = options
        self._calibration = calibration
        self._window = MotionWindow(options.longest_s)
        self._noise = options.noise(rig.imu)
        self._sigma = options.pixel_sigma / float(rig.cameras[0].intrinsics_px[0])
        self._tried_ns: int | None = None
        self._before: SolvedPath | None = None

    @property
    def solved(self) -> SolvedPath | None:
        """The path that the last attempt found, if it got that far."""
        return self._before

    def clear(self) -> None:
        """Forget what was seen."""
        self._window.clear()
        self._before = None

    def push(self, measurement: Measurement) -> tuple[Start | None, InitialisationAttempt | None]:
        """Take the next window; return a start if there is one, and the record of an attempt if one was made."""
        self._window.push(measurement)
        stamp_ns = measurement.window.current.stamp_ns
        if self._tried_ns is None:
            self._tried_ns = stamp_ns
        if self._window.span_s < self._options.shortest_s or stamp_ns < self._tried_ns + self._options.every_s * 1e9:
            return None, None
        self._tried_ns = stamp_ns
        examination = Examination()
        start = self._attempt(examination)
        if examination.fault and "scale sigma" not in examination.measures:
            self._before = None
        return start, examination.record(stamp_ns, "motion")

    def _attempt(self, examination: Examination) -> Start | None:
        examination.note("seconds", self._window.span_s, "s")
        inertial, sight = self._window.inertial(), self._window.sight()
        images = spaced(sight.times, _IMAGE_SPACING_S)
        sight = sight.at(images)
        check_inertial(examination, inertial, self._rig.imu)
        check_points(examination, sight, self._options)
        check_standstill(examination, inertial, sight, self._rig)
        if examination.fault:
            return None
        agreement = self._compare_rotations(examination, inertial, sight)
        if examination.fault:
            return None
        delay_s = self._believed_delay_s(agreement)
        sight = moved(sight, delay_s, inertial)
        fit = self._fit_rotations(inertial, sight, agreement)
        examination.note("gyro bias", float(np.linalg.norm(fit.gyro_bias)), "rad/s")
        metric = len(self._rig.cameras) > 1 and int(sight.seen_stereo.sum()) > self._options.min_points
        if self._finds_rotation:
            sigma_deg = float(np.degrees(fit.rotation_sigma))
            examination.at_most(
                "camera rotation sigma",
                sigma_deg,
                _MOST_ROTATION_SIGMA_DEG,
                "°",
                doctor.NO_ROTATION,
                f"the camera's rotation on the body is only known to {sigma_deg:.1f}° "
                f"(limit {_MOST_ROTATION_SIGMA_DEG:g}°): turn the body about two axes",
            )
        check_excitation(examination, inertial, sight, fit, self._options, metric=metric)
        if examination.fault:
            return None
        geometry = Geometry(
            sight=keyframes(sight),
            fit=fit,
            T_body_cams=self._cameras(fit.R_body_cam)[: 1 + metric],
            inertial=inertial,
        )
        result = self._solve(examination, geometry)
        if result is None:
            return None
        found, replay = self._finds_rotation, self._window.after_origin
        return Start(
            state=self._state(result, inertial, float(geometry.sight.times[0])),
            method="motion",
            T_body_cam=geometry.T_body_cams[0] if found else None,
            rotation_sigma=max(2.0 * fit.rotation_sigma, 2e-3) if found else 0.0,
            camera_delay_s=seconds(replay[0].window.camera_delay_ns) + delay_s + result.state.delay_s,
            replay=replay,
        )

    def _cameras(self, R_body_cam: Array) -> tuple[Array, ...]:
        """T_body_cam (4, 4) of the cameras that are used, with camera 0 turned as found."""
        calibrated = [camera.T_body_cam for camera in self._rig.cameras[:2]]
        T_first = calibrated[0].copy()
        T_first[:3, :3] = R_body_cam
        return tuple(T_first @ np.linalg.inv(calibrated[0]) @ T for T in calibrated)

    def _compare_rotations(self, examination: Examination, inertial: InertialWindow, sight: Sight) -> Agreement:
        """Hold the gyro against the rotations between successive images."""
        calibrated = self._rig.cameras[0].T_body_cam[:3, :3]
        pairs = paired(sight, 1, self._sigma)
        R_start, R_end = inertial.rotations(pairs.starts, np.zeros(3)), inertial.rotations(pairs.ends, np.zeros(3))
        predicted = calibrated.T @ R_start.swapaxes(-1, -2) @ R_end @ calibrated
        still = np.tile(np.eye(3), (len(predicted), 1, 1))
        seen = relative_rotations(pairs.first, pairs.second, pairs.common, (still, predicted), self._sigma)
        agreement = compare_rotations(inertial, pairs.starts, pairs.ends, seen, calibrated)
        turned = turn_deg(seen.R)
        check_rotations(examination, agreement, turned, calibrated, self._options, find=self._finds_rotation)
        return agreement

    @property
    def _finds_rotation(self) -> bool:
        return self._calibration.extrinsics == "find"

    def _believed_delay_s(self, agreement: Agreement) -> float:
        """A delay that the rotations show clearly; what is smaller is left to the bundle adjustment."""
        clear = max(_DELAY_SIGMAS * agreement.delay_sigma_s, _LEAST_DELAY_S)
        better = agreement.residual_delayed < _DELAY_EXPLAINS * agreement.residual
        believed = self._calibration.time_offset and not self._finds_rotation and better
        return agreement.delay_s if believed and abs(agreement.delay_s) > clear else 0.0

    def _fit_rotations(self, inertial: InertialWindow, sight: Sight, agreement: Agreement) -> RotationFit:
        """Gyro bias and the camera's rotation, from pairs of images farther apart."""
        stride = max(round(_PAIR_S / float(np.median(np.diff(sight.times)))), 1)
        pairs = paired(sight, min(stride, len(sight.times) - 1), self._sigma)
        if self._finds_rotation:
            return fit_rotations(inertial, pairs, agreement.R_body_cam, agreement.gyro_bias_rotated, 0.5)
        calibrated = self._rig.cameras[0].T_body_cam[:3, :3]
        return fit_rotations(inertial, pairs, calibrated, agreement.gyro_bias, self._calibration.rotation_sigma)

    def _solve(self, examination: Examination, geometry: Geometry) -> BundleResult | None:
        """Linear solution, then the bundle adjustment; None where one of them is not believed."""
        sight, fit = geometry.sight, geometry.fit
        times = sight.times
        bias = ImuBias(gyro=fit.gyro_bias)
        origin = np.full(len(times) - 1, times[0])
        whole = geometry.inertial.increments(origin, times[1:], bias, self._noise)
        R = np.concatenate([np.eye(3)[None], whole.delta_R])
        P = np.concatenate([np.zeros((1, 3)), whole.delta_p])
        D = np.concatenate([np.zeros((1, 3, 3)), -whole.bias_jacobian[:, 6:, 3:]])
        path, alignment = self._align(geometry, R, P, D)
        self._check_linear(examination, path, alignment)
        if examination.fault:
            return None
        start = window_state(path, alignment, geometry, R, whole.delta_v, fit.gyro_bias)
        between = geometry.inertial.increments(times[:-1], times[1:], start.bias, self._noise)
        rates = np.stack([np.interp(times, geometry.inertial.elapsed, w) for w in geometry.inertial.gyro.T], axis=1)
        priors = BundlePriors(
            gravity=self._rig.gravity,
            gyro_bias_sigma=0.05,
            accel_bias_sigma=self._options.accel_bias_sigma,
            delay_sigma_s=self._calibration.time_offset_sigma_s if self._calibration.time_offset else 1e-6,
        )
        sightings = sightings_of(geometry, self._sigma, np.isfinite(path.points.sum(axis=1)))
        result = refine(start, sightings, between, rates, priors)
        self._check_bundle(examination, result)
        if result is not None:
            self._check_confirmed(examination, SolvedPath.of(result, self._window.origin_ns, times))
        return None if examination.fault else result

    def _check_confirmed(self, examination: Examination, solved: SolvedPath) -> None:
        """A scale is believed when the attempt before found it too: stated sigmas do not know of all errors."""
        before, self._before = self._before, solved
        if examination.fault:
            return
        change = None if before is None else solved.size_against(before)
        if change is None:
            examination.blame(doctor.UNCONFIRMED, "one attempt more must find the same scale")
            return
        limit = self._options.max_scale_change
        examination.at_most(
            "scale change",
            abs(change - 1.0),
            limit,
            "",
            doctor.SCALE,
            f"the scale changed by {abs(change - 1.0):.0%} since the attempt before (limit {limit:.0%}): accelerate "
            "more, sideways and up and down",
        )

    def _align(self, geometry: Geometry, R: Array, P: Array, D: Array) -> tuple[Path, Alignment]:
        sight = geometry.sight
        views = views_of(geometry, R)
        path = solve_path(views)
        lever = np.zeros((len(R), 3)) if views.metric else views.lever - views.lever[0]
        alignment = align(
            path,
            sight.times - sight.times[0],
            P + lever,
            D,
            gravity=self._rig.gravity,
            accel_bias_sigma=self._options.accel_bias_sigma,
            path_sigma=0.02,
        )
        return path, alignment

    def _check_linear(self, examination: Examination, path: Path, alignment: Alignment) -> None:
        examination.note("scale", alignment.scale, "m")
        examination.at_least(
            "points ahead",
            path.ahead,
            0.7,
            "",
            doctor.POINTS_BEHIND,
            f"only {path.ahead:.0%} of the points lie ahead of the cameras that see them: check the order of the "
            "cameras and the sign of their axes",
        )
        if alignment.scale < -_SIGN_SIGMAS * alignment.scale_sigma:
            examination.blame(
                doctor.GRAVITY_SIGN,
                f"the accelerometer and the images move in opposite directions (scale {alignment.scale:.2g}): it must "
                "read +g upwards at rest; turn the sign of its samples",
            )
        elif alignment.scale <= 0.0:
            examination.blame(
                doctor.SCALE,
                f"the scale is not known, not even its sign ({alignment.scale:.2g} ± {alignment.scale_sigma:.2g}): "
                "accelerate more, sideways and up and down",
            )
        examination.at_most(
            "gravity residual",
            abs(alignment.free_gravity - self._rig.gravity),
            1.5,
            "m/s²",
            doctor.GRAVITY,
            f"gravity comes out as {alignment.free_gravity:.2f} m/s² instead of {self._rig.gravity:.2f}: check the "
            "unit of the accelerometer, or wait for smoother motion",
        )

    def _check_bundle(self, examination: Examination, result: BundleResult | None) -> None:
        if result is None:
            examination.blame(doctor.POOR_FIT, "the window cannot be adjusted: its equations have no stable solution")
            return
        options = self._options
        examination.note("delay", 1e3 * result.state.delay_s, "ms")
        examination.note("accelerometer bias", float(np.linalg.norm(result.state.bias.accel)), "m/s²")
        examination.at_most(
            "image residual",
            result.visual,
            3.0,
            "σ",
            doctor.POOR_FIT,
            f"the points miss their predictions by {result.visual:.1f} σ of {options.pixel_sigma:g} px: the scene "
            "moves, or the calibration is wrong",
        )
        examination.at_least(
            "inliers",
            result.inliers,
            0.55,
            "",
            doctor.POOR_FIT,
            f"only {result.inliers:.0%} of the sightings fit one rigid scene: wait for better tracks",
        )
        examination.at_most(
            "inertial residual",
            result.inertial,
            3.0,
            "σ",
            doctor.POOR_FIT,
            f"the inertial increments miss the images by {result.inertial:.1f} σ: check noise and calibration",
        )
        examination.at_most(
            "scale sigma",
            result.scale_sigma,
            options.max_scale_sigma,
            "",
            doctor.SCALE,
            f"the scale is only known to {result.scale_sigma:.0%} (limit {options.max_scale_sigma:.0%}): accelerate "
            "more, sideways and up and down",
        )

    def _state(self, result: BundleResult, inertial: InertialWindow, first_s: float) -> NavState:
        """The state at the stamp of the window's oldest image, from that at the first instant."""
        state = result.state
        T_world_body, velocity = self._at_origin(state, inertial, first_s)
        last = len(result.covariance)
        order = np.concatenate([np.arange(9), np.arange(last - 7, last - 1)])
        covariance = result.covariance[np.ix_(order, order)]
        # Misfits beyond the stated noise widen it further.
        misfit = max(result.visual, result.inertial, 1.0)
        covariance = (self._options.widen * misfit) ** 2 * covariance
        floor = np.repeat([2e-3, 1e-3, 0.02, 1e-3, 0.02], 3)
        return NavState(
            stamp_ns=self._window.origin_ns,
            T_world_body=T_world_body,
            v_world_body=velocity,
            bias=state.bias,
            covariance=covariance + np.diag(floor**2),
        )

    def _at_origin(self, state: WindowState, inertial: InertialWindow, first_s: float) -> tuple[Array, Array]:
        """T_world_body (4, 4) and velocity (3,) at the window's origin, ``first_s`` before the first instant."""
        R, p, v = state.R[0], state.p[0], state.v[0]
        if abs(first_s) < 1e-6:
            return se3.from_parts(R, p), v
        start, end = np.array([min(first_s, 0.0)]), np.array([max(first_s, 0.0)])
        step = inertial.increments(start, end, state.bias, self._noise)
        down, T = np.array([0.0, 0.0, -self._rig.gravity]), abs(first_s)
        if first_s < 0.0:
            return (
                se3.from_parts(R @ step.delta_R[0], p + v * T + 0.5 * down * T**2 + R @ step.delta_p[0]),
                v + down * T + R @ step.delta_v[0],
            )
        R = R @ step.delta_R[0].T
        v = v - down * T - R @ step.delta_v[0]
        return se3.from_parts(R, p - v * T - 0.5 * down * T**2 - R @ step.delta_p[0]), v
