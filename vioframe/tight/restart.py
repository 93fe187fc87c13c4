"""What bridges the time between a failure and the next start: dead reckoning, and the frame it keeps."""

from dataclasses import replace

import numpy as np

from vioframe.checks import Array
from vioframe.conventions import seconds
from vioframe.error_state import Body, InertialFilter
from vioframe.geometry import so3
from vioframe.increments import coasting
from vioframe.tight.options import InertialTrust
from vioframe.tight.step import Step
from vioframe.types import ImuBias, ImuBlock, ImuNoise, Measurement, NavState, SyncedWindow

# A starter looks back over its window, a few seconds.
_HISTORY = 400


class DeadReckoning:
    """Goes on from a state with inertial samples alone.

    Args:
        state: where it begins; a covariance it lacks is taken as small.
        noise: densities of the inertial sensor.
        gravity: magnitude, m/s².
    """

    def __init__(self, state: NavState, noise: ImuNoise, gravity: float) -> None:
        self._filter = InertialFilter(extra=0, noise=noise, gravity=gravity)
        self._filter.start(state, 1e-6 * np.eye(15) if state.covariance is None else state.covariance)
        self._states = {state.stamp_ns: self._filter.nav_state(state.stamp_ns, "lost")}

    @property
    def bias(self) -> ImuBias:
        """The bias of the state it began from."""
        return self._filter.body.bias

    def move_on(self, step: Step) -> None:
        """Move on by one window."""
        self._filter.propagate(step.delta)
        self._states[step.stamp_ns] = self._filter.nav_state(step.stamp_ns, "lost")
        if len(self._states) > _HISTORY:
            self._states.pop(next(iter(self._states)))

    def state(self, stamp_ns: int) -> NavState:
        """The state at a stamp that was passed, of status ``lost``; the nearest one where it is not kept."""
        if stamp_ns in self._states:
            return self._states[stamp_ns]
        return self._states[min(self._states, key=lambda known: abs(known - stamp_ns))]

    def brought_into_frame(self, state: NavState) -> NavState:
        """A new start, turned about the vertical and shifted so that it continues this trajectory.

        Its position and heading are then as uncertain as the dead reckoning; tilt, velocity and biases are
        its own.
        """
        reached = self.state(state.stamp_ns)
        R_new, R_old = state.T_world_body[:3, :3], reached.T_world_body[:3, :3]
        turn = R_old @ R_new.T
        R_frame = so3.rotation_z(float(np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])))
        T_world_body = reached.T_world_body.copy()
        T_world_body[:3, :3] = R_frame @ R_new
        covariance = None
        if state.covariance is not None and reached.covariance is not None:
            rotated = np.eye(15)
            rotated[3:6, 3:6] = rotated[6:9, 6:9] = R_frame
            covariance = rotated @ state.covariance @ rotated.T
            covariance[3:6, 3:6] += reached.covariance[3:6, 3:6]
            covariance[:3, :3] += _heading_covariance(T_world_body[:3, :3], R_old, reached.covariance[:3, :3])
        return replace(
            state, T_world_body=T_world_body, v_world_body=R_frame @ state.v_world_body, covariance=covariance
        )


def _heading_covariance(R_world_body: Array, R_reached: Array, covariance: Array) -> Array:
    """The part about the vertical (3, 3) of ``R_reached``'s covariance, in the body of ``R_world_body``."""
    up = np.array([0.0, 0.0, 1.0])
    variance = float(up @ R_reached @ covariance @ R_reached.T @ up)
    axis = R_world_body.T @ up
    return variance * np.outer(axis, axis)


def coast_across(state: NavState, window: SyncedWindow, gravity: float, trust: InertialTrust) -> Measurement:
    """A window made up for a stretch that none came for: constant velocity and attitude, and no image.

    Args:
        state: at the start of the stretch.
        window: the one that follows it.
        gravity: m/s².
        trust: how uncertain such a stretch is.
    """
    before = replace(window.previous, stamp_ns=state.stamp_ns, images=())
    made_up = SyncedWindow(previous=before, current=window.previous, imu=ImuBlock.none(), gap_ns=0)
    return coast_through(state, Measurement(window=made_up), gravity, trust)


def coast_through(state: NavState, measurement: Measurement, gravity: float, trust: InertialTrust) -> Measurement:
    """A window that came without inertial samples, with those of constant velocity and attitude; what is seen stays.

    Args:
        state: at the start of the window.
        measurement: the window, without samples and increment.
        gravity: m/s².
        trust: how uncertain such a stretch is.
    """
    window = measurement.window
    body = Body.of(state)
    down = np.array([0.0, 0.0, -gravity])
    stamps_ns = np.array([window.previous.stamp_ns, window.current.stamp_ns])
    duration_ns = int(stamps_ns[1] - stamps_ns[0])
    lift = body.bias.accel - body.R.T @ down
    samples = ImuBlock(stamps_ns=stamps_ns, gyro=np.tile(body.bias.gyro, (2, 1)), accel=np.tile(lift, (2, 1)))
    return replace(
        measurement,
        window=replace(window, imu=samples, gap_ns=duration_ns),
        inertial_delta=coasting(body, seconds(duration_ns), down, trust.gap_rate_sigma, trust.gap_accel_sigma),
    )
