"""The tightly coupled filter: one window of inertial samples and tracks at a time."""

import numpy as np

from vioframe.checks import Array, Mask, Stamps
from vioframe.consistency import chi_square_limit
from vioframe.conventions import NANOSECONDS
from vioframe.fusion_options import StandstillOptions
from vioframe.geometry import se3
from vioframe.tight.fuser import TightFuser
from vioframe.tight.options import CalibrationOptions, FailureOptions, InertialTrust
from vioframe.tight.start import TightStartOptions
from vioframe.tight.step import Start, Step, Support
from vioframe.types import NavState, SensorRig
from vioframe_msckf.correction import correct_by_information
from vioframe_msckf.landmarks import Sightings, add_landmarks, correct_by_sightings
from vioframe_msckf.options import PointOptions
from vioframe_msckf.pixel_noise import PixelNoise
from vioframe_msckf.standstill import measure_standstill
from vioframe_msckf.state import FilterState
from vioframe_msckf.track_table import TrackTable, find_sorted
from vioframe_msckf.track_update import Linearised, chi_squares, information, linearise, point_errors
from vioframe_msckf.triangulation import in_front, triangulate, widest_parallax

# Images are stamped with a new delay in steps of at most this, so that no stamp goes back.
_DELAY_STEP_S = 0.01
# The rate at an image is the mean over so long before it.
_RATE_NS = 30_000_000
# rad/s of it that idling motors make (EuRoC).
_VIBRATION = 0.1


