"""Tightly coupled estimators on points seen without images: exact projections with noise, through the real pipeline."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from synthetic_tracks import see
from vioframe.geometry import camera as projection
from vioframe.geometry.interpolation import interpolate_poses
from vioframe.interfaces import Fuser
from vioframe.types import (
    Frame,
    Measurement,
    NavState,
    Packet,
    SensorRig,
    Tracks,
    Trajectory,
    VisualFeatures,
)
from vioframe_preintegration import Preintegration
from vioframe_sync import InterpolateSynchronizer


def points_around(truth: Trajectory, seed: int, count: int = 4000, far_m: float = 4.0) -> np.ndarray:
    """Points on the walls of a box around a trajectory, and some inside it near the walls, (count, 3)."""
    rng = np.random.default_rng(seed)
    p = truth.T_world_body[:, :3, 3]
    margin = np.array([far_m, far_m, 2.0])
    low, high = p.min(axis=0) - margin, p.max(axis=0) + margin
    unit = rng.uniform(0.0, 1.0, (count, 3))
    side = np.arange(count)
    unit[side, rng.integers(0, 3, count)] = rng.choice([0.0, 1.0], count) + rng.uniform(-0.1, 0.1, count)
    return low + unit * (high - low)


@dataclass
class PointCamera:
    """Follows points through the views of a rig, as a front end would.

    ``rig`` is the true one; camera stamps are the IMU's minus its delay.
    """

    rig: SensorRig
    truth: Trajectory
    points: np.ndarray
    sigma_px: float = 0.5
    most: int = 150
    lose: float = 0.01
    seed: int = 0
    blind: tuple[tuple[float, float], ...] = ()
    outliers: float = 0.0

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng(self.seed)
        self._alive, self._ids, self._next = np.zeros(0, dtype=int), np.zeros(0, dtype=np.int64), 0

    def look(self, camera_stamp_ns: int) -> VisualFeatures:
        """Features at a stamp of the camera's clock; stamps must not go back."""
        rng, frame = self._rng, Frame(stamp_ns=camera_stamp_ns)
        stamp_ns = camera_stamp_ns + self.rig.camera_delay_ns
        T, known = interpolate_poses(self.truth, np.array([stamp_ns]), max_gap_ns=10**8)
        elapsed = (stamp_ns - int(self.truth.stamps_ns[0])) / 1e9
        if not known[0] or any(a <= elapsed < b for a, b in self.blind):
            self._alive, self._ids = self._alive[:0], self._ids[:0]
            return VisualFeatures(frame=frame, tracks=Tracks.none())
        camera = self.rig.cameras[0]
        pixels, visible = see(camera, T[0] @ camera.T_body_cam, self.points)
        keep = visible[self._alive] & (rng.random(len(self._alive)) > self.lose)
        self._alive, self._ids = self._alive[keep], self._ids[keep]
        if len(self._alive) < 0.85 * self.most:
            new = rng.permutation(np.setdiff1d(np.flatnonzero(visible), self._alive))[: self.most - len(self._alive)]
            self._alive = np.concatenate([self._alive, new])
            self._ids = np.concatenate([self._ids, np.arange(self._next, self._next + len(new))])
            self._next += len(new)
        tracks = self._measured(0, pixels[self._alive], self._ids)
        stereo = None
        if len(self.rig.cameras) > 1:
            other = self.rig.cameras[1]
            there, seen = see(other, T[0] @ other.T_body_cam, self.points[self._alive])
            seen &= rng.random(len(seen)) < 0.9
            stereo = self._measured(1, there[seen], self._ids[seen])
        return VisualFeatures(frame=frame, tracks=tracks, stereo=stereo)

    def _measured(self, index: int, pixels: np.ndarray, ids: np.ndarray) -> Tracks:
        measured = pixels + self.sigma_px * self._rng.standard_normal(pixels.shape)
        wrong = self._rng.random(len(pixels)) < self.outliers
        measured[wrong] += self._rng.uniform(-15, 15, (int(wrong.sum()), 2))
        camera = self.rig.cameras[index]
        bearings = projection.bearings(camera, measured)
        return Tracks(ids=ids, pixels=measured, bearings=bearings, scores=np.ones(len(ids)), camera=index)


@dataclass
class PointRun:
    """What a fuser said, and the truth."""

    truth: Trajectory
    states: list[NavState] = field(default_factory=list)
    delays_ns: list[int] = field(default_factory=list)

    def errors(self) -> np.ndarray:
        """Errors (N, 15) of the states in the order of their covariance, biases left zero."""
        from vioframe.geometry import so3

        stamps = np.array([s.stamp_ns for s in self.states])
        T, _ = interpolate_poses(self.truth, stamps, max_gap_ns=10**8)
        out = np.zeros((len(stamps), 15))
        for row, (state, true) in enumerate(zip(self.states, T, strict=True)):
            out[row, 0:3] = so3.log(state.T_world_body[:3, :3].T @ true[:3, :3])
            out[row, 3:6] = true[:3, 3] - state.T_world_body[:3, 3]
            if self.truth.v_world_body is not None:
                velocity = [np.interp(state.stamp_ns, self.truth.stamps_ns, v) for v in self.truth.v_world_body.T]
                out[row, 6:9] = np.array(velocity) - state.v_world_body
        return out

    def true_state(self, stamp_ns: int) -> NavState:
        T, _ = interpolate_poses(self.truth, np.array([stamp_ns]), max_gap_ns=10**8)
        velocity = [np.interp(stamp_ns, self.truth.stamps_ns, v) for v in self.truth.v_world_body.T]
        return NavState(stamp_ns=stamp_ns, T_world_body=T[0], v_world_body=np.array(velocity))


def play_points(
    fuser: Fuser,
    packets: Iterable[Packet],
    believed: SensorRig,
    eyes: PointCamera,
    *,
    initial: Callable[[NavState], NavState] | None = None,
    change: Callable[[int, Measurement], Measurement | None] = lambda index, measurement: measurement,
) -> PointRun:
    """Give a fuser what the cameras and the inertial sensor see.

    Args:
        fuser: set up here with ``believed``.
        packets: frames without pixels (camera clock) among inertial samples.
        believed: the calibration that the fuser is told; ``eyes.rig`` is the true one.
        eyes: what is seen.
        initial: makes of the true first state the one to start from; None to let it start by itself.
        change: may spoil each measurement, or swallow it.
    """
    run = PointRun(truth=eyes.truth)
    sync, integrator = InterpolateSynchronizer(), Preintegration()
    for part in (sync, integrator, fuser):
        part.setup(believed)
    index, looked = 0, {}
    for packet in packets:
        if isinstance(packet, Frame):
            looked[packet.stamp_ns] = eyes.look(packet.stamp_ns)
        for window in sync.push(packet):
            stamp_ns = window.current.stamp_ns - window.camera_delay_ns
            features = replace(looked.pop(stamp_ns), frame=window.current)
            if index == 0 and initial is not None:
                fuser.start_from(initial(run.true_state(window.previous.stamp_ns)))
            delta = integrator.integrate(window.imu, fuser.bias())
            measurement = change(index, Measurement(window=window, features=features, inertial_delta=delta))
            index += 1
            if measurement is None:
                continue
            run.states += fuser.update(measurement)
            delay_ns = fuser.camera_delay_ns()
            if delay_ns is not None:
                sync.assume_camera_delay(delay_ns)
                run.delays_ns.append(delay_ns)
    return run
