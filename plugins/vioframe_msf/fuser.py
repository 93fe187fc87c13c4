"""Inertial propagation corrected by relative poses of unknown scale, drifting and late."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from vioframe.camera_delay import DelayEstimator, DelayOptions
from vioframe.checks import Array
from vioframe.error_state import INERTIAL, VELOCITY
from vioframe.errors import ConfigError
from vioframe.fusion_options import InertialOptions, StandstillOptions, StartOptions, VisualOptions
from vioframe.increments import part_of
from vioframe.interfaces import CONSISTENT_SCALE, INERTIAL_DELTA, RELATIVE_POSE
from vioframe.loose_fusion import LooseFuser, Step, VisualMotion
from vioframe.types import InertialDelta, Measure, Measurement, NavState, SensorRig
from vioframe_msf.search import ScaleSearch
from vioframe_msf.state import ScaledFilter

_SAME_TIME_S = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True)
class ScaleOptions:
    """How the unit of the VO is found and followed.

    Attributes:
        guess: metres per unit, middle of the range that is searched.
        ratio: the range goes from guess/ratio to guess·ratio.
        known_sigma: relative standard deviation at which the scale counts as known.
        known_probability: of one answer against all others, at which it counts as known.
        walk: 1/√s, drift of its logarithm.
        velocity_sigma: m/s; until the scale is known the status is ``starting`` unless the velocity is known,
            from a rest or a given state, to this.
        kept_by_vo: the VO keeps its unit through an interruption; if not, it is searched again after each.
    """

    guess: float = 5.0
    ratio: float = 30.0
    known_sigma: float = 0.1
    known_probability: float = 0.99
    walk: float = 0.01
    velocity_sigma: float = 0.2
    kept_by_vo: bool = True

    def __post_init__(self) -> None:
        for name in ("guess", "known_sigma"):
            if not getattr(self, name) > 0.0:
                raise ConfigError(f"fuser.scale.{name} must be positive, got {getattr(self, name)}")
        if not self.ratio >= 1.0:
            raise ConfigError(f"fuser.scale.ratio must be at least 1, got {self.ratio}")
        if not 0.0 < self.known_probability < 1.0:
            raise ConfigError(f"fuser.scale.known_probability must be in (0, 1), got {self.known_probability}")
        for name in ("walk", "velocity_sigma"):
            if not getattr(self, name) >= 0.0:
                raise ConfigError(f"fuser.scale.{name} must not be negative, got {getattr(self, name)}")


@dataclass(frozen=True, slots=True, kw_only=True)
class DriftOptions:
    """How the error of the VO is made up.

    Attributes:
        share: part of a relative pose's covariance that stays for ever as drift of the vision's frame; the
            rest is the error of single images, which the next relative pose takes back. 1 for an odometer
            whose errors are independent from step to step, less for one that locates itself in a map.
    """

    share: float = 1.0

    def __post_init__(self) -> None:
        if not 0.0 < self.share <= 1.0:
            raise ConfigError(
                f"fuser.drift.share must be in (0, 1], got {self.share}; 0 would be a VO that never drifts"
            )

    def split(self, covariance: Array) -> tuple[Array, Array]:
        """Covariances (6, 6) of the drift of a step and of one image; a step has two images."""
        return self.share * covariance, 0.5 * (1.0 - self.share) * covariance


@dataclass(frozen=True, slots=True, kw_only=True)
class ExtrinsicsOptions:
    """How far the calibrated place of the camera on the body may be off; zeros fix it.

    Attributes:
        rotation_sigma: rad an axis.
        position_sigma: m an axis.
    """

    rotation_sigma: float = 0.0
    position_sigma: float = 0.0

    def __post_init__(self) -> None:
        for name in ("rotation_sigma", "position_sigma"):
            if not getattr(self, name) >= 0.0:
                raise ConfigError(f"fuser.extrinsics.{name} must not be negative, got {getattr(self, name)}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LateStep:
    """A window at the time that the vision speaks of: increments in a row, the camera's motion over them, rest."""

    deltas: tuple[InertialDelta, ...]
    motion: VisualMotion | None
    at_rest: bool

    @property
    def duration_s(self) -> float:
        """Length of the window."""
        return sum(delta.duration_s for delta in self.deltas)


