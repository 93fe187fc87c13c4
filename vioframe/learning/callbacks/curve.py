"""The numbers of a training, an epoch a row: on disk and in the tracker."""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import Callback
from torch import Tensor

from vioframe.learning.module import TrainingModule
from vioframe.learning.rows import Row, write_rows
from vioframe.tracking import Tracker

CURVE_FILE = "curve.csv"


class Curve(Callback):
    """One row an epoch: losses, learning rate, speed, and the validation's errors; in a CSV file and the tracker.

    Args:
        folder: of ``curve.csv``.
        tracker: of the run.
    """

    def __init__(self, folder: Path, tracker: Tracker) -> None:
        self.rows: list[Row] = []
        self._folder = folder
        self._tracker = tracker
        self._sums: dict[str, tuple[Tensor, int]] = {}
        self._began = 0.0
        self._images = 0
        self._validation_s = 0.0

    def state_dict(self) -> dict[str, Any]:
        """The rows so far."""
        return {"rows": self.rows}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on after the rows of the run that was stopped."""
        self.rows = [{str(name): float(value) for name, value in row.items()} for row in state_dict["rows"]]

    def on_train_epoch_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Begin a row."""
        self._sums = {}
        self._began = time.perf_counter()
        self._images = 0
        self._validation_s = 0.0

    def on_train_batch_end(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Add a step."""
        self._images += len(batch) * (batch.pairs + 1) * trainer.world_size
        self._add("train", outputs)

    def on_validation_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Validation does not count for the speed of training."""
        self._validation_s -= time.perf_counter()

    def on_validation_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Stop the clock of the validation."""
        self._validation_s += time.perf_counter()

    def on_validation_batch_end(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """Add a batch."""
        self._add("validation", outputs)

    def on_train_epoch_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Write the row."""
        elapsed_s = time.perf_counter() - self._began - self._validation_s
        row: Row = {"epoch": float(trainer.current_epoch), "step": float(trainer.global_step)}
        for name, (total, count) in self._sums.items():
            row[name] = float(trainer.strategy.reduce(total / count, reduce_op="mean"))
        row["learning_rate"] = float(trainer.optimizers[0].param_groups[0]["lr"])
        row["images_per_s"] = self._images / max(elapsed_s, 1e-9)
        score = pl_module.score if isinstance(pl_module, TrainingModule) else None
        if isinstance(pl_module, TrainingModule) and score is not None and "validation/loss" in row:
            row["validation/t_rel_percent"] = score.t_rel_percent
            row["validation/r_rel_deg_per_100m"] = score.r_rel_deg_per_100m
            row["validation/relative_to_reference"] = pl_module.rank_value
        self.rows.append(row)
        if trainer.is_global_zero:
            write_rows(self._folder / CURVE_FILE, self.rows)
            series = {name: value for name, value in row.items() if name != "epoch"}
            self._tracker.log_metrics(series, step=trainer.current_epoch)

    def _add(self, split: str, losses: Mapping[str, Tensor] | None) -> None:
        for name, value in (losses or {}).items():
            total, count = self._sums.get(f"{split}/{name}", (torch.zeros((), device=value.device), 0))
            # Kept on the device: asking for its value at every step would make the GPU wait.
            self._sums[f"{split}/{name}"] = (total + value.detach().float(), count + 1)
