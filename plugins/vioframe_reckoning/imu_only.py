"""Dead reckoning with the inertial sensor alone."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

import numpy as np

from vioframe.conventions import NANOSECONDS, seconds
from vioframe.error_state import InertialFilter
from vioframe.errors import ConfigError, StateError
from vioframe.fusion_options import StandstillOptions, StartOptions
from vioframe.increments import add_gap, coasting
from vioframe.interfaces import INERTIAL_DELTA, Fuser
from vioframe.types import ImuBias, InertialDelta, Measurement, NavState, SensorRig


class ImuOnlyFuser(Fuser):
    """Integrates inertial increments from a known start, with the covariance that this implies.

    Args:
        gyro_noise_scale: factor on the gyro's white noise density of the rig.
        accel_noise_scale: factor on the accelerometer's.
        walk_scale: factor on the bias walk densities of the rig.
        gap_allowed_s: a longer hole between samples widens the covariance, s.
        gap_rate_sigma: rad/s, unknown rate inside such a hole.
        gap_accel_sigma: m/s², unknown acceleration inside such a hole.
        standstill: zero-velocity updates; off unless enabled, since a car that coasts on a smooth straight
            road reads as one that stands.
        start: what is assumed of the first state.

    Raises:
        ConfigError: an option outside its range.
    """

    requires: ClassVar[frozenset[str]] = frozenset({INERTIAL_DELTA})

    def __init__(
        self,
        *,
        gyro_noise_scale: float = 1.0,
        accel_noise_scale: float = 1.0,
        walk_scale: float = 1.0,
        gap_allowed_s: float = 0.05,
        gap_rate_sigma: float = 0.5,
        gap_accel_sigma: float = 2.0,
        standstill: StandstillOptions | None = None,
        start: StartOptions | None = None,
    ) -> None:
        for name, value in (
            ("gyro_noise_scale", gyro_noise_scale),
            ("accel_noise_scale", accel_noise_scale),
            ("gap_allowed_s", gap_allowed_s),
        ):
            if not value > 0.0:
                raise ConfigError(f"fuser.{name} must be positive, got {value}")
        for name, value in (
            ("walk_scale", walk_scale),
            ("gap_rate_sigma", gap_rate_sigma),
            ("gap_accel_sigma", gap_accel_sigma),
        ):
            if not value >= 0.0:
                raise ConfigError(f"fuser.{name} must not be negative, got {value}")
        # Noise of v and p is the accelerometer's, near enough, in a window.
        self._noise_scale = np.repeat([gyro_noise_scale, accel_noise_scale, accel_noise_scale], 3)
        self._walk_scale = walk_scale
        self._gap_sigmas = (gap_rate_sigma, gap_accel_sigma)
        self._gap_allowed_ns = round(gap_allowed_s * NANOSECONDS)
        self._standstill = standstill or StandstillOptions(enabled=False)
        self._standstill_gate = self._standstill.gate()
        self._start = start or StartOptions()
        self._filter: InertialFilter | None = None

    def setup(self, rig: SensorRig) -> None:
        """Forget the last sequence; take noise densities and gravity of the next."""
        walk = self._walk_scale
        noise = replace(rig.imu, gyro_walk=rig.imu.gyro_walk * walk, accel_walk=rig.imu.accel_walk * walk)
        self._filter = InertialFilter(extra=0, noise=noise, gravity=rig.gravity)
        self._rest = self._start.at_rest(rig)
        self._test = self._standstill.test(rig)
        self._given: NavState | None = None
        self._stamp_ns: int | None = None
        self._silent_s = 0.0
        self._counts: Counter[str] = Counter()

    def start_from(self, state: NavState) -> None:
        """Start from a given state; without a covariance the sigmas of ``start`` stand in."""
        self._given = state

    def bias(self) -> ImuBias:
        """The bias of the start, corrected by zero-velocity updates only."""
        return ImuBias() if self._filter is None else self._filter.body.bias

    def counters(self) -> Mapping[str, int]:
        """Windows with holes, windows that never came, zero-velocity updates."""
        return {} if self._filter is None else dict(self._counts)

    def update(self, measurement: Measurement) -> list[NavState]:
        """Move over the window; empty until the body has been seen at rest, or a state is given."""
        if self._filter is None:
            raise StateError("ImuOnlyFuser.update was called before setup(rig): set the fuser up first")
        window, delta = measurement.window, measurement.inertial_delta
        if delta is None and len(window.imu):
            raise StateError("fuser=imu_only needs an inertial increment: set integrator=preintegration")
        states = []
        if self._stamp_ns is None:
            if self._given is None:
                state = self._rest.push(window, measurement.features)
                if state is not None:
                    states.append(self._begin(self._filter, state, window.current.stamp_ns))
                return states
            states.append(self._begin(self._filter, self._given, window.previous.stamp_ns))
            self._given = None
        if self._stamp_ns is not None and self._stamp_ns != window.previous.stamp_ns:
            self._counts["missing windows"] += 1
            self._coast(self._filter, seconds(window.previous.stamp_ns - self._stamp_ns))
        if delta is None:
            self._counts["windows without inertial samples"] += 1
            self._coast(self._filter, seconds(window.current.stamp_ns - window.previous.stamp_ns))
        else:
            self._silent_s = 0.0
            self._move(self._filter, measurement, delta)
        self._stamp_ns = window.current.stamp_ns
        states.append(self._filter.nav_state(self._stamp_ns, "tracking"))
        return states

    def _begin(self, filter_: InertialFilter, state: NavState, stamp_ns: int) -> NavState:
        filter_.start(state, self._start.covariance_of(state))
        self._stamp_ns = stamp_ns
        return filter_.nav_state(stamp_ns, "tracking")

    def _coast(self, filter_: InertialFilter, duration_s: float) -> None:
        filter_.propagate(coasting(filter_.body, duration_s, filter_.gravity, *self._gap_sigmas, self._silent_s))
        self._silent_s += duration_s

    def _move(self, filter_: InertialFilter, measurement: Measurement, delta: InertialDelta) -> None:
        if (self._noise_scale != 1.0).any():
            # Integrating again would give the unscaled covariance back.
            covariance = self._noise_scale[:, None] * delta.covariance * self._noise_scale
            delta = replace(delta, covariance=covariance, reintegrate=None)
        window = measurement.window
        if window.gap_ns > self._gap_allowed_ns:
            self._counts["windows with inertial gaps"] += 1
            delta = add_gap(delta, seconds(window.gap_ns), *self._gap_sigmas)
        if not (self._standstill.enabled and self._test.push(window, filter_.body)):
            filter_.propagate(delta)
            return
        filter_.clone_pose()
        filter_.propagate(delta)
        standstill = self._standstill
        H, residual, noise = filter_.standstill_measurement(
            standstill.rotation_sigma, standstill.position_sigma, standstill.velocity_sigma
        )
        if filter_.innovation(H, residual, noise)[1] <= self._standstill_gate:
            filter_.correct(H, residual, noise)
            self._counts["zero-velocity updates"] += 1
        else:
            self._counts["gated standstills"] += 1
        filter_.drop_clone()
