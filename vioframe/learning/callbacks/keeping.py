"""What is left on disk to use and to go on from: the best weights, and a point to resume at."""

import math
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar

import lightning
from lightning.pytorch.callbacks import Callback

from vioframe.interfaces import Trainable
from vioframe.learning.module import TrainingModule
from vioframe.learning.weights import save_weights

RESUME_FILE = "resume.ckpt"


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


class ResumePoint(Callback):
    """Writes ``resume.ckpt`` at the end of every epoch; last of the callbacks, so that it holds their states.

    Args:
        folder: of the file.
        start: what the file says of the weights that the training began with; None: nothing.
    """

    START: ClassVar[str] = "vioframe_start"
    """Key of ``start`` in the file."""

    def __init__(self, folder: Path, start: str | None = None) -> None:
        self._path = folder / RESUME_FILE
        self._start = start

    def on_save_checkpoint(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Say what the training began with."""
        if self._start is not None:
            checkpoint[self.START] = self._start

    def on_train_epoch_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Write beside, then rename: a kill on the way leaves the last one whole."""
        partial = self._path.with_suffix(".partial")
        trainer.save_checkpoint(partial)
        if trainer.is_global_zero:
            os.replace(partial, self._path)
