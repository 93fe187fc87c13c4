"""A stranger's plugin: dead reckoning whose velocity fades, as wheels and feet do."""

import numpy as np

from vioframe.conventions import gravity_vector
from vioframe.geometry import se3
from vioframe.interfaces import INERTIAL_DELTA, Fuser
from vioframe.types import Measurement, NavState, SensorRig


class AcmeFuser(Fuser):
    """Integrates the inertial increments from a given state, and damps the velocity.

    Args:
        damping: fraction of the velocity lost in a second, in [0, 1).
    """

    requires = frozenset({INERTIAL_DELTA})

    def __init__(self, *, damping: float) -> None:
        self.damping = damping

    def setup(self, rig: SensorRig) -> None:
        """Forget the last sequence."""
        self._gravity = gravity_vector(rig.gravity)
        self._state: NavState | None = None

    def start_from(self, state: NavState) -> None:
        """Take the first state."""
        self._state = state

    def update(self, measurement: Measurement) -> list[NavState]:
        """Advance by one window."""
        window, delta = measurement.window, measurement.inertial_delta
        before = self._state or NavState(stamp_ns=window.previous.stamp_ns, T_world_body=np.eye(4))
        T, v, elapsed = before.T_world_body, before.v_world_body, delta.duration_s
        position = T[:3, 3] + v * elapsed + 0.5 * self._gravity * elapsed**2 + T[:3, :3] @ delta.delta_p
        velocity = (v + self._gravity * elapsed + T[:3, :3] @ delta.delta_v) * (1.0 - self.damping) ** elapsed
        self._state = NavState(
            stamp_ns=window.current.stamp_ns,
            T_world_body=se3.from_parts(T[:3, :3] @ delta.delta_R, position),
            v_world_body=velocity,
        )
        return [self._state]
