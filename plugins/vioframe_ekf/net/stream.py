"""The robocentric filter one window at a time, in numpy's clothes, behind the fuser."""

import numpy as np
import torch
from torch import Tensor

from vioframe.checks import Array
from vioframe.error_state import THETA as NAV_THETA
from vioframe.error_state import VELOCITY as NAV_VELOCITY
from vioframe.error_state import Body, InertialFilter
from vioframe.errors import StateError
from vioframe.geometry import so3
from vioframe.types import ImuBias, ImuNoise, InertialDelta, NavState, Status
from vioframe_ekf.net.path import from_nav_errors, state_of, to_nav_errors
from vioframe_ekf.net.robocentric import (
    IN_WINDOW,
    SHIFT,
    TURN,
    VELOCITY,
    Increment,
    Moved,
    State,
    correct,
    innovate,
    motion_noise,
    motion_residual,
    motion_rows,
    passing,
    propagate,
    settle,
    turn_between,
)


class RobocentricFilter(InertialFilter):
    """The filter of :mod:`vioframe_ekf.net.robocentric` in the place of the one in the core; see there for its errors.

    The reference of a window stands for the clone: :meth:`drop_clone` makes the body the next one.

    Args:
        gravity: magnitude, m/s².
        gravity_sigma: of that magnitude, m/s².
        densities: (4,) of :class:`vioframe_ekf.net.noise.FilterNoise`; what increments bring is white noise already.
        visual_factors: (6,) on the standard deviations of a motion.
    """

    def __init__(self, *, gravity: float, gravity_sigma: float, densities: Tensor, visual_factors: Tensor) -> None:
        gyro, accel, gyro_walk, accel_walk = densities.tolist()
        noise = ImuNoise(gyro_noise=gyro, accel_noise=accel, gyro_walk=gyro_walk, accel_walk=accel_walk, rate_hz=1.0)
        super().__init__(extra=0, noise=noise, gravity=gravity)
        self._gravity_sigma = gravity_sigma
        self._densities = densities
        self._walk = densities[2:].square().repeat_interleave(3)
        self._factors = visual_factors
        self._state: State | None = None
        self._moved: Moved | None = None

    @torch.no_grad()
    def start(self, state: NavState, covariance: Array) -> None:
        """Take a state, and its covariance (15, 15) in the order and error of ``NavState.covariance``."""
        self.body = Body.of(state)
        R = self.body.R
        bias = np.concatenate([state.bias.gyro, state.bias.accel])
        self._state = state_of(
            _batched(R),
            _batched(self.body.p),
            _batched(R.T @ self.body.v),
            _batched(R.T @ self.gravity),
            _batched(bias),
            _batched(covariance),
            self._gravity_sigma,
        )
        self._moved = None

    def copy(self) -> "RobocentricFilter":
        """An independent filter in the same state."""
        twin = RobocentricFilter(
            gravity=-float(self.gravity[2]),
            gravity_sigma=self._gravity_sigma,
            densities=self._densities,
            visual_factors=self._factors,
        )
        twin.body, twin._state, twin._moved = self.body, self._state, self._moved
        twin.covariance = self.covariance.copy()
        return twin

    def clone_pose(self) -> None:
        """Nothing to do: every window begins at its reference."""

    @torch.no_grad()
    def propagate(self, delta: InertialDelta) -> None:
        """Predict over a window; ``delta`` is brought to the present bias to first order."""
        duration = torch.tensor([delta.duration_s], dtype=torch.float64)
        jacobian = _batched(delta.bias_jacobian)
        transition, noise = passing(duration, jacobian, _batched(delta.covariance), self._walk)
        increment = Increment(
            R=_batched(delta.delta_R),
            v=_batched(delta.delta_v),
            p=_batched(delta.delta_p),
            duration_s=duration,
            jacobian=jacobian,
            reference=_batched(np.concatenate([delta.bias.gyro, delta.bias.accel])),
            transition=transition,
            noise=noise,
        )
        self._hold(propagate(self._settled(), increment))

    @torch.no_grad()
    def measure_motion(self, T_prev_cur: Array, covariance: Array, T_body_cam: Array, gate: float) -> tuple[bool, bool]:
        """Correct with a motion of the camera over the window.

        Args:
            T_prev_cur: (4, 4), metres.
            covariance: (6, 6) in the tangent of the camera, before the learned factors.
            T_body_cam: (4, 4).
            gate: largest χ² of a motion that is used.

        Returns:
            whether it was used, and whether its covariance could be one.
        """
        moved = self._inside()
        scaled = self._factors[:, None] * torch.from_numpy(covariance).to(torch.float64) * self._factors
        motion, noise = motion_noise(_batched(T_prev_cur), _batched(T_body_cam), scaled[None])
        innovation = innovate(moved, motion_rows(motion), motion_residual(moved, motion), noise)
        used = innovation.sound & (innovation.chi_square <= gate)
        self._hold(correct(moved, innovation, used))
        return bool(used), bool(innovation.sound)

    @torch.no_grad()
    def correct(self, H: Array, residual: Array, noise: Array) -> Array:
        """Update inside a window with a linear measurement ``residual = H · error + noise``, H (m, 24)."""
        innovation = innovate(self._inside(), *(_batched(each) for each in (H, residual, noise)))
        self._hold(correct(self._inside(), innovation, innovation.sound))
        return innovation.gain[0].numpy()

    @torch.no_grad()
    def standstill_measurement(
        self, rotation_sigma: float, position_sigma: float, velocity_sigma: float
    ) -> tuple[Array, Array, Array]:
        """H (9, 24), residual (9,), noise (9, 9): the body has not moved over the window and has no velocity."""
        moved = self._inside()
        H = np.zeros((9, IN_WINDOW))
        for row, block in enumerate((TURN, SHIFT, VELOCITY)):
            H[3 * row : 3 * row + 3, block] = np.eye(3)
        back = turn_between(moved.R.transpose(-1, -2))
        residual = torch.cat([back, -moved.r, -moved.v], dim=-1)[0].numpy()
        return H, residual, np.diag(np.repeat([rotation_sigma, position_sigma, velocity_sigma], 3) ** 2)

    @torch.no_grad()
    def drop_clone(self) -> None:
        """Compose the motion of the window onto the pose, and begin the next at its end."""
        self._state = settle(self._inside())
        self._moved = None
        self._tell()

    @torch.no_grad()
    def doubt(self, tilt_sigma: float, velocity_sigma: float) -> None:
        """Widen roll, pitch (rad) and velocity (m/s)."""
        state = self._settled()
        local = np.zeros((15, 15))
        R = self.body.R
        local[NAV_THETA, NAV_THETA] = R.T @ np.diag([tilt_sigma**2, tilt_sigma**2, 0.0]) @ R
        local[NAV_VELOCITY, NAV_VELOCITY] = velocity_sigma**2 * np.eye(3)
        into = from_nav_errors(state.R, state.p, state.v, state.gravity)
        state.covariance.add_(into @ _batched(local) @ into.transpose(-1, -2))

    @torch.no_grad()
    def nav_state(self, stamp_ns: int, status: Status) -> NavState:
        """The state in the convention of :class:`~vioframe.types.NavState`."""
        state = self._settled()
        into = to_nav_errors(state.R, state.p, state.v)
        covariance = into @ state.covariance @ into.transpose(-1, -2)
        return NavState(
            stamp_ns=stamp_ns,
            T_world_body=self.body.T_world_body,
            v_world_body=self.body.v.copy(),
            bias=self.body.bias,
            covariance=(0.5 * (covariance + covariance.transpose(-1, -2)))[0].numpy(),
            status=status,
        )

    def normalise(self) -> None:
        """Take rounding off the rotation."""
        self._settled().R.copy_(_batched(so3.normalise(self.body.R)))
        self._tell()

    def _settled(self) -> State:
        if self._state is None:
            raise StateError("start the filter first")
        return self._state

    def _inside(self) -> Moved:
        if self._moved is None:
            raise StateError("propagate the filter over a window first")
        return self._moved

    def _hold(self, moved: Moved) -> None:
        self._moved = moved
        # The χ² of a standstill is computed in the core.
        self.covariance = moved.covariance[0].numpy()

    def _tell(self) -> None:
        state = self._settled()
        R, bias = state.R[0].numpy().copy(), state.bias[0].numpy().copy()
        self.body = Body(
            R=R, p=state.p[0].numpy().copy(), v=R @ state.v[0].numpy(), bias=ImuBias(gyro=bias[:3], accel=bias[3:])
        )


def _batched(array: Array) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float64))[None]
