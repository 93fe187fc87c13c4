"""The camera's motions put one after the other."""

from collections import Counter
from collections.abc import Mapping
from typing import ClassVar, Literal

import numpy as np

from vioframe.checks import Array
from vioframe.conventions import seconds
from vioframe.errors import ConfigError, StateError
from vioframe.geometry import se3, so3
from vioframe.inertial import level
from vioframe.initialisation import initial_covariance
from vioframe.interfaces import CONSISTENT_SCALE, RELATIVE_POSE, Fuser
from vioframe.types import Measurement, NavState, RelativePose, SensorRig, Status

OnInvalid = Literal["constant_velocity", "hold"]

# What NavState.covariance says of biases that nobody estimated: as good as unknown.
_UNKNOWN_GYRO_BIAS, _UNKNOWN_ACCEL_BIAS = 0.1, 1.0


class VoOnlyFuser(Fuser):
    """Composes relative poses into the pose of the body.

    Each motion of the camera is moved to the body through the lever arm, which needs metres: with a VO of
    unknown scale, ``scale`` says how many metres its unit is.

    Args:
        scale: metres per unit of the VO's translation.
        on_invalid: over a window without a valid motion, go on with the last one (``constant_velocity``) or
            stay (``hold``). The status is ``lost`` there.
        level: begin with roll and pitch from the mean specific force of the first window, which errs by the
            body's acceleration over gravity; otherwise, and where there are no samples, with the body's axes as the
            world's. A given state (``init=groundtruth``) comes before either.
        tilt_sigma: rad, of roll and pitch at a start without a given state.
        coast_rate_sigma: rad/s an axis, unknown rate over a window without a valid motion.
        coast_accel_sigma: m/s² an axis, unknown acceleration over such a window.

    Raises:
        ConfigError: an option outside its range.
    """

    requires: ClassVar[frozenset[str]] = frozenset({RELATIVE_POSE, CONSISTENT_SCALE})

    def __init__(
        self,
        *,
        scale: float = 1.0,
        on_invalid: OnInvalid = "constant_velocity",
        level: bool = True,
        tilt_sigma: float = 0.02,
        coast_rate_sigma: float = 0.5,
        coast_accel_sigma: float = 2.0,
    ) -> None:
        if not scale > 0.0:
            raise ConfigError(f"fuser.scale must be positive (metres per unit of the VO), got {scale}")
        if on_invalid not in ("constant_velocity", "hold"):
            raise ConfigError(f"fuser.on_invalid must be constant_velocity or hold, got {on_invalid!r}")
        if not tilt_sigma > 0.0:
            raise ConfigError(f"fuser.tilt_sigma must be positive, got {tilt_sigma}")
        for name, value in (("coast_rate_sigma", coast_rate_sigma), ("coast_accel_sigma", coast_accel_sigma)):
            if not value >= 0.0:
                raise ConfigError(f"fuser.{name} must not be negative, got {value}")
        self._scale = scale
        self._hold = on_invalid == "hold"
        self._level = level
        self._tilt_sigma = tilt_sigma
        self._coast_sigmas = (coast_rate_sigma, coast_accel_sigma)
        self._rig: SensorRig | None = None

    def setup(self, rig: SensorRig) -> None:
        """Forget the last sequence and take the camera's place on the body.

        Raises:
            ConfigError: the rig has no camera, so the lever arm is unknown.
        """
        if not rig.cameras:
            raise ConfigError(
                "fuser=vo_only needs the place of the camera on the body (rig.cameras[0].T_body_cam), but the "
                "recording has no camera: choose fuser=imu_only, or a recording with a camera"
            )
        self._rig = rig
        self._given: NavState | None = None
        self._stamp_ns: int | None = None
        self._T_world_body: Array = np.eye(4)
        self._velocity: Array = np.zeros(3)
        # The last valid motion of the body and how long it took, s: coasting goes on with it.
        self._last_motion: Array = np.eye(4)
        self._last_duration = 1.0
        # Age of that motion: it is the mean over its window, so half of it old when the window ends.
        self._age_s = 0.0
        # (6, 6) of (rotation, translation), right perturbation of T_world_body; None once a motion states none.
        self._covariance: Array | None = None
        self._velocity_covariance: Array = np.zeros((3, 3))
        self._counts: Counter[str] = Counter()

    def start_from(self, state: NavState) -> None:
        """Start from the pose of a given state."""
        self._given = state

    def counters(self) -> Mapping[str, int]:
        """Windows without a valid motion, and windows that never came."""
        return {} if self._rig is None else dict(self._counts)

    def update(self, measurement: Measurement) -> list[NavState]:
        """Append the window's motion; the first call also gives the state at ``window.previous``."""
        if self._rig is None:
            raise StateError("VoOnlyFuser.update was called before setup(rig): set the fuser up first")
        window = measurement.window
        relative = measurement.relative_pose
        if relative is None:
            raise StateError("fuser=vo_only needs a relative pose: choose a vo")
        states = []
        if self._stamp_ns is None:
            states.append(self._begin(measurement))
        elif self._stamp_ns != window.previous.stamp_ns:
            self._counts["missing windows"] += 1
            self._coast(seconds(window.previous.stamp_ns - self._stamp_ns))
        duration = seconds(window.current.stamp_ns - window.previous.stamp_ns)
        status: Status = "tracking"
        if relative.valid:
            self._follow(self._rig, relative, duration)
        else:
            self._counts["missing VO updates"] += 1
            self._coast(duration)
            status = "lost"
        self._stamp_ns = window.current.stamp_ns
        states.append(self._state(self._stamp_ns, status))
        return states

    def _begin(self, measurement: Measurement) -> NavState:
        stamp_ns = measurement.window.previous.stamp_ns
        given, self._given = self._given, None
        if given is not None:
            self._T_world_body = given.T_world_body
            self._velocity = given.v_world_body
            covariance = given.covariance
            if covariance is None:
                covariance = initial_covariance(given.T_world_body[:3, :3])
            # Coasting before the first valid motion goes on as the given state moves.
            self._last_motion = se3.from_parts(np.eye(3), given.T_world_body[:3, :3].T @ given.v_world_body)
        else:
            samples = measurement.window.imu
            R_world_body = level(samples.accel.mean(axis=0)) if self._level and len(samples) else np.eye(3)
            self._T_world_body = se3.from_parts(R_world_body, np.zeros(3))
            covariance = initial_covariance(R_world_body, tilt_sigma=self._tilt_sigma)
        into_local = _local_from_state(self._T_world_body)
        self._covariance = into_local @ covariance[:6, :6] @ into_local.T
        self._velocity_covariance = covariance[6:9, 6:9]
        return self._state(stamp_ns, "tracking")

    def _follow(self, rig: SensorRig, relative: RelativePose, duration: float) -> None:
        motion = relative.in_body(rig, self._scale)
        covariance = relative.covariance
        if covariance is not None:
            into_metres = np.repeat([1.0, self._scale], 3)
            into_body = se3.adjoint(rig.cameras[0].T_body_cam) * into_metres
            covariance = into_body @ covariance @ into_body.T
        self._last_motion, self._last_duration = motion, duration
        self._age_s = 0.5 * duration
        self._append(motion, covariance, duration)

    def _coast(self, duration: float) -> None:
        tangent = se3.log(self._last_motion) * (duration / self._last_duration)
        # A constant unknown rate and acceleration since that motion: windows in a row add up to their square of time.
        rate, accel = self._coast_sigmas
        start, end = self._age_s, self._age_s + duration
        self._age_s = end
        sigmas = np.repeat([rate * np.sqrt(end**2 - start**2), 0.5 * accel * np.sqrt(end**4 - start**4)], 3)
        if self._hold:
            # Staying is off by the motion that went before, and more.
            sigmas += np.abs(tangent).reshape(2, 3).max(axis=1).repeat(3)
            tangent = np.zeros(6)
        self._append(se3.exp(tangent), np.diag(sigmas**2), duration)

    def _append(self, motion: Array, covariance: Array | None, duration: float) -> None:
        before = self._T_world_body
        after = before @ motion
        after[:3, :3] = so3.normalise(after[:3, :3])
        if self._covariance is None or covariance is None:
            self._covariance = None
        else:
            back = se3.adjoint(se3.inverse(motion))
            self._covariance = back @ self._covariance @ back.T + covariance
            R = after[:3, :3]
            self._velocity_covariance = R @ covariance[3:, 3:] @ R.T / duration**2
        self._velocity = (after[:3, 3] - before[:3, 3]) / duration
        self._T_world_body = after

    def _state(self, stamp_ns: int, status: Status) -> NavState:
        covariance = None
        if self._covariance is not None:
            covariance = np.diag(np.repeat([0.0, 0.0, 0.0, _UNKNOWN_GYRO_BIAS**2, _UNKNOWN_ACCEL_BIAS**2], 3))
            into_state = _local_from_state(self._T_world_body).T
            pose = into_state @ self._covariance @ into_state.T
            covariance[:6, :6] = 0.5 * (pose + pose.T)
            covariance[6:9, 6:9] = self._velocity_covariance
        return NavState(
            stamp_ns=stamp_ns,
            T_world_body=self._T_world_body.copy(),
            v_world_body=self._velocity.copy(),
            covariance=covariance,
            status=status,
        )


def _local_from_state(T_world_body: Array) -> Array:
    """Map (6, 6) from the error of ``NavState`` (θ local, p in the world) to the right perturbation of the pose."""
    out = np.eye(6)
    out[3:, 3:] = T_world_body[:3, :3].T
    return out
