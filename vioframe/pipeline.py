"""The parts wired together: one path for streaming and for a recording on disk."""

import logging
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass

from vioframe.errors import StateError, WiringError
from vioframe.interfaces import (
    CONSISTENT_SCALE,
    IMAGES,
    METRIC_SCALE,
    STEREO,
    Component,
    Frontend,
    Fuser,
    InertialIntegrator,
    Synchronizer,
    VOEstimator,
)
from vioframe.types import (
    InertialDelta,
    Measurement,
    NavState,
    Packet,
    RelativePose,
    SensorRig,
    SyncedWindow,
    VisualFeatures,
)

log = logging.getLogger(__name__)

SLOTS: dict[str, type[Component]] = {
    "synchronizer": Synchronizer,
    "frontend": Frontend,
    "vo": VOEstimator,
    "integrator": InertialIntegrator,
    "fuser": Fuser,
}
"""The five slots in the order in which data passes them."""

Observer = Callable[[Measurement, list[NavState]], None]
InitialState = Callable[[int], NavState | None]


@dataclass(slots=True)
class PartTimer:
    """Wall seconds spent inside one part's own methods."""

    seconds: float = 0.0
    calls: int = 0

    def add(self, started: float) -> None:
        """Count one call that began at ``started`` on :func:`time.perf_counter`."""
        self.seconds += time.perf_counter() - started
        self.calls += 1


class Pipeline:
    """A synchronizer and a fuser, with a front end, a VO and an integrator where they are wanted.

    Inside a window: integrate (with ``fuser.bias()``), predict the rotation, process the image, estimate
    the motion, fuse. A window without inertial samples has no increment; one of whose two images never came
    has no features and an invalid motion.

    Args:
        choices: what the user called each part, for messages, such as ``{"fuser": "ekf"}``.

    Raises:
        WiringError: a part needs what nothing before it provides.
    """

    def __init__(
        self,
        *,
        synchronizer: Synchronizer,
        fuser: Fuser,
        frontend: Frontend | None = None,
        vo: VOEstimator | None = None,
        integrator: InertialIntegrator | None = None,
        choices: Mapping[str, str] | None = None,
    ) -> None:
        self.synchronizer = synchronizer
        self.frontend = frontend
        self.vo = vo
        self.integrator = integrator
        self.fuser = fuser
        self.choices = dict(choices or {})
        self.timers = {slot: PartTimer() for slot in self.parts()}
        self.seconds = 0.0
        self.windows = 0
        self._observers: list[Observer] = []
        self._initial_state: InitialState | None = None
        self._features: VisualFeatures | None = None
        self._ready = False
        check_wiring(self.parts(), self.choices)

    def parts(self) -> dict[str, Component]:
        """The filled slots, in the order in which data passes them."""
        filled = {slot: getattr(self, slot) for slot in SLOTS}
        return {slot: part for slot, part in filled.items() if part is not None}

    def observe(self, observer: Observer) -> None:
        """Call ``observer(measurement, new_states)`` after every window; its time counts to no part."""
        self._observers.append(observer)

    def forget(self, observer: Observer) -> None:
        """Stop calling an observer."""
        self._observers.remove(observer)

    def setup(self, rig: SensorRig, initial_state: InitialState | None = None) -> None:
        """Forget the last sequence and take the next one's calibration.

        Args:
            rig: calibration of the recording to come.
            initial_state: gives the state at a stamp (IMU clock) or None where it is unknown; windows are
                passed over until it is known, then the fuser starts from it. Without it the fuser
                initialises itself.

        Raises:
            WiringError: a part needs images or inertial samples, and the rig has none.
        """
        check_rig(self.parts(), rig, self.choices)
        for part in self.parts().values():
            part.setup(rig)
        self.timers = {slot: PartTimer() for slot in self.parts()}
        self.seconds = 0.0
        self.windows = 0
        self._features = None
        self._initial_state = initial_state
        self._ready = True

    def push(self, packet: Packet) -> list[NavState]:
        """Take one packet in the order of arrival; return the new states, oldest first."""
        if not self._ready:
            raise StateError("Pipeline.push was called before Pipeline.setup(rig): set the pipeline up first")
        started = time.perf_counter()
        windows = self.synchronizer.push(packet)
        self.timers["synchronizer"].add(started)
        states = [state for window in windows for state in self._process(window)]
        self.seconds += time.perf_counter() - started
        return states

    def flush(self) -> list[NavState]:
        """The recording has ended: return the states still to come."""
        if not self._ready:
            raise StateError("Pipeline.flush was called before Pipeline.setup(rig): set the pipeline up first")
        started = time.perf_counter()
        windows = self.synchronizer.flush()
        self.timers["synchronizer"].add(started)
        states = [state for window in windows for state in self._process(window)]
        states += self.fuser.flush()
        self.seconds += time.perf_counter() - started
        return states

    def run(self, packets: Iterable[Packet]) -> Iterator[NavState]:
        """Push every packet, then flush: a recording is a stream that ends."""
        for packet in packets:
            yield from self.push(packet)
        yield from self.flush()

    def _process(self, window: SyncedWindow) -> list[NavState]:
        if self._initial_state is not None:
            state = self._initial_state(window.previous.stamp_ns)
            if state is None:
                return []
            self.fuser.start_from(state)
            self._initial_state = None
        delta = self._integrate(window)
        features = self._see(window, delta)
        relative_pose = self._estimate(features)
        measurement = Measurement(window=window, features=features, relative_pose=relative_pose, inertial_delta=delta)
        started = time.perf_counter()
        states = self.fuser.update(measurement)
        self.timers["fuser"].add(started)
        delay_ns = self.fuser.camera_delay_ns()
        if delay_ns is not None:
            self.synchronizer.assume_camera_delay(delay_ns)
        self._features = features
        self.windows += 1
        for observer in self._observers:
            observed = time.perf_counter()
            observer(measurement, states)
            # An observer watches; its time is neither a part's nor the framework's.
            self.seconds -= time.perf_counter() - observed
        return states

    def _integrate(self, window: SyncedWindow) -> InertialDelta | None:
        if self.integrator is None or not len(window.imu):
            return None
        started = time.perf_counter()
        delta = self.integrator.integrate(window.imu, self.fuser.bias())
        self.timers["integrator"].add(started)
        return delta

    def _see(self, window: SyncedWindow, delta: InertialDelta | None) -> VisualFeatures | None:
        if window.current.missing or (self.frontend is None and self.vo is None):
            return None
        known = self._features is not None and self._features.frame.stamp_ns == window.previous.stamp_ns
        if self.frontend is None:
            # A VO that reads pixels itself still gets both frames.
            if not known:
                self._features = None if window.previous.missing else VisualFeatures(frame=window.previous)
            return VisualFeatures(frame=window.current)
        started = time.perf_counter()
        if not known:
            self._features = None if window.previous.missing else self.frontend.process(window.previous, None)
        features = self.frontend.process(window.current, None if delta is None else delta.delta_R)
        self.timers["frontend"].add(started)
        return features

    def _estimate(self, features: VisualFeatures | None) -> RelativePose | None:
        if self.vo is None:
            return None
        if features is None or self._features is None:
            # One of the two images never came.
            return RelativePose.invalid()
        started = time.perf_counter()
        relative_pose = self.vo.estimate(self._features, features)
        self.timers["vo"].add(started)
        return relative_pose


