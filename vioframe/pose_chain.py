"""Motions of the body put one after the other, with the covariance that they add up to.

What odometry without a filter shares: where it begins, how it goes on where no motion is known, and what state it
gives.
"""

from dataclasses import dataclass

import numpy as np

from vioframe.checks import Array
from vioframe.conventions import seconds
from vioframe.geometry import se3, so3
from vioframe.inertial import level
from vioframe.initialisation import initial_covariance
from vioframe.types import ImuBlock, NavState, Status

# What NavState.covariance says of biases that nobody estimated: as good as unknown.
_UNKNOWN_GYRO_BIAS, _UNKNOWN_ACCEL_BIAS = 0.1, 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class LastingErrors:
    """K errors that a motion shares with those before and after it, such as what is left of a gyro's bias.

    Attributes:
        jacobian: (6, K), what one unit of each does to the motion, right perturbation.
        variances: (K,), in squared units; they are independent of each other.
        kept: (K,), 0 to 1, share of each as it was over the motion before that is in it still.
    """

    jacobian: Array
    variances: Array
    kept: Array


class PoseChain:
    """The pose of the body, and what is known of its error.

    Args:
        levelled: begin with roll and pitch from the mean specific force, which errs by the body's acceleration over
            gravity; otherwise, and where there are no samples, with the body's axes as the world's. A given state
            comes before either.
        tilt_sigma: rad, of roll and pitch at a start without a given state.
        rate_sigma: rad/s an axis, unknown constant rate since the last motion that was known.
        accel_sigma: m/s² an axis, unknown constant acceleration since then.
        hold: where no motion is known, stay; otherwise go on with the last one.
    """

    def __init__(
        self, *, levelled: bool, tilt_sigma: float, rate_sigma: float, accel_sigma: float, hold: bool = False
    ) -> None:
        self._levelled = levelled
        self._tilt_sigma = tilt_sigma
        self._drift_sigmas = (rate_sigma, accel_sigma)
        self._hold = hold
        self.forget()

    def forget(self) -> None:
        """Be as before :meth:`begin`."""
        self._stamp_ns = 0
        self._begun = False
        self._T_world_body: Array = np.eye(4)
        self._velocity: Array = np.zeros(3)
        # The last known motion of the body and how long it took, s: coasting goes on with it.
        self._last_motion: Array = np.eye(4)
        self._last_duration = 1.0
        # Age of that motion: it is the mean over its window, so half of it old when the window ends.
        self._age_s = 0.0
        # (6, 6) of (rotation, translation), right perturbation of T_world_body; None once a motion states none.
        self._covariance: Array | None = None
        # (6, K), of that error with those that last; None while there are none.
        self._shared: Array | None = None
        self._velocity_covariance: Array = np.zeros((3, 3))

    @property
    def begun(self) -> bool:
        """Whether it has a first pose."""
        return self._begun

    @property
    def stamp_ns(self) -> int:
        """Where the chain ends, once it has begun."""
        return self._stamp_ns

    def begin(self, stamp_ns: int, given: NavState | None, imu: ImuBlock) -> None:
        """Take the first pose.

        Args:
            stamp_ns: its time.
            given: the state there, or None.
            imu: samples around that time, to level with; may be empty.
        """
        self._stamp_ns = stamp_ns
        self._begun = True
        if given is not None:
            self._T_world_body = given.T_world_body
            self._velocity = given.v_world_body
            covariance = given.covariance
            if covariance is None:
                covariance = initial_covariance(given.T_world_body[:3, :3])
            # Coasting before the first known motion goes on as the given state moves.
            self._last_motion = se3.from_parts(np.eye(3), given.T_world_body[:3, :3].T @ given.v_world_body)
        else:
            R_world_body = level(imu.accel.mean(axis=0)) if self._levelled and len(imu) else np.eye(3)
            self._T_world_body = se3.from_parts(R_world_body, np.zeros(3))
            covariance = initial_covariance(R_world_body, tilt_sigma=self._tilt_sigma)
        into_local = _local_from_state(self._T_world_body)
        self._covariance = into_local @ covariance[:6, :6] @ into_local.T
        self._velocity_covariance = covariance[6:9, 6:9]

    def follow(
        self,
        motion: Array,
        covariance: Array | None,
        stamp_ns: int,
        *,
        known: bool = True,
        lasting: LastingErrors | None = None,
    ) -> None:
        """Append a motion.

        Args:
            motion: (4, 4) of the body since the end of the chain.
            covariance: (6, 6) of it, right perturbation, or None where its error is not known.
            stamp_ns: when it ends.
            known: False for a mere guess: it leaves the last known motion to grow older, and is trusted less for that.
            lasting: errors beyond ``covariance`` that it shares with other motions, the same ones each time.
        """
        duration = seconds(stamp_ns - self._stamp_ns)
        if known:
            self._last_motion, self._last_duration = motion, duration
            self._age_s = 0.5 * duration
        elif covariance is not None:
            covariance = covariance + self._drift(duration)
        self._append(motion, covariance, stamp_ns, lasting)

    def coast(self, stamp_ns: int) -> None:
        """Go on to this time without a known motion."""
        duration = seconds(stamp_ns - self._stamp_ns)
        tangent = se3.log(self._last_motion) * (duration / self._last_duration)
        covariance = self._drift(duration)
        if self._hold:
            # Staying is off by the motion that went before, and more.
            sigmas = np.sqrt(np.diag(covariance)) + np.abs(tangent).reshape(2, 3).max(axis=1).repeat(3)
            covariance = np.diag(sigmas**2)
            tangent = np.zeros(6)
        self._append(se3.exp(tangent), covariance, stamp_ns)

    def state(self, status: Status) -> NavState:
        """The state at the end of the chain, which has begun."""
        covariance = None
        if self._covariance is not None:
            covariance = np.diag(np.repeat([0.0, 0.0, 0.0, _UNKNOWN_GYRO_BIAS**2, _UNKNOWN_ACCEL_BIAS**2], 3))
            into_state = _local_from_state(self._T_world_body).T
            pose = into_state @ self._covariance @ into_state.T
            covariance[:6, :6] = 0.5 * (pose + pose.T)
            covariance[6:9, 6:9] = self._velocity_covariance
        return NavState(
            stamp_ns=self._stamp_ns,
            T_world_body=self._T_world_body.copy(),
            v_world_body=self._velocity.copy(),
            covariance=covariance,
            status=status,
        )

    def _drift(self, duration_s: float) -> Array:
        """Covariance (6, 6) that a further stretch without a known motion adds; the age grows by it."""
        # A constant unknown rate and acceleration since that motion: windows in a row add up to their square of time.
        rate, accel = self._drift_sigmas
        start, end = self._age_s, self._age_s + duration_s
        self._age_s = end
        sigmas = np.repeat([rate * np.sqrt(end**2 - start**2), 0.5 * accel * np.sqrt(end**4 - start**4)], 3)
        return np.diag(sigmas**2)

    def _append(
        self, motion: Array, covariance: Array | None, stamp_ns: int, lasting: LastingErrors | None = None
    ) -> None:
        duration = seconds(stamp_ns - self._stamp_ns)
        before = self._T_world_body
        after = before @ motion
        after[:3, :3] = so3.normalise(after[:3, :3])
        if self._covariance is None or covariance is None:
            self._covariance = None
        else:
            back = se3.adjoint(se3.inverse(motion))
            if self._shared is not None:
                self._shared = back @ self._shared
            self._covariance = back @ self._covariance @ back.T + covariance
            if lasting is not None:
                covariance = covariance + self._share(lasting)
            R = after[:3, :3]
            self._velocity_covariance = R @ covariance[3:, 3:] @ R.T / duration**2
        self._velocity = (after[:3, 3] - before[:3, 3]) / duration
        self._T_world_body = after
        self._stamp_ns = stamp_ns

    def _share(self, lasting: LastingErrors) -> Array:
        """Add what errors that last do to the pose; return the covariance (6, 6) of what they do to the motion."""
        J = lasting.jacobian
        before = np.zeros_like(J) if self._shared is None else self._shared * lasting.kept
        own = J * lasting.variances
        # ξ ← ξ + J e: the pose's error so far shares with e what is left of it since the motion before.
        cross = before @ J.T
        alone: Array = own @ J.T
        if self._covariance is not None:
            self._covariance = self._covariance + cross + cross.T + alone
        self._shared = before + own
        return alone


def _local_from_state(T_world_body: Array) -> Array:
    """Map (6, 6) from the error of ``NavState`` (θ local, p in the world) to the right perturbation of the pose."""
    out = np.eye(6)
    out[3:, 3:] = T_world_body[:3, :3].T
    return out
