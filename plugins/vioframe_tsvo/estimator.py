"""What learned estimators have in common: weights, device, images, losses, and numbers into motions."""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from vioframe.checks import check_positive
from vioframe.errors import ConfigError, DataError, StateError
from vioframe.interfaces import CONSISTENT_SCALE, IMAGES, METRIC_SCALE, RELATIVE_POSE, VOEstimator
from vioframe.learning.holder import NetHolder
from vioframe.learning.images import NetImages, check_size
from vioframe.types import Frame, RelativePose, SensorRig

if TYPE_CHECKING:
    from torch import Tensor, nn

    from vioframe.learning.batch import WindowBatch
    from vioframe.learning.motion import Rotation
    from vioframe_tsvo.net.two_stream import MotionEstimate

_CHOICES = {
    "rotation": ("log", "euler"),
    "loss": ("learned", "fixed", "likelihood"),
}
# In units of the output.
_LARGEST_LOG_VARIANCE = 12.0


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionOptions:
    """Options of every learned estimator, checked.

    Attributes:
        size_px: (width, height) to which images are brought.
        gray: take images in grey, even where the camera has colour.
        rotation: what three numbers of rotation mean: ``log`` or ``euler``.
        rotation_unit_rad, translation_unit_m: what an output of 1 means.
        loss: ``learned`` weights, ``fixed`` ones, or the ``likelihood`` of a Gaussian with the variances stated.
        rotation_weight: of the fixed ones, m²/rad².
        log_variance_rotation, log_variance_translation: from which the learned ones start, ln rad² and ln m².
        weights: file of trained weights, in MLflow too, or None.
        device: ``cpu``, ``cuda``, or ``auto`` for the latter where there is one.

    Raises:
        ConfigError: with the key and its value.
    """

    size_px: Sequence[int]
    gray: bool
    rotation: "Rotation"
    rotation_unit_rad: float
    translation_unit_m: float
    loss: str
    rotation_weight: float
    log_variance_rotation: float
    log_variance_translation: float
    weights: str | None
    device: str

    def __post_init__(self) -> None:
        check_size("vo.size_px", self.size_px)
        check_positive(
            "vo",
            rotation_unit_rad=self.rotation_unit_rad,
            translation_unit_m=self.translation_unit_m,
            rotation_weight=self.rotation_weight,
        )
        for name, allowed in _CHOICES.items():
            if getattr(self, name) not in allowed:
                raise ConfigError(f"vo.{name} must be one of {', '.join(allowed)}, got {getattr(self, name)!r}")

    @property
    def size(self) -> tuple[int, int]:
        """(width, height)."""
        return self.size_px[0], self.size_px[1]

    @property
    def log_variances(self) -> bool:
        """Whether the net states variances: only the likelihood teaches it to."""
        return self.loss == "likelihood"

    def architecture(self) -> dict[str, str | int | float | bool]:
        """What of it a file of weights must agree with."""
        return {
            "width_px": self.size[0],
            "height_px": self.size[1],
            "gray": self.gray,
            "rotation": self.rotation,
            "rotation_unit_rad": self.rotation_unit_rad,
            "translation_unit_m": self.translation_unit_m,
            "loss": self.loss,
        }


