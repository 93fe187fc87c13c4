"""Options of both heads, checked; torch is not needed to read them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from vioframe.checks import check_not_negative, check_positive
from vioframe.errors import ConfigError
from vioframe.fusion_options import InertialOptions, VisualOptions


@dataclass(frozen=True, slots=True, kw_only=True)
class ResidualOptions:
    """The head that corrects the VO for a filter.

    Attributes:
        channels: width of the net.
        dropout: in training.
        bias_caution: factor on the spread of gyro biases over the training recordings, which is what the filter
            assumes of the one it begins with; 0 leaves that to ``start``, and the gyro's noise to the rig.
        horizons: pairs over which errors are summed up in training.
        speed_unit: m/s that the net takes for one.
        rate_unit: rad/s that it takes for one.
        lost_share: part of the training windows that lose a stretch of the camera's answers, and as many of the
            inertial samples.
        lost_pairs: longest such stretch.
    """

    channels: int = 48
    dropout: float = 0.1
    bias_caution: float = 2.0
    horizons: Sequence[int] = (50, 100, 200)
    speed_unit: float = 10.0
    rate_unit: float = 0.3
    lost_share: float = 0.2
    lost_pairs: int = 30

    def __post_init__(self) -> None:
        check_positive(
            "fuser.residual",
            channels=self.channels,
            speed_unit=self.speed_unit,
            rate_unit=self.rate_unit,
            lost_pairs=self.lost_pairs,
        )
        check_share("fuser.residual.dropout", self.dropout)
        check_not_negative("fuser.residual", lost_share=self.lost_share, bias_caution=self.bias_caution)
        if not self.horizons or not all(isinstance(each, int) and each >= 1 for each in self.horizons):
            raise ConfigError(
                f"fuser.residual.horizons must be whole numbers of pairs from 1, got {list(self.horizons)}"
            )
        if not self.lost_share <= 1.0:
            raise ConfigError(f"fuser.residual.lost_share must be at most 1, got {self.lost_share}")


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseOptions:
    """The head of EE-LCVIO, which puts the pose itself out.

    Attributes:
        pose: of which the poses speak: ``relative`` to the first image of the window, or ``absolute``, to the first of
            all, as in the paper.
        refines: the net's numbers correct the VO's pose at the window's end, a tenth of the units being one; else they
            are the pose, as in the paper.
        activation: of what the LSTM puts out and of its cell: ``tanh``, or ``relu`` as in the paper.
        channels: of each convolution.
        kernel: frames that a convolution looks at.
        padding: ``same`` leaves as many frames as came, ``valid`` those that the kernel covers.
        pool: frames that are pooled into one.
        hidden: neurons of each of the two LSTM layers.
        head: neurons of the layer after them.
        width: factor on channels and neurons.
        dropout: after each LSTM layer, in training.
        translation_unit: m and rotation_unit: rad that the net takes for one; the paper's are 1.
        log_variance_translation: ln m and log_variance_rotation: ln rad, from which the weights of the two losses
            start.
        answers: windows of each training window that are learned from, drawn at random.
        lost_after_s: seconds without a motion of the VO after which the status is ``lost``.
    """

    pose: Literal["relative", "absolute"] = "relative"
    refines: bool = True
    activation: Literal["tanh", "relu"] = "tanh"
    channels: int = 64
    kernel: int = 11
    padding: Literal["same", "valid"] = "same"
    pool: int = 3
    hidden: int = 512
    head: int = 128
    width: float = 1.0
    dropout: float = 0.2
    translation_unit: float = 10.0
    rotation_unit: float = 0.3
    log_variance_translation: float = 0.0
    log_variance_rotation: float = -3.0
    answers: int = 8
    lost_after_s: float = 1.0

    def __post_init__(self) -> None:
        check_positive(
            "fuser.pose",
            channels=self.channels,
            kernel=self.kernel,
            pool=self.pool,
            hidden=self.hidden,
            head=self.head,
            width=self.width,
            answers=self.answers,
            translation_unit=self.translation_unit,
            rotation_unit=self.rotation_unit,
            lost_after_s=self.lost_after_s,
        )
        check_share("fuser.pose.dropout", self.dropout)
        for name, allowed in {
            "pose": ("relative", "absolute"),
            "activation": ("tanh", "relu"),
            "padding": ("same", "valid"),
        }.items():
            if getattr(self, name) not in allowed:
                raise ConfigError(f"fuser.pose.{name} must be {' or '.join(allowed)}, got {getattr(self, name)!r}")
        if self.padding == "same" and self.kernel % 2 == 0:
            raise ConfigError(f"fuser.pose.kernel must be odd with padding=same, got {self.kernel}")

    def scaled(self, size: int) -> int:
        """``size`` neurons or channels by the factor ``width``, at least four."""
        return max(round(self.width * size), 4)

    def frames_left(self, frames: int) -> int:
        """Steps of the LSTM for a window of ``frames`` pairs."""
        covered = frames if self.padding == "same" else frames - 3 * (self.kernel - 1)
        return covered // self.pool


@dataclass(frozen=True, slots=True, kw_only=True)
class Unstated:
    """What is assumed of a VO that states no covariance, and of samples with a hole.

    Attributes:
        rotation_sigma: rad an axis.
        translation_sigma: m an axis.
        translation_ratio: part of the distance moved, an axis, added to that in variance.
        longest_gap_s: with a longer time between samples a pair counts as one without.
    """

    rotation_sigma: float
    translation_sigma: float
    translation_ratio: float
    longest_gap_s: float


def unstated_of(visual: VisualOptions, inertial: InertialOptions) -> Unstated:
    """What the filter's options assume where nothing is stated."""
    return Unstated(
        rotation_sigma=visual.rotation_sigma,
        translation_sigma=visual.translation_sigma,
        translation_ratio=visual.translation_ratio,
        longest_gap_s=inertial.gap_allowed_s,
    )


def check_share(key: str, value: float) -> None:
    """Refuse what is no share that leaves something.

    Raises:
        ConfigError: with the key and its value.
    """
    if not 0.0 <= value < 1.0:
        raise ConfigError(f"{key} must be from 0 to below 1, got {value}")