def check_wiring(parts: Mapping[str, Component], choices: Mapping[str, str]) -> None:
    """Refuse a pipeline in which a part needs what nothing before it provides.

    Raises:
        WiringError: names the part, what it needs, and all choices.
    """
    # What the recording itself can give is checked against its rig, in check_rig.
    available = {IMAGES, STEREO}
    for slot, part in parts.items():
        missing = sorted(part.requires - available)
        if missing:
            before = ", ".join(
                f"{other}={choices.get(other, type(parts[other]).__name__ if other in parts else 'none')}"
                for other in SLOTS
                if other != slot
            )
            name = choices.get(slot, type(part).__name__)
            raise WiringError(
                f"{slot}={name} needs {' and '.join(missing)}, which nothing before it provides ({before})"
            )
        available |= part.provides
        if METRIC_SCALE in part.provides:
            available.add(CONSISTENT_SCALE)


def check_rig(parts: Mapping[str, Component], rig: SensorRig, choices: Mapping[str, str]) -> None:
    """Refuse a recording without the sensors that a part needs.

    Raises:
        WiringError: names the part, and the number of cameras it has and needs.
    """
    if not rig.has_imu and "integrator" in parts:
        # Whatever fuses inertial samples gets them through an integrator.
        name = choices.get("integrator", type(parts["integrator"]).__name__)
        raise WiringError(
            f"integrator={name} needs inertial samples, but the recording has none: use vision alone "
            "(integrator=none fuser=vo_only, with a vo), or a recording that has them"
        )
    available = len(rig.cameras) if rig.has_images else 0
    for slot, part in parts.items():
        needed = 2 if STEREO in part.requires else 1 if IMAGES in part.requires else 0
        if available < needed:
            name = choices.get(slot, type(part).__name__)
            raise WiringError(
                f"{slot}={name} needs the images of {needed} camera{'s' * (needed > 1)}, but the recording gives "
                f"{available}: choose another {slot}, or rig={'stereo' if needed > 1 else 'mono'} where the "
                "recording has them"
            )
