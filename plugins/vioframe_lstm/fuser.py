"""``fuser=lstm``: one of two heads over the same cache of frames."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, ClassVar, Literal

from vioframe.checks import check_positive
from vioframe.errors import ConfigError
from vioframe.fusion_options import InertialOptions, StandstillOptions, StartOptions, VisualOptions
from vioframe.interfaces import INERTIAL_DELTA, METRIC_SCALE, RELATIVE_POSE, Fuser
from vioframe.types import ImuBias, Measurement, NavState, SensorRig
from vioframe_lstm.options import PoseOptions, ResidualOptions
from vioframe_lstm.pose import PoseFuser
from vioframe_lstm.residual import ResidualFuser

if TYPE_CHECKING:
    from torch import Tensor, nn

    from vioframe.learning.batch import WindowBatch


class LstmFuser(Fuser):
    """Learned fusion over the last frames; see the README.

    Args:
        head: ``residual``, a net that corrects and weighs the odometry of a filter, or ``pose``, the paper's.
        frames: M, pairs of images that an answer looks at.
        poses: N, poses of the inertial sensor for each image (``head=pose``).
        residual, pose: options of each head.
        visual: trust in the relative poses; of ``head=pose`` only what stands in for what the VO does not state.
        inertial: trust in the inertial increments; of ``head=pose`` only the longest hole.
        standstill: measuring no motion at rest (``head=residual``).
        start: what is assumed of the first state (``head=residual``).
        weights: file of trained weights, in MLflow too, or None.
        device: ``cpu``, ``cuda`` or ``auto``.

    Raises:
        ConfigError: an option outside its range, or torch is missing.
    """

    requires: ClassVar[frozenset[str]] = frozenset({INERTIAL_DELTA, RELATIVE_POSE, METRIC_SCALE})
    learns_from: ClassVar[str] = "answers"

    def __init__(
        self,
        *,
        head: Literal["residual", "pose"] = "residual",
        frames: int = 60,
        poses: int = 10,
        residual: ResidualOptions | None = None,
        pose: PoseOptions | None = None,
        visual: VisualOptions | None = None,
        inertial: InertialOptions | None = None,
        standstill: StandstillOptions | None = None,
        start: StartOptions | None = None,
        weights: str | None = None,
        device: str = "auto",
    ) -> None:
        check_positive("fuser", frames=frames, poses=poses)
        self._head: ResidualFuser | PoseFuser
        if head == "residual":
            self._head = ResidualFuser(
                frames=frames,
                residual=residual or ResidualOptions(),
                visual=visual,
                inertial=inertial,
                standstill=standstill,
                start=start,
                weights=weights,
                device=device,
            )
        elif head == "pose":
            self._head = PoseFuser(
                frames=frames,
                poses=poses,
                pose=pose or PoseOptions(),
                visual=visual,
                inertial=inertial,
                weights=weights,
                device=device,
            )
        else:
            raise ConfigError(f"fuser.head must be residual or pose, got {head!r}")

    @property
    def net(self) -> "nn.Module":
        """The head's."""
        return self._head.net

    @property
    def context_pairs(self) -> int:
        """The head's."""
        return self._head.context_pairs

    @property
    def architecture(self) -> Mapping[str, str | int | float | bool]:
        """The head's."""
        return self._head.architecture

    @property
    def needs_training(self) -> bool:
        """Without weights it has nothing to say."""
        return self._head.needs_training

    def forward_batch(self, batch: "WindowBatch", upstream: "Mapping[str, Tensor]") -> "dict[str, Tensor]":
        """See :class:`vioframe.interfaces.Trainable`."""
        return self._head.forward_batch(batch, upstream)

    def loss(self, outputs: "Mapping[str, Tensor]", batch: "WindowBatch") -> "dict[str, Tensor]":
        """See :class:`vioframe.interfaces.Trainable`."""
        return self._head.loss(outputs, batch)

    def setup(self, rig: SensorRig) -> None:
        """Forget the last sequence, take the calibration, and bring the net to its device."""
        self._head.setup(rig)

    def start_from(self, state: NavState) -> None:
        """Start from a given state."""
        self._head.start_from(state)

    def update(self, measurement: Measurement) -> list[NavState]:
        """The head's states."""
        return self._head.update(measurement)

    def flush(self) -> list[NavState]:
        """The head's last states."""
        return self._head.flush()

    def bias(self) -> ImuBias:
        """What the integrator should assume next."""
        return self._head.bias()

    def counters(self) -> Mapping[str, int]:
        """What a user should read in the table."""
        return self._head.counters()