class MsfFuser(LooseFuser):
    """Filter with scale, vision-frame drift, camera extrinsics and delayed measurements; see the README.

    Args:
        visual: trust in the relative poses.
        inertial: trust in the inertial increments.
        standstill: measuring no motion at rest.
        start: what is assumed of the first state.
        scale: how the VO's unit is found and followed.
        drift: how the VO's error is made up.
        extrinsics: how far the camera's calibrated place may be off.
        delay_s: a relative pose between two stamps tells the motion between the instants this much earlier.
        camera_delay: whether the constant offset of the camera's clock is estimated too.

    Raises:
        ConfigError: an option outside its range, or two delays that nothing could tell apart.
    """

    requires: ClassVar[frozenset[str]] = frozenset({INERTIAL_DELTA, RELATIVE_POSE, CONSISTENT_SCALE})
    _filter: ScaledFilter

    def __init__(
        self,
        *,
        visual: VisualOptions | None = None,
        inertial: InertialOptions | None = None,
        standstill: StandstillOptions | None = None,
        start: StartOptions | None = None,
        scale: ScaleOptions | None = None,
        drift: DriftOptions | None = None,
        extrinsics: ExtrinsicsOptions | None = None,
        delay_s: float = 0.0,
        camera_delay: DelayOptions | None = None,
    ) -> None:
        super().__init__(visual=visual, inertial=inertial, standstill=standstill, start=start)
        if not delay_s >= 0.0:
            raise ConfigError(
                f"fuser.delay_s must not be negative, got {delay_s}: a measurement cannot tell the future; "
                "a constant offset of the clocks belongs to the synchronizer"
            )
        self._scale = scale or ScaleOptions()
        self._drift = drift or DriftOptions()
        self._extrinsics = extrinsics or ExtrinsicsOptions()
        self._camera_delay = camera_delay or DelayOptions()
        if delay_s and self._camera_delay.estimate:
            raise ConfigError(
                f"fuser.delay_s={delay_s} and fuser.camera_delay.estimate=true: both move the images against the "
                "inertial samples, and nothing could tell them apart; use one"
            )
        self._delay_s = delay_s
        self._offset: DelayEstimator | None = None
        self._gate = self._visual.gate(6)

    def setup(self, rig: SensorRig) -> None:
        """Forget the last sequence, its delay too, and take the next one's calibration."""
        super().setup(rig)
        options, visual = self._camera_delay, self._visual
        if options.estimate:
            self._offset = DelayEstimator(options, rig, visual.covariance_scale, visual.rotation_sigma)

    def update(self, measurement: Measurement) -> list[NavState]:
        """Propagate over the window, then correct; the delay is learned before the filter has a first state."""
        if self._offset is not None:
            measurement = self._offset.learn(measurement, self.bias())
        return super().update(measurement)

    def camera_delay_ns(self) -> int | None:
        """What the synchronizer should assume next, where the delay is estimated."""
        return None if self._offset is None else self._offset.assumed_ns()

    def calibration(self) -> Mapping[str, Measure]:
        """The delay of the camera, where it is estimated, as the change from the rig's."""
        return {} if self._offset is None else {"camera delay": Measure(value=1e3 * self._offset.change_s, unit="ms")}

    @property
    def scale(self) -> float:
        """Estimated metres per unit of the VO; meaningless while the status is ``starting``."""
        return self._filter.scale

    @property
    def scale_sigma(self) -> float:
        """Standard deviation of the scale, relative."""
        return self._filter.scale_sigma

    @property
    def T_body_cam(self) -> Array:
        """Place of camera 0 on the body, (4, 4), as calibrated or refined."""
        return self._filter.T_body_cam

    def _new_filter(self) -> ScaledFilter:
        return ScaledFilter(
            noise=self._noise,
            gravity=self._gravity,
            T_body_cam=self._T_body_cam,
            extrinsics_sigmas=(self._extrinsics.rotation_sigma, self._extrinsics.position_sigma),
        )

    def _started(self) -> None:
        self._pending: list[InertialDelta] = []
        self._behind_s = 0.0
        self._was_known = False
        self._search: ScaleSearch | None = None
        self._look_for_scale(self._scale.guess)

    def _emit(self) -> NavState:
        ahead = self._filter
        if self._search is not None or self._pending:
            ahead = self._filter.copy()
        if self._search is not None:
            ahead.body, ahead.covariance[INERTIAL, INERTIAL] = self._search.summary()
        for delta in self._pending:
            ahead.propagate(delta)
        state = ahead.nav_state(self._stamp_ns, self._status())
        if self._was_known or state.covariance is None:
            return state
        # Body and scale start apart: from a rest the body is known long before the unit of the VO.
        velocity_sigma = float(np.sqrt(np.diag(state.covariance)[VELOCITY].max()))
        return state if velocity_sigma <= self._scale.velocity_sigma else replace(state, status="starting")

    def _advance(self, step: Step) -> bool:
        late = self._delayed(step)
        if late is None:
            return False
        if step.motion is None and not self._scale.kept_by_vo and self._filter.T_world_vision is not None:
            self._look_for_scale(self._filter.scale)
        if self._search is None:
            return self._track(late)
        if not late.at_rest:
            return self._track_all(late, self._search)
        # At rest nothing is learnt about the scale: one filter is as good as many, and needs no vision.
        supported = self._track(replace(late, motion=None))
        self._look_for_scale(self._scale.guess)
        return supported

    def _delayed(self, step: Step) -> LateStep | None:
        """What the VO's late motion spans: the inertial increments up to then; None before the first state."""
        if self._delay_s == 0.0:
            return LateStep(deltas=(step.delta,), motion=step.motion, at_rest=step.at_rest)
        whole = self._behind_s >= self._delay_s - _SAME_TIME_S
        self._pending.append(step.delta)
        self._behind_s += step.delta.duration_s
        if self._behind_s <= self._delay_s + _SAME_TIME_S:
            return None
        deltas = []
        while self._behind_s > self._delay_s + _SAME_TIME_S:
            first = self._pending.pop(0)
            surplus = self._behind_s - self._delay_s
            if first.duration_s > surplus + _SAME_TIME_S:
                self._pending.insert(0, part_of(first, surplus, first.duration_s))
                first = part_of(first, 0.0, surplus)
            deltas.append(first)
            self._behind_s -= first.duration_s
        # The first motion began before the first state, so nothing can be said about it.
        return LateStep(deltas=tuple(deltas), motion=step.motion if whole else None, at_rest=step.at_rest)

    def _track(self, late: LateStep) -> bool:
        """Propagate over a window and correct; True if a measurement supports the new state."""
        state = self._filter
        image = self._follow(state, late)
        supported = False
        if image is not None:
            H, residual = state.vision_measurement()
            S, chi_square = state.innovation(H, residual, image)
            self._adapted.learn(residual, S, late.duration_s)
            if chi_square > self._gate:
                self._count("gated VO updates")
                state.drop_vision()
            else:
                state.correct(H, residual, image)
                supported = True
        if late.at_rest:
            supported = self._stand_still() or supported
            state.drop_clone()
        return supported

    def _track_all(self, late: LateStep, search: ScaleSearch) -> bool:
        """The same for every hypothesis of the scale."""
        innovations = []
        for hypothesis in search.hypotheses:
            state = hypothesis.state
            image = self._follow(state, late)
            if image is not None:
                H, residual = state.vision_measurement()
                innovations.append((hypothesis, H, residual, image, *state.innovation(H, residual, image)))
        supported = False
        if innovations:
            _, _, residual, _, S, chi_square = min(innovations, key=lambda innovation: innovation[-1])
            self._adapted.learn(residual, S, late.duration_s)
            supported = chi_square <= self._gate
        for hypothesis, H, residual, image, S, chi_square in innovations:
            if not supported:
                hypothesis.state.drop_vision()
                continue
            # The density of the VO's step in its own unit: the residual is in metres, hence the scale.
            density = -0.5 * (chi_square + np.linalg.slogdet(S)[1]) + 3.0 * np.log(hypothesis.state.scale)
            hypothesis.log_weight += float(density)
            hypothesis.state.correct(H, residual, image)
        if innovations and not supported:
            self._count("gated VO updates")
        search.reduce()
        self._filter = search.best
        if search.found(self._scale.known_sigma, self._scale.known_probability):
            self._search = None
            self._was_known = True
        return supported

    def _follow(self, state: ScaledFilter, late: LateStep) -> Array | None:
        """Propagate body and vision; covariance (6, 6), metres, of an image's own error where there is a motion."""
        motion = late.motion
        drift, image = (None, None) if motion is None else self._drift.split(state.metric(motion.covariance))
        if image is None:
            state.drop_vision()
        elif state.T_world_vision is None:
            state.anchor_vision(image)
        if late.at_rest:
            state.clone_pose()
        state.leave()
        for delta in late.deltas:
            state.propagate(delta)
            state.walk_scale(self._scale.walk, delta.duration_s)
        if motion is not None and drift is not None:
            state.advance_vision(motion.T_prev_cur, drift)
        return image

    def _look_for_scale(self, guess: float) -> None:
        self._search = ScaleSearch(self._filter, guess, self._scale.ratio)
        self._filter = self._search.best
