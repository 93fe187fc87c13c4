"""The filter's state: body, scale, where the vision puts the camera, and the camera on the body.

Beyond the 15 inertial errors (see :mod:`vioframe.error_state`) there are 13::

    15        of the logarithm of the scale, so that it cannot turn negative
    16 … 21   ξ of the vision's camera pose, right-invariant: T_true = Exp(ξ) T
    22 … 27   ε of the camera on the body, local: T_body_cam,true = T_body_cam Exp(ε)
"""

import numpy as np

from vioframe.checks import Array
from vioframe.error_state import POSE, InertialFilter
from vioframe.errors import StateError
from vioframe.geometry import se3, so3
from vioframe.types import ImuNoise, NavState

SCALE, VISION, EXTRINSICS = 15, slice(16, 22), slice(22, 28)
EXTRA = 13

_DOUBTED_SCALE = 0.2


class ScaledFilter(InertialFilter):
    """An inertial filter beside a visual odometer of unknown unit.

    Two dead reckonings run side by side: the body by its inertial increments, and ``T_world_vision``, the
    camera's pose by the relative poses, each multiplied by the scale. A measurement says that both put the
    camera in the same place.

    Args:
        noise: densities of the inertial sensor.
        gravity: magnitude, m/s².
        T_body_cam: (4, 4), calibrated.
        extrinsics_sigmas: (rad, m) an axis, how far it may be off; zeros fix it.
    """

    def __init__(
        self, *, noise: ImuNoise, gravity: float, T_body_cam: Array, extrinsics_sigmas: tuple[float, float]
    ) -> None:
        super().__init__(extra=EXTRA, noise=noise, gravity=gravity)
        self.T_body_cam = T_body_cam
        self.T_world_vision: Array | None = None
        self.scale = 1.0
        self._T_world_left = T_body_cam
        self._calibrated = T_body_cam
        self._extrinsics_sigmas = extrinsics_sigmas

    def start(self, state: NavState, covariance: Array) -> None:
        """Take a state; the scale is then still to be set, and the vision to be anchored."""
        super().start(state, covariance)
        self.T_body_cam = self._calibrated
        self.T_world_vision = None
        self.covariance[EXTRINSICS, EXTRINSICS] = np.diag(np.repeat(np.square(self._extrinsics_sigmas), 3))

    def copy(self) -> "ScaledFilter":
        """An independent filter in the same state."""
        twin = ScaledFilter(
            noise=self.noise,
            gravity=-float(self.gravity[2]),
            T_body_cam=self._calibrated,
            extrinsics_sigmas=self._extrinsics_sigmas,
        )
        twin.body, twin.covariance, twin.T_world_clone = self.body, self.covariance.copy(), self.T_world_clone
        twin.T_body_cam, twin.T_world_vision = self.T_body_cam, self.T_world_vision
        twin.scale, twin._T_world_left = self.scale, self._T_world_left
        return twin

    @property
    def scale_sigma(self) -> float:
        """Standard deviation of the scale relative to it."""
        return float(np.sqrt(self.covariance[SCALE, SCALE]))

    @property
    def T_world_cam(self) -> Array:
        """The camera by the inertial dead reckoning."""
        pose: Array = self.body.T_world_body @ self.T_body_cam
        return pose

    def set_scale(self, scale: float, sigma: float) -> None:
        """Take a scale, metres per unit of the VO, and the standard deviation of its logarithm, as news."""
        self._clear(slice(SCALE, SCALE + 1))
        self.covariance[SCALE, SCALE] = sigma**2
        self.scale = scale

    def walk_scale(self, density: float, duration_s: float) -> None:
        """Let the logarithm of the scale drift: 1/√s."""
        self.covariance[SCALE, SCALE] += density**2 * duration_s

    def metric(self, covariance: Array) -> Array:
        """Covariance (6, 6) of a relative pose, from the VO's unit to metres."""
        factor = np.repeat([1.0, self.scale], 3)
        out: Array = factor[:, None] * covariance * factor
        return out

    def anchor_vision(self, noise: Array) -> None:
        """Put the vision where the body says the camera is, but for the error of a single image.

        Args:
            noise: (6, 6), in metres, local.
        """
        T_world_cam = self.T_world_cam
        onto_world = se3.adjoint(T_world_cam)
        rows = self.covariance[POSE, :] + onto_world @ self.covariance[EXTRINSICS, :]
        rows[:, VISION] = 0.0
        block = rows[:, POSE] + rows[:, EXTRINSICS] @ onto_world.T + onto_world @ noise @ onto_world.T
        self.covariance[VISION, :] = rows
        self.covariance[:, VISION] = rows.T
        self.covariance[VISION, VISION] = block
        self.T_world_vision = T_world_cam

    def doubt(self, tilt_sigma: float, velocity_sigma: float) -> None:
        """Admit to be wrong; the scale is then as uncertain as what it was compared with."""
        super().doubt(tilt_sigma, velocity_sigma)
        self.covariance[SCALE, SCALE] += _DOUBTED_SCALE**2

    def drop_vision(self) -> None:
        """Forget where the vision puts the camera."""
        self._clear(VISION)
        self.T_world_vision = None

    def leave(self) -> None:
        """Call before the body is propagated over a step that the vision is to follow."""
        self._T_world_left = self.T_world_cam

    def advance_vision(self, T_prev_cur: Array, noise: Array) -> None:
        """Dead reckoning by the camera's motion since :meth:`leave`.

        The error of the scale moves the camera along its true step. The measured step would stand in for it
        badly: its noise is also in the residual, and each product of the two would shrink the scale a little
        (regression with a noisy regressor). The step that the inertial samples expect has no such noise.

        Args:
            T_prev_cur: (4, 4), in the unit of the VO.
            noise: (6, 6), in metres, local: by how much the vision drifts.
        """
        before = self.T_world_vision
        if before is None:
            raise StateError("advance_vision needs anchor_vision first")
        expected = self.T_world_cam[:3, 3] - self._T_world_left[:3, 3]
        after = np.eye(4)
        after[:3, :3] = before[:3, :3] @ T_prev_cur[:3, :3]
        after[:3, 3] = before[:3, 3] + before[:3, :3] @ (self.scale * T_prev_cur[:3, 3])
        place = slice(VISION.start + 3, VISION.stop)
        self.covariance[place, :] += np.outer(expected, self.covariance[SCALE, :])
        self.covariance[:, place] += np.outer(self.covariance[:, SCALE], expected)
        onto_world = se3.adjoint(after)
        self.covariance[VISION, VISION] += onto_world @ noise @ onto_world.T
        self.T_world_vision = after

    def vision_measurement(self) -> tuple[Array, Array]:
        """H (6, n) and residual (6,) of "both dead reckonings put the camera in the same place", local."""
        if self.T_world_vision is None:
            raise StateError("vision_measurement needs anchor_vision first")
        T_world_cam = self.T_world_cam
        into_cam = se3.adjoint(se3.inverse(T_world_cam))
        residual = se3.log(se3.inverse(T_world_cam) @ self.T_world_vision)
        H = np.zeros((6, len(self.covariance)))
        H[:, POSE] = into_cam
        H[:, VISION] = -into_cam
        H[:, EXTRINSICS] = np.eye(6)
        return H, residual

    def correct(self, H: Array, residual: Array, noise: Array) -> Array:
        """Update everything; see :meth:`InertialFilter.correct`."""
        error = super().correct(H, residual, noise)
        self.scale *= float(np.exp(error[SCALE]))
        if self.T_world_vision is not None:
            self.T_world_vision = se3.exp(error[VISION]) @ self.T_world_vision
        if any(self._extrinsics_sigmas):
            self.T_body_cam = self.T_body_cam @ se3.exp(error[EXTRINSICS])
        return error

    def normalise(self) -> None:
        """Take rounding off the rotations."""
        super().normalise()
        if self.T_world_vision is not None:
            T = self.T_world_vision.copy()
            T[:3, :3] = so3.normalise(T[:3, :3])
            self.T_world_vision = T

    def _clear(self, part: slice) -> None:
        self.covariance[part, :] = 0.0
        self.covariance[:, part] = 0.0
