"""The options of ``fuser=vinet``, checked."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from vioframe.checks import check_not_negative, check_positive
from vioframe.errors import ConfigError

Axes = Literal["camera", "body"]
Rotation = Literal["gyro", "learned"]
Feedback = Literal["none", "pose"]
Loss = Literal["learned", "likelihood"]

_CHOICES = {
    "axes": ("camera", "body"),
    "rotation": ("gyro", "learned"),
    "feedback": ("none", "pose"),
    "loss": ("learned", "likelihood"),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class NetOptions:
    """What the net is made of and how it is trained.

    Attributes:
        embedding: numbers that the front end gives for a pair of images.
        window: pairs of a training window, and those over which poses are composed.
        settling: pairs of the windows from which the fuser learns by itself.
        imu_intervals: to which the inertial samples between two images are brought.
        imu_hidden, imu_layers: of the LSTM over them.
        hidden, layers: of the core's LSTM.
        joined: neurons of the layer before the answer.
        dropout: in training, after the core and between its layers.
        axes: in which samples and motions are expressed.
        rotation: added to the gyro's, or learned whole.
        gyro_bias_sigma: rad/s an axis, of the gyro's bias at first.
        gyro_memory: pairs after which what images said of it counts 1/e.
        scale_memory: pairs after which 1/e is left of an error of lengths.
        feedback: what the core sees of its own answers.
        rotation_unit_rad, translation_unit_m: what an output of 1 means.
        loss: ``learned`` weights, or the ``likelihood`` of a Gaussian with the variances stated.
        horizons: pairs over which errors are summed up for that likelihood.
        pose_weight: of the composed poses beside the motions.
        log_variance_rotation, log_variance_translation: from which learned weights start, ln rad² and ln m².
        lost_images, lost_imu: share of training windows in which a stretch of the sensor is left out.

    Raises:
        ConfigError: with the key and its value.
    """

    embedding: int
    window: int
    settling: int
    imu_intervals: int
    imu_hidden: int
    imu_layers: int
    hidden: int
    layers: int
    joined: int
    dropout: float
    axes: Axes
    rotation: Rotation
    gyro_bias_sigma: float
    gyro_memory: int
    scale_memory: int
    feedback: Feedback
    rotation_unit_rad: float
    translation_unit_m: float
    loss: Loss
    horizons: Sequence[int]
    pose_weight: float
    log_variance_rotation: float
    log_variance_translation: float
    lost_images: float
    lost_imu: float

    def __post_init__(self) -> None:
        sizes = ("embedding", "window", "imu_intervals", "imu_hidden", "imu_layers", "hidden", "layers", "joined")
        for name in (*sizes, "settling", "gyro_memory", "scale_memory"):
            value = getattr(self, name)
            if not isinstance(value, int) or value < 1:
                raise ConfigError(f"fuser.{name} must be a whole number of 1 or more, got {value!r}")
        if not self.horizons or not all(isinstance(pairs, int) and pairs > 0 for pairs in self.horizons):
            raise ConfigError(f"fuser.horizons must be whole numbers of 1 or more, got {list(self.horizons)}")
        check_positive(
            "fuser",
            rotation_unit_rad=self.rotation_unit_rad,
            translation_unit_m=self.translation_unit_m,
            gyro_bias_sigma=self.gyro_bias_sigma,
        )
        check_not_negative("fuser", pose_weight=self.pose_weight)
        if not 0.0 <= self.dropout < 1.0:
            raise ConfigError(f"fuser.dropout must be from 0 to below 1, got {self.dropout}")
        for name in ("lost_images", "lost_imu"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ConfigError(f"fuser.{name} must lie in [0, 1], got {getattr(self, name)}")
        for name, allowed in _CHOICES.items():
            if getattr(self, name) not in allowed:
                raise ConfigError(f"fuser.{name} must be one of {', '.join(allowed)}, got {getattr(self, name)!r}")

    @property
    def log_variances(self) -> bool:
        """Whether the net states variances: only the likelihood teaches it to."""
        return self.loss == "likelihood"

    def architecture(self) -> dict[str, str | int | float | bool]:
        """What of it a file of weights must agree with."""
        return {
            "part": "vinet",
            "embedding": self.embedding,
            "imu_intervals": self.imu_intervals,
            "imu_hidden": self.imu_hidden,
            "imu_layers": self.imu_layers,
            "hidden": self.hidden,
            "layers": self.layers,
            "joined": self.joined,
            "axes": self.axes,
            "rotation": self.rotation,
            "feedback": self.feedback,
            "rotation_unit_rad": self.rotation_unit_rad,
            "translation_unit_m": self.translation_unit_m,
            "loss": self.loss,
        }
