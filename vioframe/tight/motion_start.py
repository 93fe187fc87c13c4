"""A start in motion: from a few seconds of tracks and inertial samples to a state with its covariance.

Rotations between images give the gyro bias and check the calibration; with the rotations known, the camera's path
follows from the points by linear equations, and velocity, gravity and scale from the path and the accelerometer;
a small bundle adjustment refines all of it and says how certain it is. A state that starts wrongly costs more
than one that starts late, so everything is examined before it is believed.
"""

from dataclasses import dataclass

import numpy as np

from vioframe.checks import Array, Mask
from vioframe.geometry import se3, so3
from vioframe.inertial import level
from vioframe.tight import doctor
from vioframe.tight.doctor import Examination
from vioframe.tight.gyro_bias import PairedPoints, RotationFit, fit_rotations
from vioframe.tight.inertial_window import InertialWindow
from vioframe.tight.linear_alignment import Alignment, Path, Views, align, solve_path
from vioframe.tight.motion_checks import (
    check_excitation,
    check_inertial,
    check_points,
    check_rotations,
    check_standstill,
)
from vioframe.tight.motion_options import MotionStartOptions
from vioframe.tight.motion_window import MotionWindow, Sight
from vioframe.tight.options import CalibrationOptions
from vioframe.tight.rotation_agreement import compare_rotations
from vioframe.tight.solved_path import SolvedPath
from vioframe.tight.start_bundle import BundlePriors, BundleResult, Sightings, WindowState, refine
from vioframe.tight.step import Start
from vioframe.tight.two_view_rotation import relative_rotations
from vioframe.types import ImuBias, InitialisationAttempt, Measurement, NavState, SensorRig

