"""A stage of training as lightning has it: the net, its loss at a step, the rate of learning."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import lightning
import torch
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from torch import Tensor, nn

from vioframe_superpoint.training.losses import descriptor_loss, detector_loss
from vioframe_superpoint.training.options import DescriptorLoss

# Share of a trapezoid over which the rate falls to zero.
_FALL = 0.2
_BIASES_BELOW = 2

StepLoss = Callable[[nn.Module, Mapping[str, Tensor], int], dict[str, Tensor]]
"""(net, batch, iteration) → losses by name, of which ``"loss"`` is minimised."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RateOptions:
    """How steps are taken.

    Attributes:
        iterations: of the stage.
        learning_rate: at its highest.
        schedule: ``constant``, ``cosine`` or ``trapezoid``.
        warmup: iterations over which the rate rises.
        weight_decay: of AdamW; 0 is Adam.
    """

    iterations: int
    learning_rate: float
    schedule: str
    warmup: int
    weight_decay: float


class StageModule(lightning.LightningModule):
    """Trains a net by one loss.

    Args:
        net: SuperPoint's.
        loss: of a step.
        rate: how steps are taken.
    """

    def __init__(self, net: nn.Module, loss: StepLoss, rate: RateOptions) -> None:
        super().__init__()
        self.net = net
        self._loss = loss
        self._rate = rate
        # What pictures and labels cost is not what a net that is wide or narrow learns with: layout only.
        self.net.to(memory_format=torch.channels_last)
        self.started = False

    def training_step(self, batch: Mapping[str, Tensor], batch_idx: int) -> dict[str, Tensor]:
        """Losses of a step."""
        losses = self._loss(self.net, batch, self.global_step)
        self.started = True
        return {"loss": losses["loss"], **{name: value.detach() for name, value in losses.items() if name != "loss"}}

    def configure_optimizers(self) -> OptimizerLRScheduler:
        """Adam, or AdamW that spares biases and scales, and the schedule."""
        decayed = [p for p in self.net.parameters() if p.ndim >= _BIASES_BELOW]
        spared = [p for p in self.net.parameters() if p.ndim < _BIASES_BELOW]
        groups: list[dict[str, Any]] = [
            {"params": decayed, "weight_decay": self._rate.weight_decay},
            {"params": spared, "weight_decay": 0.0},
        ]
        optimizer = torch.optim.AdamW(groups, lr=self._rate.learning_rate)
        factor = rate_factor(self._rate)
        schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, factor)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


def rate_factor(rate: RateOptions) -> Callable[[int], float]:
    """The factor on the learning rate at each iteration."""
    warmup = min(rate.warmup, rate.iterations // 10)

    def factor(iteration: int) -> float:
        if iteration < warmup:
            return (iteration + 1) / (warmup + 1)
        left = max(1.0 - iteration / rate.iterations, 0.0)
        if rate.schedule == "cosine":
            done = min((iteration - warmup) / max(rate.iterations - warmup, 1), 1.0)
            return 0.5 * (1.0 + math.cos(math.pi * done))
        if rate.schedule == "trapezoid":
            return min(left / _FALL, 1.0)
        return 1.0

    return factor


def shapes_loss(net: nn.Module, batch: Mapping[str, Tensor], iteration: int) -> dict[str, Tensor]:
    """Of the first stage: the detector's alone.

    Args:
        net: SuperPoint's.
        batch: ``images`` (B, H, W) uint8 and ``classes`` (B, h, w).
        iteration: does not matter.
    """
    logits = net.detector(net.encoder(as_float(batch["images"])))  # type: ignore[operator]
    classes = batch["classes"]
    return {"loss": detector_loss(logits, classes, torch.ones_like(classes, dtype=torch.bool))}


class JointLoss:
    """Of the third stage, on a batch of pairs: ``L_p + L_p' + λ L_d``.

    Args:
        options: of the descriptors' loss, with λ.
    """

    def __init__(self, options: DescriptorLoss) -> None:
        self._options = options

    def __call__(self, net: nn.Module, batch: Mapping[str, Tensor], iteration: int) -> dict[str, Tensor]:
        """Losses of a batch, as :class:`~vioframe_superpoint.training.pairs.Pair` has it with an axis in front."""
        images = batch["images"]
        pairs = images.shape[0]
        # Both views in one pass, the first ones first.
        logits, maps = net(as_float(images.transpose(0, 1).flatten(0, 1)))
        classes, whole = batch["classes"], batch["whole"]
        detectors = [detector_loss(logits[at], classes[:, view], whole[:, view]) for view, at in _views(pairs)]
        points, overlap = batch["points"], batch["overlap"]
        descriptors = descriptor_loss(
            self._options,
            maps[:pairs],
            maps[pairs:],
            batch["H"],
            points=(points[:, 0], points[:, 1]),
            matched=batch["matched"],
            valid=(overlap[:, 0], overlap[:, 1]),
            seed=iteration,
        )
        detector = detectors[0] + detectors[1]
        loss = detector + self._options.weight * descriptors
        return {"loss": loss, "detector": detector, "descriptors": descriptors}


def as_float(images: Tensor) -> Tensor:
    """Grey images (B, 1, H, W) in [0, 1], as they lie best in memory, of (B, H, W) uint8."""
    return (images[:, None].float() / 255.0).contiguous(memory_format=torch.channels_last)


def _views(pairs: int) -> tuple[tuple[int, slice], tuple[int, slice]]:
    return (0, slice(0, pairs)), (1, slice(pairs, 2 * pairs))
