"""A stop for a training that diverges."""

import math
from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import Callback
from torch import Tensor

from vioframe.errors import ConfigError

# Steps over which the loss is averaged before it is judged: one hard batch is no divergence.
_BLOCK = 10


class StopDivergence(Callback):
    """Stops a training whose loss is not finite or has left where it began.

    With block means L of the loss over ten steps, L* the least of them so far and L₀ the loss of the very first step,
    it stops when ``L > L* + factor · max(|L₀|, |L*|)``: a loss with learned log-variances may well be negative.

    Args:
        factor: see above.
        learning_rate: for the message.

    Raises:
        ConfigError: in mid-training, when it diverges.
    """

    def __init__(self, factor: float, learning_rate: float) -> None:
        self._factor = factor
        self._learning_rate = learning_rate
        self._block: list[Tensor] = []
        self._first: float | None = None
        self._least = math.inf

    def state_dict(self) -> dict[str, Any]:
        """What the loss is held against."""
        return {"first": self._first, "least": self._least}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Hold it against the same as before."""
        self._first, self._least = state_dict["first"], state_dict["least"]

    def on_train_batch_end(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Judge each block of steps; the last of an epoch may be shorter."""
        self._block.append(outputs["loss"].detach().float())
        if len(self._block) < _BLOCK and not trainer.is_last_batch:
            return
        block = torch.stack(self._block)
        # All processes judge by the same number, so that all stop or none.
        mean = float(trainer.strategy.reduce(block.mean(), reduce_op="mean"))
        self._block = []
        if self._first is None:
            # Before any step was taken: a wild learning rate shows within the first block.
            self._first = float(trainer.strategy.reduce(block[0], reduce_op="mean"))
        limit = min(self._least, self._first) + self._factor * max(abs(self._first), abs(min(self._least, self._first)))
        if not math.isfinite(mean) or mean > limit:
            was = "" if math.isinf(self._least) else f", after {self._least:.3g} at best"
            kept = (
                "The best weights from before, where a validation was reached, are kept"
                if trainer.current_epoch
                else "No epoch was complete, so there are no weights to keep"
            )
            raise ConfigError(
                f"trainer.learning_rate={self._learning_rate:g} makes the training diverge: the loss is {mean:.3g} at "
                f"step {trainer.global_step}{was}; choose a smaller one, or clip gradients "
                f"(trainer.gradient_clip). {kept}"
            )
        self._least = min(self._least, mean)
