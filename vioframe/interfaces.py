"""The five interfaces, and the names of what they exchange.

A component says what it ``requires`` of the parts before it and what it ``provides`` to those after it;
the names are plain strings, so that a stranger's front end may provide ``"depth"`` and a stranger's fuser
require it with no change here.
"""

import inspect
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, runtime_checkable

from vioframe.checks import Array
from vioframe.errors import ConfigError, PluginError
from vioframe.types import (
    Frame,
    ImuBias,
    ImuBlock,
    InertialDelta,
    InitialisationAttempt,
    Measure,
    Measurement,
    NavState,
    Packet,
    RelativePose,
    SensorRig,
    SyncedWindow,
    Trajectory,
    VisualFeatures,
)

if TYPE_CHECKING:
    from pathlib import Path

    from torch import Tensor, nn

    from vioframe.learning.batch import WindowBatch
    from vioframe.tracking import Tracker

TRACKS, FLOW, EMBEDDING = "tracks", "flow", "embedding"
"""Fields of :class:`VisualFeatures`."""
STEREO_TRACKS = "stereo_tracks"
"""``VisualFeatures.stereo``."""
IMAGES = "images"
"""Pixels in ``Frame.images``; provided by a recording whose rig has cameras."""
STEREO = "stereo"
"""A second, overlapping camera; provided by a recording whose rig has two."""
RELATIVE_POSE = "relative_pose"
"""``Measurement.relative_pose``."""
CONSISTENT_SCALE, METRIC_SCALE = "consistent_scale", "metric_scale"
"""The translation of the relative pose keeps one unit through the sequence / is in metres (which keeps one too)."""
INERTIAL_DELTA = "inertial_delta"
"""``Measurement.inertial_delta``."""


class Component(ABC):  # noqa: B024 - the five below have the abstract methods
    """What all parts share: they are set up once a sequence and say what they need and give."""

    requires: ClassVar[frozenset[str]] = frozenset()
    provides: ClassVar[frozenset[str]] = frozenset()

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        for name, method in vars(cls).items():
            if not inspect.isfunction(method) or name.startswith("_"):
                continue
            inherited = next((getattr(base, name) for base in cls.__mro__[1:] if name in vars(base)), None)
            if inspect.isfunction(inherited):
                _check_override(cls, name, method, inherited)

    def setup(self, rig: SensorRig) -> None:  # noqa: B027 - a part without calibration needs none of its own
        """Forget the last sequence and take the next one's calibration."""

    def counters(self) -> Mapping[str, int]:
        """What happened since ``setup`` that a user should read in the table, such as ``{"dropped frames": 3}``."""
        return {}


def _check_override(cls: type, name: str, method: Any, inherited: Any) -> None:
    """Compare an overriding method's parameters with the interface's, when the class is made."""
    wanted = list(inspect.signature(inherited).parameters.values())
    given = list(inspect.signature(method).parameters.values())
    same = len(given) >= len(wanted) and all(
        mine.name == theirs.name for mine, theirs in zip(given, wanted, strict=False)
    )
    variadic = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    needless = [p.name for p in given[len(wanted) :] if p.default is p.empty and p.kind not in variadic]
    missing_default = [
        mine.name
        for mine, theirs in zip(given, wanted, strict=False)
        if theirs.default is not theirs.empty and mine.default is mine.empty
    ]
    if not same or needless or missing_default:
        raise PluginError(
            f"{cls.__module__}.{cls.__qualname__}.{name} must take the parameters "
            f"{inspect.signature(inherited)}, but takes {inspect.signature(method)}"
        )


class Synchronizer(Component):
    """Pairs each image with the inertial samples since the one before, on the IMU clock."""

    @abstractmethod
    def push(self, packet: Packet) -> list[SyncedWindow]:
        """Take one packet; return the windows it completes, oldest first."""

    @abstractmethod
    def flush(self) -> list[SyncedWindow]:
        """The recording has ended: return what can still be completed."""

    def assume_camera_delay(self, delay_ns: int) -> None:
        """Stamp the frames to come with this delay (``t_imu = t_cam + delay``) instead of the rig's."""


class Frontend(Component):
    """Turns an image into what a motion estimator can use."""

    requires: ClassVar[frozenset[str]] = frozenset({IMAGES})

    @abstractmethod
    def process(self, frame: Frame, R_prev_cur: Array | None = None) -> VisualFeatures:
        """Process the next image.

        Args:
            frame: on the IMU clock.
            R_prev_cur: (3, 3) rotation of the *body* since the image before, predicted by the gyro, when known.
        """

    def process_many(self, frames: Iterable[Frame]) -> list[VisualFeatures]:
        """Process images in a row; a network overrides this with one batched pass."""
        return [self.process(frame) for frame in frames]


class VOEstimator(Component):
    """Estimates the motion of the camera between two images."""

    provides: ClassVar[frozenset[str]] = frozenset({RELATIVE_POSE})

    @abstractmethod
    def estimate(self, previous: VisualFeatures, current: VisualFeatures) -> RelativePose:
        """Motion of camera 0 from ``previous`` to ``current``; ``valid=False`` rather than an exception."""


class InertialIntegrator(Component):
    """Turns inertial samples into one motion increment; keeps no state but the calibration."""

    provides: ClassVar[frozenset[str]] = frozenset({INERTIAL_DELTA})

    @abstractmethod
    def integrate(self, imu: ImuBlock, bias: ImuBias) -> InertialDelta:
        """Integrate from the first to the last sample of ``imu``, subtracting ``bias``."""


