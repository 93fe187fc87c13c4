"""What watches a training: the curve on disk, a stop when it diverges, the best weights, and a point to resume from.

Each keeps its state in the resume file as plain containers, so that the file can be read as data (``weights_only``).
Their order matters: see ``training.py``.
"""

import csv
import math
import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import Callback
from torch import Tensor

from vioframe.errors import ConfigError
from vioframe.interfaces import Trainable
from vioframe.learning.module import TrainingModule
from vioframe.learning.weights import save_weights
from vioframe.tracking import Tracker

RESUME_FILE = "resume.ckpt"
CURVE_FILE = "curve.csv"

# Steps over which the loss is averaged before it is judged: one hard batch is no divergence.
_BLOCK = 10

Row = dict[str, float]


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
            row["validation/relative_to_constant_motion"] = pl_module.rank_value
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


def write_rows(path: Path, rows: list[Row]) -> None:
    """A CSV file of rows that need not have the same columns."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows({name: f"{value:.10g}" for name, value in row.items()} for row in rows)


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
        mean = float(block.mean())
        self._block = []
        if self._first is None:
            # Before any step was taken: a wild learning rate shows within the first block.
            self._first = float(block[0])
        limit = min(self._least, self._first) + self._factor * max(abs(self._first), abs(min(self._least, self._first)))
        if not math.isfinite(mean) or mean > limit:
            was = "" if math.isinf(self._least) else f", after {self._least:.3g} at best"
            raise ConfigError(
                f"trainer.learning_rate={self._learning_rate:g} makes the training diverge: the loss is {mean:.3g} at "
                f"step {trainer.global_step}{was}; choose a smaller one, or a smaller trainer.gradient_clip. The best "
                "weights from before are kept"
            )
        self._least = min(self._least, mean)


class BestWeights(Callback):
    """Keeps the weights of the best validations, each with its card.

    Args:
        folder: of the files ``<slot>-epoch<number>.safetensors``.
        parts: by slot; those that are trained are saved.
        keep: how many validations' weights to keep.
        card: what the card says beside the figures of the validation.

    Attributes:
        best: (rank value, epoch) of what is kept, best first.
    """

    def __init__(
        self,
        folder: Path,
        parts: Mapping[str, Trainable],
        keep: int,
        card: Callable[[TrainingModule], dict[str, object]],
    ) -> None:
        self.best: list[tuple[float, int]] = []
        self._folder = folder
        self._parts = dict(parts)
        self._keep = keep
        self._card = card

    def path(self, slot: str, epoch: int) -> Path:
        """Where the weights of one part are."""
        return self._folder / f"{slot}-epoch{epoch:04d}.safetensors"

    def state_dict(self) -> dict[str, Any]:
        """What is kept."""
        return {"best": [list(entry) for entry in self.best]}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on with what was kept and is still there."""
        entries = [(float(rank), int(epoch)) for rank, epoch in state_dict["best"]]
        self.best = [entry for entry in entries if all(self.path(slot, entry[1]).exists() for slot in self._parts)]

    def on_validation_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Save what is among the best, delete what no longer is."""
        if not isinstance(pl_module, TrainingModule) or not math.isfinite(pl_module.rank_value):
            return
        epoch = trainer.current_epoch
        ranked = sorted([entry for entry in self.best if entry[1] != epoch] + [(pl_module.rank_value, epoch)])
        kept, dropped = ranked[: self._keep], ranked[self._keep :]
        if trainer.is_global_zero:
            if (pl_module.rank_value, epoch) in kept:
                for slot, part in self._parts.items():
                    save_weights(self.path(slot, epoch), part, {"epoch": epoch, **self._card(pl_module)})
            for _, old in dropped:
                for slot in self._parts:
                    self.path(slot, old).unlink(missing_ok=True)
                    self.path(slot, old).with_suffix(".json").unlink(missing_ok=True)
        self.best = kept


class BestPicture(Callback):
    """Draws the trajectories of a validation that is the best so far; in the folder and the tracker.

    Args:
        folder: of ``validation.png``.
        tracker: of the run.
    """

    def __init__(self, folder: Path, tracker: Tracker) -> None:
        self._path = folder / "validation.png"
        self._tracker = tracker
        self._least = math.inf

    def state_dict(self) -> dict[str, Any]:
        """The best so far."""
        return {"least": self._least}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Draw only what is better than before."""
        self._least = float(state_dict["least"])

    def on_validation_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Draw, if it is worth it."""
        if not isinstance(pl_module, TrainingModule) or pl_module.score is None or pl_module.rank_value >= self._least:
            return
        self._least = pl_module.rank_value
        if not trainer.is_global_zero:
            return
        from vioframe.learning.pictures import draw_trajectories

        score = pl_module.score
        caption = (
            f"epoch {trainer.current_epoch} · camera 0 seen from above, no alignment · "
            f"t_rel {score.t_rel_percent:.2f} % · r_rel {score.r_rel_deg_per_100m:.2f} °/100 m"
        )
        draw_trajectories(self._path, pl_module.trajectories(), caption)
        self._tracker.log_file(self._path, "plots")


class ResumePoint(Callback):
    """Writes ``resume.ckpt`` at the end of every epoch; last of the callbacks, so that it holds their states."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / RESUME_FILE

    def on_train_epoch_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Write beside, then rename: a kill on the way leaves the last one whole."""
        partial = self._path.with_suffix(".partial")
        trainer.save_checkpoint(partial)
        if trainer.is_global_zero:
            os.replace(partial, self._path)


class Bar(Callback):
    """A progress bar on the terminal (stderr) with images a second and the time that is left."""

    def __init__(self) -> None:
        self._progress: Any = None
        self._task: Any = None
        self._began = 0.0
        self._images = 0

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Show it, where a resumed run stands."""
        if not trainer.is_global_zero:
            return
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[told]}"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(elapsed_when_finished=False),
            console=Console(stderr=True),
            refresh_per_second=2,
        )
        total = int(trainer.estimated_stepping_batches)
        self._progress.start()
        self._task = self._progress.add_task("training", total=total, completed=trainer.global_step, told="")
        self._began = time.perf_counter()

    def on_train_batch_end(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Advance."""
        if self._progress is None:
            return
        self._images += len(batch) * (batch.pairs + 1) * trainer.world_size
        speed = self._images / max(time.perf_counter() - self._began, 1e-9)
        score = pl_module.score if isinstance(pl_module, TrainingModule) else None
        errors = f"  t_rel {score.t_rel_percent:.2f} %  r_rel {score.r_rel_deg_per_100m:.2f} °/100 m" if score else ""
        told = f"epoch {trainer.current_epoch + 1}/{trainer.max_epochs}  {speed:.0f} images/s{errors}"
        self._progress.update(self._task, completed=trainer.global_step, told=told)

    def on_fit_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Take it down."""
        self._close()

    def on_exception(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, exception: BaseException
    ) -> None:
        """Take it down before the error is told."""
        self._close()

    def _close(self) -> None:
        if self._progress is not None:
            self._progress.stop()
            self._progress = None