class MsckfFuser(TightFuser):
    """Multi-state constraint Kalman filter with a right-invariant error.

    Mourikis & Roumeliotis, "A Multi-State Constraint Kalman Filter for Vision-aided Inertial Navigation",
    ICRA 2007; the invariant error after Barrau & Bonnabel 2015.

    Args:
        points: how image points are used.
        stereo: True needs the points in camera 1 too, False leaves them out, None takes what the front end gives.
        inertial: trust in the inertial increments.
        calibration: what of the calibration is estimated.
        standstill: measuring no motion at rest.
        start: how it begins.
        failure: when it is not believed any more.
    """

    def __init__(
        self,
        *,
        points: PointOptions | None = None,
        stereo: bool | None = None,
        inertial: InertialTrust | None = None,
        calibration: CalibrationOptions | None = None,
        standstill: StandstillOptions | None = None,
        start: TightStartOptions | None = None,
        failure: FailureOptions | None = None,
    ) -> None:
        super().__init__(
            stereo=stereo,
            inertial=inertial,
            calibration=calibration,
            standstill=standstill,
            start=start,
            failure=failure,
        )
        self._points = points or PointOptions()

    def setup(self, rig: SensorRig) -> None:
        """Forget the last sequence and take the next one's calibration."""
        super().setup(rig)
        cameras = rig.cameras[:2]
        self._noise_of = [PixelNoise(camera, self._points.sigma_px) for camera in cameras]
        self._told_delay_s = rig.camera_delay_ns / NANOSECONDS
        self._T_cam_others = [se3.inverse(cameras[0].T_body_cam) @ camera.T_body_cam for camera in cameras]
        most = 2 * len(cameras) * (self._points.clones + 1)
        self._limits = np.array([0.0] + [chi_square_limit(0.95, degrees) for degrees in range(1, most + 1)])

    def T_body_cam(self) -> Array:
        """Place of camera 0 on the body, (4, 4), as estimated now."""
        return self._state.T_body_cam if self._ready and self._running else super().T_body_cam()

    def camera_delay_ns(self) -> int | None:
        """The estimated delay, approached in small steps; None where it is not estimated."""
        if not self._ready or not self._running or not self._calibration.time_offset:
            return None
        return self._told_delay_ns

    def _begin(self, start: Start) -> None:
        calibration = self._calibration
        self._state = FilterState(self._noise, self._rig.gravity)
        covariance = start.state.covariance
        sigmas = np.zeros(7)
        T_body_cam = self._rig.cameras[0].T_body_cam
        if calibration.estimates_extrinsics:
            sigmas[:3], sigmas[3:6] = calibration.rotation_sigma, calibration.position_sigma
        if start.T_body_cam is not None:
            T_body_cam = start.T_body_cam
            sigmas[:3] = max(start.rotation_sigma, sigmas[0])
        if calibration.time_offset:
            sigmas[6] = calibration.time_offset_sigma_s
        self._state.start(
            start.state,
            self._start_options.covariance_of(start.state) if covariance is None else covariance,
            T_body_cam,
            np.diag(sigmas**2),
        )
        self._state.delay_s = self._told_delay_s if start.camera_delay_s is None else start.camera_delay_s
        self._table = TrackTable(len(self._noise_of), self._points.clones + 1)
        self._misses: dict[int, int] = {}
        self._now_ns = start.state.stamp_ns

    @property
    def _told_delay_ns(self) -> int:
        return round(self._told_delay_s * NANOSECONDS)

    def _estimate(self) -> NavState:
        return self._state.nav_state(self._now_ns)

    def _advance(self, step: Step) -> Support:
        state = self._state
        state.propagate(step.delta)
        self._now_ns = step.stamp_ns
        used = refused = 0
        at_rest = False
        self._table.begin_image()
        if step.at_rest and len(state.p_clones) > 0:
            at_rest = measure_standstill(state, self._standstill)
        if at_rest:
            # Another clone of the same place would push out those that have parallax.
            self._table.keep_alive(step.tracks.ids)
        elif len(step.tracks):
            self._add_clone(step)
            used, refused = self._see(step)
        else:
            self._drop_lost_landmarks(np.zeros(len(state.points), dtype=bool))
        more_used, more_refused = self._use_up_tracks()
        if len(state.p_clones) > self._points.clones:
            state.drop_clone(0)
            self._table.drop_column(0)
        state.tidy()
        self._follow_delay()
        refused += more_refused
        if refused:
            self._count("refused observations", refused)
        return Support(used=used + more_used, refused=refused, points=len(state.points), at_rest=at_rest)

    def _add_clone(self, step: Step) -> None:
        body = self._state.body
        # The rate is the delay's regressor, and noise in a regressor makes sure of zero: average, and shrink what
        # may be vibration (James & Stein 1961).
        imu = step.window.imu
        recent = imu.stamps_ns >= imu.stamps_ns[-1] - _RATE_NS
        rate = imu.gyro[recent].mean(axis=0) - body.bias.gyro
        rate = rate * max(0.0, 1.0 - _VIBRATION**2 / max(float(rate @ rate), 1e-12))
        later_s = self._state.delay_s - step.window.camera_delay_ns / NANOSECONDS
        self._state.add_clone(later_s, rate)

    def _see(self, step: Step) -> tuple[int, int]:
        """Correct by the points of the state that the image shows, and enter the other tracks into the table."""
        state, column = self._state, len(self._state.p_clones) - 1
        order = np.argsort(state.point_ids)
        ordered = state.point_ids[order]
        parts, seen = [], np.zeros(len(ordered), dtype=bool)
        for camera, tracks in enumerate((step.tracks, step.stereo)[: len(self._noise_of)]):
            if tracks is None or not len(tracks):
                continue
            measured, weights = self._noise_of[camera].measure(tracks.pixels, tracks.bearings)
            places, is_point = find_sorted(ordered, tracks.ids)
            new = ~is_point & (weights > 0.0)
            self._table.add(camera, column, tracks.ids[new], measured[new], weights[new])
            here = is_point & (weights > 0.0)
            index = order[places[here]]
            if camera == 0:
                seen[index] = True
            R, p = self._poses(camera)
            parts.append(
                Sightings(
                    index=index,
                    R=np.broadcast_to(R[-1], (len(index), 3, 3)),
                    p=np.broadcast_to(p[-1], (len(index), 3)),
                    measured=measured[here],
                    weights=weights[here] * (self._points.sigma_px / self._points.landmark_sigma_px),
                )
            )
        used = refused = 0
        if len(state.points) and parts:
            used, refused = self._correct_by_points(parts)
        self._drop_lost_landmarks(seen)
        return used, refused

    def _correct_by_points(self, parts: list[Sightings]) -> tuple[int, int]:
        sightings = Sightings(
            index=np.concatenate([part.index for part in parts]),
            R=np.concatenate([part.R for part in parts]),
            p=np.concatenate([part.p for part in parts]),
            measured=np.concatenate([part.measured for part in parts]),
            weights=np.concatenate([part.weights for part in parts]),
        )
        if not len(sightings.index):
            return 0, 0
        limit = self._points.landmark_gate * self._limits[2]
        gate_noise = (self._points.sigma_px / self._points.landmark_sigma_px) ** 2
        fits = correct_by_sightings(self._state, sightings, limit, self._points.min_depth_m, gate_noise)
        ids = self._state.point_ids[sightings.index]
        bad = set(ids[~fits].tolist())
        self._misses = {key: self._misses.get(key, 0) + 1 for key in bad}
        return int(fits.sum()), int((~fits).sum())

    def _drop_lost_landmarks(self, seen: Mask) -> None:
        """Marginalise the points that are not followed any more, or were refused twice in a row."""
        ids = self._state.point_ids
        refused = [key for key, times in self._misses.items() if times >= 2]
        self._state.drop_points(~seen | np.isin(ids, refused) if refused else ~seen)

    def _poses(self, camera: int) -> tuple[Array, Array]:
        """R (M, 3, 3) and p (M, 3) of a camera of the rig at all clones."""
        R, p = self._state.R_clones, self._state.p_clones
        if camera == 0:
            return R, p
        T = self._T_cam_others[camera]
        return R @ T[:3, :3], p + R @ T[:3, 3]

    def _use_up_tracks(self) -> tuple[int, int]:
        """Correct by the tracks that have ended and by those as old as the oldest clone; forget them."""
        table, options = self._table, self._points
        clones = len(self._state.p_clones)
        if not len(table) or not clones:
            return 0, 0
        in_clone = table.weights[:, 0] > 0.0
        lengths = in_clone.sum(axis=1)
        full = clones > options.clones
        due = ~table.seen | (in_clone[:, 0] if full else False)
        long = due & (lengths >= options.min_observations)
        rows = np.flatnonzero(long)
        if len(rows) > options.tracks_per_frame:
            rows = rows[np.argsort(-lengths[rows], kind="stable")[: options.tracks_per_frame]]
        drop = ~table.seen
        drop[rows] = True
        used = refused = 0
        if len(rows):
            used, refused = self._correct_by_tracks(rows, full)
        table.drop_rows(drop)
        return used, refused

    def _correct_by_tracks(self, rows: Stamps, full: bool) -> tuple[int, int]:
        table, state, options = self._table, self._state, self._points
        clones = len(state.p_clones)
        points, weights = table.points[rows][:, :, :clones], table.weights[rows][:, :, :clones]
        poses = [self._poses(camera) for camera in range(len(self._noise_of))]
        R, p = np.stack([pose[0] for pose in poses]), np.stack([pose[1] for pose in poses])
        R_all, p_all = R.reshape(-1, 3, 3), p.reshape(-1, 3)
        flat_points, flat_weights = points.reshape(len(rows), -1, 2), weights.reshape(len(rows), -1)
        anchors = clones - 1 - np.argmax(weights[:, 0, ::-1] > 0.0, axis=1)
        found, _ = triangulate(R_all, p_all, flat_points, flat_weights, anchors)
        good = in_front(R_all, p_all, found, flat_weights, options.min_depth_m, options.max_depth_m)
        if not good.any():
            return 0, 0
        rows, found, points, weights = rows[good], found[good], points[good], weights[good]
        tracks = linearise(R, p, found, points, weights)
        ray = found - p_all[anchors[good]]
        distance2 = (ray * ray).sum(axis=1)
        sure = ((ray[:, None] @ tracks.G)[:, 0] * ray).sum(axis=1) < (options.max_depth_ratio * distance2) ** 2
        good[good] = sure
        if not sure.any():
            return 0, 0
        rows, weights, tracks = rows[sure], weights[sure], tracks.pick(sure)
        limits = options.track_gate * self._limits[(tracks.rows - 3).astype(np.int64)]
        fits = tracks.squares <= limits
        columns = state.clone_errors
        if not fits.all():
            # Only what might not pass needs the covariance.
            doubtful = ~fits
            P_cc = state.covariance[columns, columns]
            fits[doubtful] = chi_squares(tracks.pick(doubtful), P_cc) <= limits[doubtful]
        refused = int((weights[~fits] > 0.0).sum())
        if not fits.any():
            return 0, refused
        chosen = tracks.pick(fits)
        if full and len(state.points) < options.landmarks:
            self._promote(rows[fits], chosen, weights[fits], flat_points[good][fits], R_all, anchors[good][fits])
        Lambda, eta = information(chosen)
        if not correct_by_information(state, Lambda, eta):
            self._count("corrections without a finite answer")
            return 0, refused
        return int((weights[fits] > 0.0).sum()), refused

    def _promote(
        self, rows: Stamps, tracks: Linearised, weights: Array, points: Array, R: Array, anchors: Stamps
    ) -> None:
        """Take tracks that span all clones with enough parallax into the state."""
        table, state, options = self._table, self._state, self._points
        spans = (weights[:, 0] > 0.0).all(axis=1) & table.seen[rows]
        # A point that slides along an edge passes the gate of a track, but would bend the scale for long.
        spans &= tracks.squares <= self._limits[(tracks.rows - 3.0).astype(np.int64)]
        parallax = widest_parallax(R, points, weights.reshape(len(rows), -1), anchors)
        wanted = np.flatnonzero(spans & (parallax > np.deg2rad(options.landmark_parallax_deg)))
        free = options.landmarks - len(state.points)
        wanted = wanted[np.argsort(-parallax[wanted], kind="stable")[:free]]
        if not len(wanted):
            return
        mask = np.zeros(len(rows), dtype=bool)
        mask[wanted] = True
        picked = tracks.pick(mask)
        add_landmarks(state, table.ids[rows[mask]], picked.found, point_errors(picked), picked.G)

    def _follow_delay(self) -> None:
        change = self._state.delay_s - self._told_delay_s
        self._told_delay_s += float(np.clip(change, -_DELAY_STEP_S, _DELAY_STEP_S))