class LearnedVO(VOEstimator):
    """An estimator with a net; metric, since it has learned how far its camera moves.

    Args:
        name: the option of the group ``vo``, for messages.
        options: what it shares with the other.

    Raises:
        ConfigError: torch is missing.
    """

    requires: ClassVar[frozenset[str]] = frozenset({IMAGES})
    provides: ClassVar[frozenset[str]] = frozenset({RELATIVE_POSE, CONSISTENT_SCALE, METRIC_SCALE})

    def __init__(self, name: str, options: MotionOptions) -> None:
        self._holder = NetHolder(self, "vo", name, self._make_net, options.weights, options.device)
        self._name = name
        self._options = options
        self.images = NetImages(slot="vo", name=name, size_px=options.size_px, gray=options.gray)
        self._seen: tuple[Frame, Tensor] | None = None
        self._ready = False

    @property
    def net(self) -> "nn.Module":
        """``motion``, the network, and ``weighing``, its loss; made when first asked for: torch is slow to import.

        Raises:
            ConfigError: there is no such file of weights.
            DataError: the file is of another architecture, or damaged.
        """
        return self._holder.net

    @property
    @abstractmethod
    def context_pairs(self) -> int:
        """Pairs of images in a row that one answer takes in training."""

    @property
    def needs_training(self) -> bool:
        """Without weights its motions are those of a random net."""
        return self._holder.needs_training

    @property
    @abstractmethod
    def architecture(self) -> Mapping[str, str | int | float | bool]:
        """What a file of weights must agree with."""

    @abstractmethod
    def make_motion_net(self) -> "nn.Module":
        """The network, with random weights."""

    @abstractmethod
    def forward_batch(self, batch: "WindowBatch", upstream: "Mapping[str, Tensor]") -> "dict[str, Tensor]":
        """See :class:`vioframe.interfaces.Trainable`."""

    def setup(self, rig: SensorRig) -> None:
        """Forget the last sequence and bring the net to its device.

        Raises:
            ConfigError: a GPU or a file of weights that is not there.
            DataError: the rig has no camera; the file of weights cannot be used.
        """
        if not rig.cameras:
            raise DataError(f"vo={self._name} needs a camera, but the recording's calibration has none")
        self._holder.prepare()
        self._seen = None
        self._ready = True

    def loss(self, outputs: "Mapping[str, Tensor]", batch: "WindowBatch") -> "dict[str, Tensor]":
        """``loss``, and mean squared errors in units of the output, against the last motions of each window."""
        from vioframe.learning.motion import vector_from_motion

        vector = outputs["motion"]
        target = vector_from_motion(batch.T_prev_cur[:, -vector.shape[1] :], self._options.rotation)
        pair = (vector, target) if not self._options.log_variances else (vector, target, outputs["log_variances"])
        losses: dict[str, Tensor] = self.net.get_submodule("weighing")(*pair)
        return losses

    def outputs(self, estimate: "MotionEstimate", answered: int) -> "dict[str, Tensor]":
        """What :meth:`forward_batch` returns: vectors in rad and metres, and the last ``answered`` as motions."""
        from vioframe.learning.motion import motion_from_vector

        self._holder.taught()
        vector, log_variances = self._scaled(estimate)
        named = {"motion": vector, "T_prev_cur": motion_from_vector(vector[:, -answered:], self._options.rotation)}
        return named if log_variances is None else {**named, "log_variances": log_variances}

    def relative_pose(self, estimate: "MotionEstimate") -> RelativePose:
        """The motion of one pair, from estimates of any leading axes of length one."""
        from vioframe.learning.motion import covariance_from_log_variances, motion_from_vector, vector_from_motion

        vector, log_variances = (None if each is None else each.reshape(6).double() for each in self._scaled(estimate))
        if vector is None or not bool(vector.isfinite().all()):
            return RelativePose.invalid()
        T_prev_cur = motion_from_vector(vector, self._options.rotation)
        covariance = None
        if log_variances is not None:
            # Small angles of either kind have the same errors to first order.
            stated = covariance_from_log_variances(vector_from_motion(T_prev_cur), log_variances)
            covariance = (0.5 * (stated + stated.T)).cpu().numpy()
        return RelativePose(T_prev_cur=T_prev_cur.cpu().numpy(), covariance=covariance)

    def pair(self, previous: Frame, current: Frame) -> "Tensor":
        """Both images, (1, 6, H, W) in [0, 1], the earlier first, on the net's device.

        Raises:
            StateError: called before ``setup``.
            DataError: a frame without an image.
        """
        import torch

        if not self._ready:
            raise StateError(f"{type(self).__name__}.estimate was called before setup(rig): set it up first")
        device = self._holder.device()
        before = self._seen[1] if self._seen is not None and self._seen[0] is previous else None
        before = self.images.of_frame(previous, device) if before is None else before
        after = self.images.of_frame(current, device)
        self._seen = (current, after)
        return torch.cat([before, after])[None]

    def _scaled(self, estimate: "MotionEstimate") -> "tuple[Tensor, Tensor | None]":
        """Vectors in rad and metres, and logarithms of rad² and m²."""
        unit = [self._options.rotation_unit_rad] * 3 + [self._options.translation_unit_m] * 3
        units = estimate.vector.new_tensor(unit)
        if estimate.log_variances is None:
            return estimate.vector * units, None
        # One sample known to 2.5 thousandths of a unit must not outweigh all others; what is stated is what was taught.
        limited = estimate.log_variances.clamp(-_LARGEST_LOG_VARIANCE, _LARGEST_LOG_VARIANCE)
        return estimate.vector * units, limited + 2.0 * units.log()

    def _make_net(self) -> "nn.Module":
        from torch import nn

        from vioframe.learning.losses import FixedWeights, GaussianLikelihood, LearnedWeights

        weighing: nn.Module
        if self._options.loss == "learned":
            weighing = LearnedWeights(
                log_variance_rotation=self._options.log_variance_rotation,
                log_variance_translation=self._options.log_variance_translation,
            )
        elif self._options.loss == "fixed":
            weighing = FixedWeights(rotation_weight=self._options.rotation_weight)
        else:
            weighing = GaussianLikelihood()
        return nn.ModuleDict({"motion": self.make_motion_net(), "weighing": weighing})
