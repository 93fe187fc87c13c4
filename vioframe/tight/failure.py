"""Whether an estimate can still be believed."""

from collections import deque

import numpy as np

from vioframe.conventions import NANOSECONDS, seconds
from vioframe.tight.options import FailureOptions
from vioframe.tight.restart import DeadReckoning
from vioframe.tight.step import Step, Support
from vioframe.types import ImuNoise, NavState

# Fewer points than this in an image are a blind camera, which no restart mends.
_SEES = 15
# m/s², what a body may gain or lose of its speed within a window before a change of place counts as a jump.
_ACCELERATES = 20.0


class FailureMonitor:
    """Watches the states of an estimator, and keeps the last ones that were supported.

    Args:
        options: the limits.
    """

    def __init__(self, options: FailureOptions) -> None:
        self._options = options
        self._keep_ns = round((options.lost_after_s + options.restart_after_s) * NANOSECONDS)
        self._unsupported_s = 0.0
        self._refused_s = 0.0
        self._supported: deque[NavState] = deque()
        self._steps: deque[Step] = deque()

    @property
    def is_lost(self) -> bool:
        """Whether the state has been without support for too long."""
        return self._unsupported_s > self._options.lost_after_s

    def begin(self, state: NavState) -> None:
        """The estimator has begun from ``state``."""
        self._unsupported_s = self._refused_s = 0.0
        self._supported = deque([state])
        self._steps.clear()

    def judge(self, step: Step, before: NavState, after: NavState, support: Support) -> str | None:
        """Take one more window; say what failed, in a few words, or None.

        Args:
            step: the window.
            before: state at its start.
            after: state at its end.
            support: what the images gave.
        """
        self._steps.append(step)
        duration_s = seconds(step.stamp_ns - step.window.previous.stamp_ns)
        reason = self._broken(step, before, after)
        if support.used >= self._options.min_used or support.at_rest:
            self._unsupported_s = self._refused_s = 0.0
            if reason is None:
                self._supported.append(after)
        else:
            self._unsupported_s += duration_s
            # A camera that sees nothing is no reason to start again: there would be nothing to start from.
            self._refused_s = self._refused_s + duration_s if len(step.tracks) >= _SEES else 0.0
        self._forget(step.stamp_ns)
        if reason is None and self._refused_s > self._options.restart_after_s:
            reason = "no support from the images"
        return reason

    def note_collapse(self, step: Step) -> str:
        """The estimator broke down in this window; say so in a few words."""
        self._steps.append(step)
        return "the estimate is not finite"

    def dead_reckoning(self, noise: ImuNoise, gravity: float) -> DeadReckoning:
        """Go on from the oldest supported state that is kept, with the inertial samples alone.

        The newest ones may already have been bent by what then failed.
        """
        state = self._supported[0]
        past = DeadReckoning(state, noise, gravity)
        for step in self._steps:
            if step.window.previous.stamp_ns >= state.stamp_ns:
                past.move_on(step)
        return past

    def _broken(self, step: Step, before: NavState, after: NavState) -> str | None:
        options = self._options
        # Constant velocity is what the position is held against: the jump of a wrong correction is far beyond it.
        T = step.delta.duration_s
        moved = np.linalg.norm(after.T_world_body[:3, 3] - before.T_world_body[:3, 3] - before.v_world_body * T)
        variances = np.zeros(1) if after.covariance is None else np.diag(after.covariance)
        checks = (
            ("the covariance is not one", not variances.min() >= 0.0),
            ("gyro bias", np.linalg.norm(after.bias.gyro) > options.max_gyro_bias),
            ("accelerometer bias", np.linalg.norm(after.bias.accel) > options.max_accel_bias),
            ("speed", np.linalg.norm(after.v_world_body) > options.max_speed),
            ("jump", moved > options.max_correction_m + 0.5 * _ACCELERATES * T * T),
        )
        return next((name for name, bad in checks if bad), None)

    def _forget(self, now_ns: int) -> None:
        while len(self._supported) > 1 and self._supported[1].stamp_ns <= now_ns - self._keep_ns:
            self._supported.popleft()
        while self._steps and self._steps[0].window.previous.stamp_ns < self._supported[0].stamp_ns:
            self._steps.popleft()
