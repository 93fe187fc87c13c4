"""The states of a run as columns: read once, small enough to keep for an hour of recording."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from vioframe.checks import Array, Stamps, check_increasing
from vioframe.types import NavState, Trajectory


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StateColumns:
    """What evaluation and plots need of states.

    Attributes:
        stamps_ns: (N,), strictly increasing.
        T_world_body: (N, 4, 4).
        v_world_body: (N, 3) m/s.
        bias: (N, 6), gyro (rad/s) then accel (m/s²).
        covariance: (N, 6, 6) of (θ, p), as in ``NavState``; NaN where the state has none.
        bias_sigma: (N, 6) standard deviations of ``bias``; NaN where the state has none.
        status: (N,) strings.
    """

    stamps_ns: Stamps
    T_world_body: Array
    v_world_body: Array
    bias: Array
    covariance: Array
    bias_sigma: Array
    status: np.ndarray

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @staticmethod
    def from_states(states: Iterable[NavState]) -> "StateColumns":
        """Read states, oldest first.

        Raises:
            ClockError: a stamp repeats or goes back.
        """
        pieces = [_read(state) for state in states]
        columns = StateColumns(
            stamps_ns=np.array([piece[0] for piece in pieces], dtype=np.int64),
            T_world_body=np.array([piece[1] for piece in pieces], dtype=float).reshape(-1, 4, 4),
            v_world_body=np.array([piece[2] for piece in pieces], dtype=float).reshape(-1, 3),
            bias=np.array([piece[3] for piece in pieces], dtype=float).reshape(-1, 6),
            covariance=np.array([piece[4] for piece in pieces], dtype=float).reshape(-1, 6, 6),
            bias_sigma=np.array([piece[5] for piece in pieces], dtype=float).reshape(-1, 6),
            status=np.array([piece[6] for piece in pieces], dtype="U8"),
        )
        check_increasing("the states of a run", columns.stamps_ns)
        return columns

    def where(self, kept: np.ndarray) -> "StateColumns":
        """The states that a mask (N,) or index (K,) picks."""
        return StateColumns(
            stamps_ns=self.stamps_ns[kept],
            T_world_body=self.T_world_body[kept],
            v_world_body=self.v_world_body[kept],
            bias=self.bias[kept],
            covariance=self.covariance[kept],
            bias_sigma=self.bias_sigma[kept],
            status=self.status[kept],
        )

    def started(self) -> "StateColumns":
        """The states that are compared, drawn and written to disk: all from after the initialisation."""
        return self.where(self.status != "starting")

    def trajectory(self) -> Trajectory:
        """As a causal trajectory."""
        return Trajectory(
            stamps_ns=self.stamps_ns, T_world_body=self.T_world_body, v_world_body=self.v_world_body, causal=True
        )


def _read(state: NavState) -> tuple[int, Array, Array, Array, Array, Array, str]:
    # Copies of the parts: a view would keep the whole covariance alive.
    if state.covariance is None:
        pose, bias_sigma = np.full((6, 6), np.nan), np.full(6, np.nan)
    else:
        pose = state.covariance[:6, :6].copy()
        bias_sigma = np.sqrt(np.maximum(np.diagonal(state.covariance)[9:], 0.0))
    bias = np.concatenate([state.bias.gyro, state.bias.accel])
    return (
        state.stamp_ns, state.T_world_body.copy(), state.v_world_body.copy(), bias, pose, bias_sigma, state.status
    )  # fmt: skip
