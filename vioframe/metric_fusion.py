"""A loosely coupled filter that is corrected by metric relative poses, each held against a clone of the pose before."""

from typing import ClassVar

import numpy as np

from vioframe.checks import Array
from vioframe.error_state import POSE, InertialFilter
from vioframe.errors import StateError
from vioframe.fusion_options import InertialOptions, StandstillOptions, StartOptions, VisualOptions
from vioframe.geometry import se3
from vioframe.interfaces import INERTIAL_DELTA, METRIC_SCALE, RELATIVE_POSE
from vioframe.loose_fusion import LooseFuser, Step, VisualMotion


def relative_pose_measurement(
    filter_: InertialFilter, T_body_cam: Array, motion: VisualMotion
) -> tuple[Array, Array, Array]:
    """H (6, n), residual (6,) and noise (6, 6) of the camera's motion since the clone.

    With A = T_world_body T_body_cam now and Ẑ = T_cam_body T_clone⁻¹ A the expected motion, the residual
    ``Log(Ẑ⁻¹ Z)`` is ``Ad(A⁻¹) (ξ_now − ξ_clone)`` and noise: it depends on the estimate through A alone.
    """
    if filter_.T_world_clone is None:
        raise StateError("clone the pose before the window is propagated")
    T_world_cam = filter_.body.T_world_body @ T_body_cam
    expected = se3.inverse(filter_.T_world_clone @ T_body_cam) @ T_world_cam
    residual = se3.log(se3.inverse(expected) @ motion.T_prev_cur)
    into_cam = se3.adjoint(se3.inverse(T_world_cam))
    H = np.zeros((6, len(filter_.covariance)))
    H[:, POSE] = into_cam
    H[:, -6:] = -into_cam
    return H, residual, motion.covariance


class RelativePoseFuser(LooseFuser):
    """Error-state Kalman filter with a clone of the previous pose.

    Args:
        visual: trust in the relative poses (metres).
        inertial: trust in the inertial increments.
        standstill: measuring no motion at rest.
        start: what is assumed of the first state.

    Raises:
        ConfigError: an option outside its range.
    """

    requires: ClassVar[frozenset[str]] = frozenset({INERTIAL_DELTA, RELATIVE_POSE, METRIC_SCALE})

    def __init__(
        self,
        *,
        visual: VisualOptions | None = None,
        inertial: InertialOptions | None = None,
        standstill: StandstillOptions | None = None,
        start: StartOptions | None = None,
    ) -> None:
        super().__init__(visual=visual, inertial=inertial, standstill=standstill, start=start)
        self._gate = self._visual.gate(6)

    def _advance(self, step: Step) -> bool:
        self._filter.clone_pose()
        self._filter.propagate(step.delta)
        supported = step.motion is not None and self._fuse(step.motion, step.delta.duration_s)
        if step.at_rest:
            supported = self._stand_still() or supported
        self._filter.drop_clone()
        return supported

    def _fuse(self, motion: VisualMotion, duration_s: float) -> bool:
        H, residual, noise = relative_pose_measurement(self._filter, self._T_body_cam, motion)
        S, chi_square = self._filter.innovation(H, residual, noise)
        self._adapted.learn(residual, S, duration_s)
        if chi_square > self._gate:
            self._count("gated VO updates")
            return False
        self._correct(H, residual, noise)
        return True
