"""How far a training is, on the terminal."""

import time
from typing import Any

import lightning
from lightning.pytorch.callbacks import Callback

from vioframe.learning.module import TrainingModule


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
