"""Pictures of a training while it lasts: trajectories, flow and curve, in its folder and the tracker."""

import math
import time
from pathlib import Path
from typing import Any

import lightning
import numpy as np
import torch
from lightning.pytorch.callbacks import Callback

from vioframe.interfaces import FLOW
from vioframe.learning.batch import WindowBatch
from vioframe.learning.callbacks.curve import Curve
from vioframe.learning.module import TrainingModule
from vioframe.learning.scoring import Score
from vioframe.tracking import Tracker


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


class FlowPicture(Callback):
    """Draws the flow that the parts find in one window of the validation, always the same, whenever it has changed.

    There is none where no part puts ``"flow"`` upstream.

    Args:
        folder: of ``flow.png``.
        tracker: of the run.
    """

    def __init__(self, folder: Path, tracker: Tracker) -> None:
        self._path = folder / "flow.png"
        self._tracker = tracker
        self._drawn: np.ndarray | None = None

    def on_validation_batch_end(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        outputs: Any,
        batch: WindowBatch,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """Draw the middle batch's first window."""
        if not isinstance(pl_module, TrainingModule) or not trainer.is_global_zero:
            return
        if batch_idx != int(sum(trainer.num_val_batches)) // 2:
            return
        window = batch.first()
        with torch.no_grad(), trainer.precision_plugin.val_step_context():
            known, _ = pl_module.run_parts(window)
        if FLOW not in known or known[FLOW].ndim != 5:
            return
        # The last pair is the one that is answered.
        flow = known[FLOW][0, -1].float().permute(1, 2, 0).cpu().numpy()
        if self._drawn is not None and np.array_equal(flow, self._drawn):
            return
        self._drawn = flow
        from vioframe.learning.pictures import draw_flow

        pair = window.images[0, -2:].float().permute(0, 2, 3, 1).cpu().numpy()
        name = pl_module.trajectories()[int(window.recording[0])][0].name
        place = int(window.start[0]) + window.pairs - 1
        caption = f"epoch {trainer.current_epoch} · {name}, images {place} and {place + 1}, as the net sees them"
        draw_flow(self._path, pair, flow, caption)
        self._tracker.log_file(self._path, "plots")


class CurvePicture(Callback):
    """Draws the curve as it grows, but never for longer than a share of the training's time; and when it ends.

    Args:
        curve: whose rows are drawn; comes before this one.
        reference: score to compare with, on the validation recordings.
        beside: what it is of.
        folder: of ``curve.png``.
        tracker: of the run.
    """

    _SHARE = 0.03

    def __init__(self, curve: Curve, reference: Score, beside: str, folder: Path, tracker: Tracker) -> None:
        self._reference = reference
        self._beside = beside
        self._curve = curve
        self._path = folder / "curve.png"
        self._tracker = tracker
        self._drawn_rows = 0
        self._next_s = -math.inf

    def on_train_epoch_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Draw, if the last drawing is long enough ago."""
        if trainer.is_global_zero and time.perf_counter() >= self._next_s:
            began = time.perf_counter()
            self._draw()
            ended = time.perf_counter()
            self._next_s = ended + (ended - began) / self._SHARE

    def on_fit_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Draw what is not drawn yet."""
        if trainer.is_global_zero:
            self._draw()

    def on_exception(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, exception: BaseException
    ) -> None:
        """Draw what is not drawn yet."""
        if trainer.is_global_zero:
            self._draw()

    def _draw(self) -> None:
        rows = self._curve.rows
        if len(rows) == self._drawn_rows:
            return
        self._drawn_rows = len(rows)
        from vioframe.learning.pictures import draw_curve

        draw_curve(self._path, rows, self._reference, self._beside)
        self._tracker.log_file(self._path, "plots")