_IMAGE_SPACING_S = 0.1
_PAIR_S = 0.4
_KEY_SPACING_S = 0.22
_MOST_KEYS = 14
_MOST_POINTS = 90
_PAIR_POINTS = 70


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Geometry:
    """The keyframes with their rotations: what the linear and the bundled solution share."""

    sight: Sight
    fit: RotationFit
    T_body_cams: tuple[Array, ...]
    inertial: InertialWindow


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
        images = _spaced(sight.times, _IMAGE_SPACING_S)
        sight = sight.at(images)
        check_inertial(examination, inertial, self._rig.imu)
        check_points(examination, sight, self._options)
        check_standstill(examination, inertial, sight, self._rig)
        if examination.fault:
            return None
        fit = self._fit_rotations(examination, inertial, sight)
        if fit is None:
            return None
        metric = len(self._rig.cameras) > 1 and int(sight.seen_stereo.sum()) > self._options.min_points
        check_excitation(examination, inertial, sight, fit, self._options, metric=metric)
        if examination.fault:
            return None
        geometry = _Geometry(
            sight=_keyframes(sight),
            fit=fit,
            T_body_cams=self._cameras(fit.R_body_cam)[: 1 + metric],
            inertial=inertial,
        )
        result = self._solve(examination, geometry)
        if result is None:
            return None
        found = self._calibration.extrinsics == "find"
        return Start(
            state=self._state(result),
            method="motion",
            T_body_cam=geometry.T_body_cams[0] if found else None,
            rotation_sigma=max(self._options.widen * fit.rotation_sigma, 2e-3) if found else 0.0,
            replay=self._window.after_origin,
        )

    def _cameras(self, R_body_cam: Array) -> tuple[Array, ...]:
        """T_body_cam (4, 4) of the cameras that are used, with camera 0 turned as found."""
        calibrated = [camera.T_body_cam for camera in self._rig.cameras[:2]]
        T_first = calibrated[0].copy()
        T_first[:3, :3] = R_body_cam
        return tuple(T_first @ np.linalg.inv(calibrated[0]) @ T for T in calibrated)

    def _fit_rotations(self, examination: Examination, inertial: InertialWindow, sight: Sight) -> RotationFit | None:
        """Gyro bias and the camera's rotation, or None where they contradict the calibration."""
        calibrated = self._rig.cameras[0].T_body_cam[:3, :3]
        find = self._calibration.extrinsics == "find"
        pairs = _paired(sight, 1, self._sigma)
        R_start, R_end = inertial.rotations(pairs.starts, np.zeros(3)), inertial.rotations(pairs.ends, np.zeros(3))
        predicted = calibrated.T @ R_start.swapaxes(-1, -2) @ R_end @ calibrated
        still = np.tile(np.eye(3), (len(predicted), 1, 1))
        seen = relative_rotations(pairs.first, pairs.second, pairs.common, (still, predicted), self._sigma)
        agreement = compare_rotations(inertial, pairs.starts, pairs.ends, seen, calibrated)
        check_rotations(examination, agreement, _turn_deg(seen.R), calibrated, self._options, find=find)
        if examination.fault:
            return None
        known = agreement.R_body_cam if find else calibrated
        sigma = 0.5 if find else self._calibration.rotation_sigma
        stride = max(round(_PAIR_S / float(np.median(pairs.ends - pairs.starts))), 1)
        wide = _paired(sight, min(stride, len(sight.times) - 1), self._sigma)
        fit = fit_rotations(inertial, wide, known, agreement.gyro_bias, sigma)
        examination.note("gyro bias", float(np.linalg.norm(fit.gyro_bias)), "rad/s")
        return fit

    def _solve(self, examination: Examination, geometry: _Geometry) -> BundleResult | None:
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
        start = _window_state(path, alignment, geometry, R, whole.delta_v, fit.gyro_bias)
        between = geometry.inertial.increments(times[:-1], times[1:], start.bias, self._noise)
        rates = np.stack([np.interp(times, geometry.inertial.elapsed, w) for w in geometry.inertial.gyro.T], axis=1)
        priors = BundlePriors(
            gravity=self._rig.gravity,
            gyro_bias_sigma=0.05,
            accel_bias_sigma=self._options.accel_bias_sigma,
            delay_sigma_s=self._calibration.time_offset_sigma_s if self._calibration.time_offset else 1e-6,
        )
        sightings = _sightings(geometry, self._sigma, np.isfinite(path.points.sum(axis=1)))
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

    def _align(self, geometry: _Geometry, R: Array, P: Array, D: Array) -> tuple[Path, Alignment]:
        sight = geometry.sight
        directions, seen, levers, instants = [], [], [], []
        sources = [(sight.bearings, sight.seen), (sight.stereo, sight.seen_stereo)]
        metric = len(geometry.T_body_cams) > 1
        for (bearings, mask), T_body_cam in zip(sources[: 1 + metric], geometry.T_body_cams, strict=False):
            directions.append(bearings @ T_body_cam[:3, :3].T @ R.swapaxes(-1, -2))
            seen.append(mask)
            levers.append(R @ T_body_cam[:3, 3])
            instants.append(np.arange(len(R)))
        views = Views(
            instants=np.concatenate(instants),
            direction=np.concatenate(directions),
            seen=np.concatenate(seen),
            lever=np.concatenate(levers),
            metric=metric,
        )
        path = solve_path(views)
        lever = np.zeros((len(R), 3)) if metric else levers[0] - levers[0][0]
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
        if alignment.scale <= 0.0:
            examination.blame(
                doctor.GRAVITY_SIGN,
                f"the accelerometer and the images move in opposite directions (scale {alignment.scale:.2g}): it must "
                "read +g upwards at rest; turn the sign of its samples",
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
            0.7,
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

    def _state(self, result: BundleResult) -> NavState:
        state = result.state
        last = len(result.covariance)
        order = np.concatenate([np.arange(9), np.arange(last - 7, last - 1)])
        covariance = result.covariance[np.ix_(order, order)]
        # Misfits beyond the stated noise widen it further.
        misfit = max(result.visual, result.inertial, 1.0)
        covariance = (self._options.widen * misfit) ** 2 * covariance
        floor = np.repeat([2e-3, 1e-3, 0.02, 1e-3, 0.02], 3)
        return NavState(
            stamp_ns=self._window.origin_ns,
            T_world_body=se3.from_parts(state.R[0], state.p[0]),
            v_world_body=state.v[0],
            bias=state.bias,
            covariance=covariance + np.diag(floor**2),
        )


def _spaced(times: Array, spacing_s: float) -> Array:
    """Indices of times about ``spacing_s`` apart, the first and the last included."""
    count = max(round((times[-1] - times[0]) / spacing_s) + 1, 2)
    wanted = np.linspace(times[0], times[-1], count)
    return np.unique(np.abs(times[None] - wanted[:, None]).argmin(axis=1))


def _turn_deg(R_prev_cur: Array) -> float:
    """Largest angle, degrees, between the first image and another, from the rotations between successive ones."""
    R, largest = np.eye(3), 0.0
    for turn in R_prev_cur:
        R = R @ turn
        largest = max(largest, float(so3.angle(R)))
    return float(np.degrees(largest))


def _paired(sight: Sight, stride: int, sigma: float) -> PairedPoints:
    """Pairs of images ``stride`` apart, with up to ``_PAIR_POINTS`` points in common."""
    first, second = np.arange(len(sight.times) - stride), np.arange(stride, len(sight.times))
    both = sight.seen[first] & sight.seen[second]
    most = int(np.clip(both.sum(axis=1).max(), 1, _PAIR_POINTS))
    at = np.argsort(~both, axis=1, kind="stable")[:, :most]
    return PairedPoints(
        starts=sight.times[first],
        ends=sight.times[second],
        first=np.take_along_axis(sight.bearings[first], at[..., None], axis=1),
        second=np.take_along_axis(sight.bearings[second], at[..., None], axis=1),
        common=np.take_along_axis(both, at, axis=1),
        sigma=sigma,
    )


def _keyframes(sight: Sight) -> Sight:
    """Fewer images, and the points that most of them see."""
    spacing = max(_KEY_SPACING_S, float(sight.times[-1] - sight.times[0]) / (_MOST_KEYS - 1))
    keys = sight.at(_spaced(sight.times, spacing))
    count = keys.seen.sum(axis=0)
    points = np.argsort(-count, kind="stable")[:_MOST_POINTS]
    return keys.of(points[count[points] >= 3])


def _window_state(
    path: Path, alignment: Alignment, geometry: _Geometry, R: Array, delta_v: Array, gyro_bias: Array
) -> WindowState:
    """The linear solution in a world whose z axis is up, as unknowns of the bundle adjustment."""
    sight = geometry.sight
    times = (sight.times - sight.times[0])[:, None]
    R_world_first = level(-alignment.gravity)
    lever = geometry.T_body_cams[0][:3, 3]
    scale = 1.0 if path.metric else alignment.scale
    moved = 0.0 if path.metric else R @ lever - lever
    places = scale * path.places - moved
    velocity = alignment.velocity + alignment.gravity * times + np.concatenate([np.zeros((1, 3)), delta_v])
    # Points in the frame of the first view, whose origin is the camera, or the body where the path is metric.
    origin = 0.0 if path.metric else lever
    points = scale * path.points + origin
    anchor = np.argmax(sight.seen, axis=0)
    centres = places + R @ lever
    distance = np.linalg.norm(points - centres[anchor], axis=1)
    return WindowState(
        R=R_world_first @ R,
        p=places @ R_world_first.T,
        v=velocity @ R_world_first.T,
        bias=ImuBias(gyro=gyro_bias, accel=alignment.accel_bias),
        delay_s=0.0,
        inverse_depth=1.0 / np.clip(np.nan_to_num(distance, nan=10.0), 0.2, 400.0),
    )


def _sightings(geometry: _Geometry, sigma: float, usable: Mask) -> Sightings:
    sight = geometry.sight
    K = len(sight.times)
    anchor = np.argmax(sight.seen, axis=0)
    seen = sight.seen & usable
    seen[anchor, np.arange(len(anchor))] = False
    view, point = np.nonzero(seen)
    view_right, point_right = np.nonzero(sight.seen_stereo & usable)
    cams = geometry.T_body_cams
    T = np.concatenate([np.tile(cams[0], (K, 1, 1)), np.tile(cams[-1], (K, 1, 1))])
    if len(cams) == 1:
        view_right, point_right = view_right[:0], point_right[:0]
    return Sightings(
        point=np.concatenate([point, point_right]),
        view=np.concatenate([view, view_right + K]),
        anchor=anchor,
        ray=np.concatenate([sight.bearings[view, point], sight.stereo[view_right, point_right]]),
        anchor_ray=sight.bearings[anchor, np.arange(len(anchor))],
        instant=np.tile(np.arange(K), 2),
        R_body_cam=T[:, :3, :3],
        p_body_cam=T[:, :3, 3],
        sigma=sigma,
    )