class Fuser(Component):
    """Turns measurements into the state of the body."""

    @abstractmethod
    def update(self, measurement: Measurement) -> list[NavState]:
        """Take the next window; return new states, oldest first, each stamp once."""

    def flush(self) -> list[NavState]:
        """The recording has ended: return the states not yet given."""
        return []

    def start_from(self, state: NavState) -> None:
        """Start from a given state at ``window.previous`` of the next update, instead of initialising.

        Raises:
            ConfigError: this method initialises itself only.
        """
        raise ConfigError(f"init=groundtruth: {type(self).__name__} cannot start from a given state; use init=auto")

    def bias(self) -> ImuBias:
        """What the integrator should assume next."""
        return ImuBias()

    def camera_delay_ns(self) -> int | None:
        """What the synchronizer should assume next, where this method estimates it (``t_imu = t_cam + delay``)."""
        return None

    def calibration(self) -> Mapping[str, Measure]:
        """What of the calibration is estimated, by name, as the change from the rig's; empty where nothing is."""
        return {}

    def attempts(self) -> Sequence[InitialisationAttempt]:
        """Every attempt to start since ``setup``, oldest first, with what was missing."""
        return ()

    def smoothed(self) -> Trajectory | None:
        """The final trajectory (``causal=False``), where the method has one."""
        return None


@runtime_checkable
class UsesGroundTruth(Protocol):
    """A component that simulates a sensor from the truth, such as ``vo=simulated``.

    The experiment hands it the truth openly and writes the component's name into the protocol of every
    number it prints; no other component ever sees the truth.
    """

    def take_ground_truth(self, trajectory: Trajectory) -> None:
        """Receive the true trajectory, after ``setup`` and before the first packet."""
        ...


@runtime_checkable
class HasNet(Protocol):
    """What has a net whose weights are kept in files; see ``vioframe/learning``.

    Attributes:
        net: all that is learned, the weights of a loss with several terms included, so that they are saved too.
        architecture: plain values on which a file of weights must agree with this part, such as
            ``{"part": "tsvo", "backbone": "resnet50", "stack": 10}``. One that reads embeddings says of what length
            under ``embedding``.
    """

    @property
    def net(self) -> "nn.Module":
        """See the class."""
        ...

    @property
    def architecture(self) -> Mapping[str, str | int | float | bool]:
        """See the class."""
        ...


@runtime_checkable
class Trainable(HasNet, Protocol):
    """A component that *has* a net and can be trained on windows of a recording; see ``vioframe/learning``.

    In training the parts run on batches, in the order of the pipeline; what one returns is added, by name, to what
    the later ones find ``upstream``. A part that answers with a motion of the camera returns it as
    ``"T_prev_cur"``: (B, S - context_pairs + 1, 4, 4) in metres, for the last pairs of each window.

    Attributes:
        context_pairs: how many pairs of images in a row one answer takes, 1 or more.
        needs_training: its answers mean nothing yet: it was given no weights, and does not work without any. An
            experiment trains such a part first.

    Three more it may have. ``learns_from``: ``"images"``, as all parts without it, or ``"answers"``: it is trained by
    itself, after the others, on windows without images that bring what the parts before it answered; it finds their
    ``"T_prev_cur"``, ``"covariance"`` (zero where none was stated) and ``"valid"`` upstream. ``training_pairs``: the
    pairs of images that its windows should have where ``trainer.pairs`` does not say; else ``context_pairs``.
    ``settling_pairs``: when all are trained it is trained further by itself, the others staying as they are, on windows
    of so many pairs, as ``trainer.settling`` says.
    """

    @property
    def context_pairs(self) -> int:
        """See the class."""
        ...

    @property
    def needs_training(self) -> bool:
        """See the class."""
        ...

    def forward_batch(self, batch: "WindowBatch", upstream: Mapping[str, "Tensor"]) -> dict[str, "Tensor"]:
        """Run the net on a batch.

        Args:
            batch: on the net's device, images in [0, 1].
            upstream: what the parts before returned, by name.
        """
        ...

    def loss(self, outputs: Mapping[str, "Tensor"], batch: "WindowBatch") -> dict[str, "Tensor"]:
        """Compare what the net returned with the truth.

        Args:
            outputs: what :meth:`forward_batch` returned.
            batch: the same batch.

        Returns:
            scalars by name: ``"loss"`` is minimised, the others are only recorded. Empty for a part that is trained
            through the parts after it.
        """
        ...


@runtime_checkable
class TrainsItself(Protocol):
    """A part with a training of its own, on something else than windows of a recording; ``task=train`` calls it."""

    def train_itself(self, folder: "Path", tracker: "Tracker", *, shown: bool, resume: bool) -> "Mapping[str, Path]":
        """Train, with the part's own options.

        Args:
            folder: of all that is written. While it trains, ``resume.ckpt`` there is what a training goes on from.
            tracker: of the run, started.
            shown: whether to show a progress bar.
            resume: go on from ``resume.ckpt`` in the folder.

        Returns:
            files of weights by slot; empty where it ended, as its options said, before there were any.

        Raises:
            ConfigError: an option that cannot work.
            DataError: files that cannot be used.
            KeyboardInterrupt: the user stopped it.
        """
        ...
