"""What watches a stage of training: its numbers, a bar, validation and best weights, a point to resume at.

Each keeps its state in the resume file as plain containers, so that the file can be read as data.
"""

import logging
import math
import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import Callback

from vioframe.errors import ConfigError
from vioframe.learning.callbacks.curve import Row, write_rows
from vioframe.tracking import Tracker

log = logging.getLogger(__name__)

RESUME_FILE = "resume.ckpt"

Validate = Callable[[int], Mapping[str, float]]
"""Iteration → figures by name; ``"rank"``, higher is better, chooses among weights."""


class Progress(Callback):
    """Numbers of each block of iterations, in ``<stage>.csv``, the tracker and on the terminal.

    Args:
        stage: its name.
        iterations: of the stage.
        block: iterations of a block.
        validate: what to call every ``every`` iterations and at the end, or None.
        every: iterations.
        folder: of the file.
        tracker: of the run.
        shown: whether to show a bar.
        rate_key: the option of the learning rate, for messages.

    Attributes:
        rows: of the blocks so far.
        seconds: of training so far, over all sessions, validation included.
    """

    def __init__(
        self,
        stage: str,
        iterations: int,
        block: int,
        *,
        validate: Validate | None,
        every: int,
        folder: Path,
        tracker: Tracker,
        shown: bool,
        rate_key: str,
    ) -> None:
        self.rows: list[Row] = []
        self.seconds = 0.0
        self.validated: dict[str, float] = {}
        self._stage = stage
        self._iterations = iterations
        self._block = block
        self._validate = validate
        self._every = every
        self._path = folder / f"{stage}.csv"
        self._tracker = tracker
        self._bar = Bar(stage, iterations) if shown else None
        self._rate_key = rate_key
        self._sums: dict[str, torch.Tensor] = {}
        self._steps = 0
        self._began = 0.0

    def state_dict(self) -> dict[str, Any]:
        """Rows and time so far."""
        return {"rows": self.rows, "seconds": self.seconds, "stage": self._stage, "block": self._block}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on after those of the run that was stopped."""
        self.rows = [{str(name): float(value) for name, value in row.items()} for row in state_dict["rows"]]
        self.seconds = float(state_dict["seconds"])

    def on_train_epoch_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Begin a block."""
        self._sums, self._steps, self._began = {}, 0, time.perf_counter()
        if self._bar is not None:
            self._bar.show(trainer.global_step)

    def on_train_batch_end(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Add an iteration."""
        for name, value in outputs.items():
            self._sums[name] = self._sums.get(name, torch.zeros((), device=value.device)) + value.detach().float()
        self._steps += 1
        if self._bar is not None:
            self._bar.advance(trainer.global_step, self._steps / max(time.perf_counter() - self._began, 1e-9))

    def on_train_epoch_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Write the row, and validate if it is time."""
        iteration = trainer.global_step
        elapsed_s = time.perf_counter() - self._began
        row: Row = {"iteration": float(iteration)}
        row |= {name: float(total) / max(self._steps, 1) for name, total in self._sums.items()}
        if not math.isfinite(row.get("loss", 0.0)):
            raise ConfigError(
                f"{self._rate_key}={trainer.optimizers[0].defaults['lr']:g} makes the training diverge: the loss is "
                f"{row['loss']} at iteration {iteration}; choose a smaller one, or clip gradients "
                "(frontend.training.gradient_clip)"
            )
        row["learning_rate"] = float(trainer.optimizers[0].param_groups[0]["lr"])
        row["iterations_per_s"] = self._steps / max(elapsed_s, 1e-9)
        self.validated = {}
        if self._validate is not None and (iteration % self._every == 0 or iteration >= self._iterations):
            self.validated = dict(self._validate(iteration))
            row |= {f"validation/{name}": value for name, value in self.validated.items()}
            if self._bar is not None:
                self._bar.tell(self.validated)
        self.seconds += time.perf_counter() - self._began
        self.rows.append(row)
        write_rows(self._path, self.rows)
        numbers = {f"{self._stage}/{name}": value for name, value in row.items() if name != "iteration"}
        self._tracker.log_metrics(numbers, step=iteration)

    def on_fit_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Take the bar down."""
        if self._bar is not None:
            self._bar.close()

    def on_exception(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, exception: BaseException
    ) -> None:
        """Take the bar down before the error is told."""
        if self._bar is not None:
            self._bar.close()


class KeepBest(Callback):
    """Keeps the weights of the best validation.

    Args:
        progress: that validates; it comes before this one.
        save: called with the iteration when the weights are the best so far.

    Attributes:
        best: (rank, iteration), or None before a validation.
    """

    def __init__(self, progress: Progress, save: Callable[[int], None]) -> None:
        self.best: tuple[float, int] | None = None
        self._progress = progress
        self._save = save

    def state_dict(self) -> dict[str, Any]:
        """The best so far."""
        return {"best": None if self.best is None else list(self.best)}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Keep only what is better than before."""
        best = state_dict["best"]
        self.best = None if best is None else (float(best[0]), int(best[1]))

    def on_train_epoch_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Save, if it is worth it."""
        rank = self._progress.validated.get("rank", math.nan)
        if math.isfinite(rank) and (self.best is None or rank > self.best[0]):
            self.best = (rank, trainer.global_step)
            self._save(trainer.global_step)


class ResumePoint(Callback):
    """Writes ``resume.ckpt`` at the end of every block, and ends the session when its time is over; the last callback.

    Args:
        folder: of the file.
        until: time, as :func:`time.monotonic` counts, at which the session ends; None for no limit.

    Attributes:
        stopped: whether the time was over before the stage was.
    """

    def __init__(self, folder: Path, until: float | None) -> None:
        self.stopped = False
        self._path = folder / RESUME_FILE
        self._until = until

    def on_train_epoch_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Write beside, then rename: a kill on the way leaves the last one whole."""
        partial = self._path.with_suffix(".partial")
        trainer.save_checkpoint(partial)
        os.replace(partial, self._path)
        if self._until is not None and time.monotonic() >= self._until:
            self.stopped = trainer.global_step < trainer.max_steps
            trainer.should_stop = True


class Bar:
    """A progress bar on the terminal (stderr).

    Args:
        title: of what.
        total: steps.
        unit: of a step, for the speed.
    """

    def __init__(self, title: str, total: int, unit: str = "it") -> None:
        self._title = title
        self._total = total
        self._unit = unit
        self._progress: Any = None
        self._task: Any = None
        self._figures = ""

    def show(self, done: int) -> None:
        """Put it up, if it is not."""
        if self._progress is not None:
            return
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[told]}"),
            TextColumn("left"),
            TimeRemainingColumn(elapsed_when_finished=False),
            console=Console(stderr=True),
            refresh_per_second=2,
        )
        self._progress.start()
        self._task = self._progress.add_task(self._title, total=self._total, completed=done, told="")

    def advance(self, done: int, per_second: float) -> None:
        """Say how far it is."""
        if self._progress is not None:
            self._progress.update(self._task, completed=done, told=f"{per_second:.2f} {self._unit}/s{self._figures}")

    def tell(self, figures: Mapping[str, float]) -> None:
        """Show figures of a validation from now on."""
        self._figures = "".join(f"  {name} {value:.3f}" for name, value in figures.items() if "/" not in name)

    def close(self) -> None:
        """Take it down."""
        if self._progress is not None:
            self._progress.stop()
            self._progress = None
