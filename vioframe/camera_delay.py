"""The delay of the camera, found from the rotations that odometry and gyro tell of the same window.

If the images of a window were taken ``x`` later than assumed so far, the odometry speaks of the rotation between other
instants than the gyro was integrated between. With the rates ω at both ends and ΔR the gyro's rotation::

    Log(ΔRᵀ R_vo) = (x − a₂) ω₂ − (x − a₁) ΔRᵀ ω₁ + noise

where x is the delay of the camera and a the delay that each of the two images was stamped with: linear in the one
number that is sought. Only changes of the rate tell of it; a constant turn, and a bias of either sensor, do not (Li and
Mourikis, "Online temporal calibration for camera-IMU systems", IJRR 2014, for what is observable).
"""

from dataclasses import dataclass, replace

import numpy as np

from vioframe.checks import Array, check_not_negative, check_positive
from vioframe.conventions import NANOSECONDS, seconds
from vioframe.geometry import se3, so3
from vioframe.types import ImuBias, Measurement, SensorRig

# Odometry is seldom as good as it says, and its errors last: noise is raised to what innovations show, over this time.
_ADAPT_S = 10.0
# Beyond this many standard deviations an innovation counts as this many.
_ROBUST = 3.0


@dataclass(frozen=True, slots=True, kw_only=True)
class DelayOptions:
    """Whether, and how, a fuser estimates the delay of the camera.

    Attributes:
        estimate: or take it as calibrated.
        sigma_s: s, standard deviation of the calibrated delay.
        walk: s/√s, by which the delay wanders.
        follow_s: s, largest change of the assumed delay from one image to the next, so that stamps keep their order.
    """

    estimate: bool = False
    sigma_s: float = 0.05
    walk: float = 1.0e-4
    follow_s: float = 0.005

    def __post_init__(self) -> None:
        check_positive("fuser.camera_delay", sigma_s=self.sigma_s, follow_s=self.follow_s)
        check_not_negative("fuser.camera_delay", walk=self.walk)


class DelayEstimator:
    """A Kalman filter for one number.

    Args:
        options: how it is estimated.
        rig: as calibrated.
        covariance_scale: factor on the covariance that the odometry states.
        rotation_sigma: rad an axis, where it states none.
    """

    def __init__(self, options: DelayOptions, rig: SensorRig, covariance_scale: float, rotation_sigma: float) -> None:
        self._options = options
        self._R_body_cam: Array = rig.cameras[0].T_body_cam[:3, :3]
        self._told_s = seconds(rig.camera_delay_ns)
        self._delay_s = self._told_s
        self._variance = options.sigma_s**2
        self._assumed_s = self._told_s
        self._scale = covariance_scale
        self._stand_in = rotation_sigma**2 * np.eye(3)
        self._excess = 1.0
        self._previous: tuple[int, float] | None = None

    @property
    def sigma_s(self) -> float:
        """Standard deviation of the delay, s."""
        return float(np.sqrt(self._variance))

    @property
    def change_s(self) -> float:
        """The delay as estimated, against the calibrated one, s."""
        return self._delay_s - self._told_s

    def assumed_ns(self) -> int:
        """What images to come should be stamped with: follows the estimate, but slowly."""
        return round(self._assumed_s * NANOSECONDS)

    def learn(self, measurement: Measurement, bias: ImuBias) -> Measurement:
        """Take a window; one without a motion, or without inertial samples, teaches nothing.

        Args:
            measurement: of the window.
            bias: as the fuser estimates it.

        Returns:
            the measurement; where its two images were stamped with different delays the window is as much longer or
            shorter than the time between them, and the motion is told for the window, at the same velocity.
        """
        window, pose, delta = measurement.window, measurement.relative_pose, measurement.inertial_delta
        current_s = seconds(window.camera_delay_ns)
        known = self._previous is not None and self._previous[0] == window.previous.stamp_ns
        previous_s = self._previous[1] if self._previous is not None and known else current_s
        self._previous = window.current.stamp_ns, current_s
        if pose is None or not pose.valid or delta is None or len(window.imu) < 2:
            return measurement
        duration_s = delta.duration_s
        self._variance += self._options.walk**2 * duration_s
        R = self._R_body_cam
        angles = so3.log(delta.delta_R.T @ R @ pose.T_prev_cur[:3, :3] @ R.T)
        first = delta.delta_R.T @ (window.imu.gyro[0] - bias.gyro)
        last = window.imu.gyro[-1] - bias.gyro
        stated = self._stand_in if pose.covariance is None else pose.covariance[:3, :3]
        noise = R @ (self._scale * stated) @ R.T + delta.covariance[:3, :3]
        self._correct(angles - previous_s * first + current_s * last, last - first, noise, duration_s)
        if self.sigma_s < 0.5 * self._options.sigma_s:
            # Before, the estimate is hardly better than what the calibration says.
            step_s = self._options.follow_s
            self._assumed_s += float(np.clip(self._delay_s - self._assumed_s, -step_s, step_s))
        between_s = duration_s - (current_s - previous_s)
        if current_s == previous_s or between_s <= 0.0:
            return measurement
        T_prev_cur = se3.exp(se3.log(pose.T_prev_cur) * (duration_s / between_s))
        return replace(measurement, relative_pose=replace(pose, T_prev_cur=T_prev_cur))

    def _correct(self, measured: Array, h: Array, noise: Array, duration_s: float) -> None:
        """Update by ``measured`` (3,) = ``h`` (3,) x + noise, its covariance (3, 3)."""
        innovation = measured - h * self._delay_s
        S = self._variance * np.outer(h, h) + self._excess * noise
        weighted = np.linalg.solve(S, np.column_stack([innovation, h]))
        nis = float(innovation @ weighted[:, 0]) / 3.0
        share = min(duration_s / _ADAPT_S, 1.0)
        self._excess = max(1.0, self._excess * (1.0 + share * (min(nis, _ROBUST**2) - 1.0)))
        robust = min(1.0, _ROBUST / np.sqrt(max(nis, 1e-12)))
        self._delay_s = float(self._delay_s + robust * self._variance * (h @ weighted[:, 0]))
        self._variance *= float(1.0 - robust * self._variance * (h @ weighted[:, 1]))
