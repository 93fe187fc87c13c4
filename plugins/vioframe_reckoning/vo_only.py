"""The camera's motions put one after the other."""

from collections import Counter
from collections.abc import Mapping
from typing import ClassVar, Literal

import numpy as np

from vioframe.errors import ConfigError, StateError
from vioframe.geometry import se3
from vioframe.interfaces import CONSISTENT_SCALE, RELATIVE_POSE, Fuser
from vioframe.pose_chain import PoseChain
from vioframe.types import Measurement, NavState, RelativePose, SensorRig, Status

OnInvalid = Literal["constant_velocity", "hold"]


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
        self._chain = PoseChain(
            levelled=level,
            tilt_sigma=tilt_sigma,
            rate_sigma=coast_rate_sigma,
            accel_sigma=coast_accel_sigma,
            hold=on_invalid == "hold",
        )
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
        self._chain.forget()
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
        if not self._chain.begun:
            self._chain.begin(window.previous.stamp_ns, self._given, window.imu)
            self._given = None
            states.append(self._chain.state("tracking"))
        elif self._chain.stamp_ns != window.previous.stamp_ns:
            self._counts["missing windows"] += 1
            self._chain.coast(window.previous.stamp_ns)
        status: Status = "tracking"
        if relative.valid:
            self._follow(self._rig, relative, window.current.stamp_ns)
        else:
            self._counts["missing VO updates"] += 1
            self._chain.coast(window.current.stamp_ns)
            status = "lost"
        states.append(self._chain.state(status))
        return states

    def _follow(self, rig: SensorRig, relative: RelativePose, stamp_ns: int) -> None:
        covariance = relative.covariance
        if covariance is not None:
            into_metres = np.repeat([1.0, self._scale], 3)
            into_body = se3.adjoint(rig.cameras[0].T_body_cam) * into_metres
            covariance = into_body @ covariance @ into_body.T
        self._chain.follow(relative.in_body(rig, self._scale), covariance, stamp_ns)
