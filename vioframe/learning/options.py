"""``trainer=``: how parts are trained; every field is a line of ``conf/trainer/default.yaml``."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal

from vioframe.checks import check_not_negative, check_positive
from vioframe.data.augmentation import Augmentation
from vioframe.errors import ConfigError

_CHOICES = {
    "optimizer": ("adam", "adamw"),
    "schedule": ("cosine", "halving", "constant"),
    "accelerator": ("auto", "cpu", "gpu"),
    "precision": ("auto", "32", "bf16", "16"),
}

# ``fusion`` and ``settling`` have one in a later stage only, whose options they are part of.
_WITHOUT_BEARING = ("cache", "resume", "workers", "fusion", "settling")


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainerOptions:
    """The options, checked.

    Attributes:
        seed: of initial weights, order, augmentation and dropout.
        max_epochs: passes over the training windows.
        epoch_windows: windows drawn for one pass; None takes them all.
        max_minutes: stops after this time, at the end of a batch; None: no limit.
        batch_size: windows in a step, on each device.
        pairs: consecutive pairs of images in a window; None takes as many as the parts look back at.
        size_px: (width, height) to which images are resized; the parts take it from here.
        flow_size_px, width, dropout: of nets; only recorded here, the parts take them from here.
        channels: 1 (grey) or 3 (RGB).
        recordings: learned from, the first so many of ``training_data``; None takes them all.
        cache: folder of the decoded recordings.
        train: slots whose parts are trained, the others keep their weights; None trains all that can be.
        optimizer, learning_rate, weight_decay: of the steps; ``adamw`` spares biases and scales from the decay.
        schedule: of the learning rate: ``cosine`` to zero, ``halving`` every ``halve_every`` epochs, or ``constant``.
        halve_every: epochs.
        warmup_steps: over which the learning rate rises from zero.
        gradient_clip: largest norm of the gradient; 0 for no limit.
        divergence_factor: training stops when the loss, averaged over ten steps, exceeds its least value so far by
            this many times the size of the very first step's (or of the least, if that is larger).
        top_k: weights kept, by the score on the validation recordings.
        validate_every: epochs from one validation to the next.
        segment_lengths_m: of t_rel and r_rel on the validation recordings.
        segment_step: images from the start of a segment to that of the next.
        accelerator, devices, precision: as lightning has them; ``auto`` is bf16 on a GPU that has it, else 32.
        workers: processes that cut and change windows; None: as many as there are cores to spare, at most 16.
        resume: file of a run that was stopped; None begins anew.
        augmentation: of the training windows.
        fusion: options that are others where a fuser is trained on what a VO answered.
        settling: options that are others where a part is trained further by itself on longer windows; None or empty:
            none is.

    Raises:
        ConfigError: with the key and its value.
    """

    seed: int
    max_epochs: int
    epoch_windows: int | None
    max_minutes: float | None
    batch_size: int
    pairs: int | None
    size_px: Sequence[int]
    flow_size_px: Sequence[int] | None
    width: float
    dropout: float
    channels: int
    recordings: int | None
    cache: str
    train: Sequence[str] | None
    optimizer: Literal["adam", "adamw"]
    learning_rate: float
    weight_decay: float
    schedule: Literal["cosine", "halving", "constant"]
    halve_every: int
    warmup_steps: int
    gradient_clip: float
    divergence_factor: float
    top_k: int
    validate_every: int
    segment_lengths_m: Sequence[float]
    segment_step: int
    accelerator: Literal["auto", "cpu", "gpu"]
    devices: int
    precision: Literal["auto", "32", "bf16", "16"]
    workers: int | None
    resume: str | None
    augmentation: Augmentation
    fusion: Mapping[str, Any]
    settling: Mapping[str, Any] | None

    def __post_init__(self) -> None:
        for name, allowed in _CHOICES.items():
            # YAML makes a number of 32.
            if str(getattr(self, name)) not in allowed:
                raise ConfigError(f"trainer.{name} must be one of {', '.join(allowed)}, got {getattr(self, name)!r}")
        counts = ("max_epochs", "batch_size", "halve_every", "top_k", "validate_every", "segment_step", "devices")
        for name in (
            *counts,
            *(each for each in ("epoch_windows", "pairs", "recordings") if getattr(self, each) is not None),
        ):
            value = getattr(self, name)
            if not isinstance(value, int) or value < 1:
                raise ConfigError(f"trainer.{name} must be a whole number of 1 or more, got {value!r}")
        if isinstance(self.train, str):
            raise ConfigError(f"trainer.train must be a list of slots, such as [{self.train}], got {self.train!r}")
        if self.max_minutes is not None:
            check_positive("trainer", max_minutes=self.max_minutes)
        check_positive(
            "trainer", width=self.width, learning_rate=self.learning_rate, divergence_factor=self.divergence_factor
        )
        check_not_negative(
            "trainer", weight_decay=self.weight_decay, warmup_steps=self.warmup_steps, gradient_clip=self.gradient_clip
        )
        if not isinstance(self.seed, int) or not 0 <= self.seed < 2**31:
            raise ConfigError(f"trainer.seed must be a whole number from 0 to {2**31 - 1}, got {self.seed!r}")
        if self.workers is not None and self.workers < 0:
            raise ConfigError(f"trainer.workers must be 0 or more, or null, got {self.workers}")
        if not self.segment_lengths_m or not all(length > 0.0 for length in self.segment_lengths_m):
            raise ConfigError(f"trainer.segment_lengths_m must be positive lengths, got {list(self.segment_lengths_m)}")

    def settings(self) -> dict[str, object]:
        """All that has a bearing on the result, as plain values."""
        plain = {each.name: getattr(self, each.name) for each in fields(self) if each.name not in _WITHOUT_BEARING}
        plain |= {name: list(plain[name]) for name in ("size_px", "segment_lengths_m")}
        plain["flow_size_px"] = None if self.flow_size_px is None else list(self.flow_size_px)
        plain["train"] = None if self.train is None else list(self.train)
        plain["augmentation"] = self.augmentation.settings()
        return plain
