"""One LightningModule that trains any chain of Trainable parts."""

from collections.abc import Mapping, Sequence
from typing import Any

import lightning
import numpy as np
import torch
from torch import Tensor, nn

from vioframe.checks import Array
from vioframe.data.windows import StoredSequence
from vioframe.errors import ConfigError, DataError
from vioframe.interfaces import Trainable
from vioframe.learning.batch import WindowBatch
from vioframe.learning.options import TrainerOptions
from vioframe.learning.schedule import rate_factor
from vioframe.learning.scoring import Score, score_motions

MOTION = "T_prev_cur"
"""What a part calls the motion of the camera that it predicts."""


class TrainingModule(lightning.LightningModule):
    """Runs the parts in order, adds their losses, and scores the motion that the last one predicts.

    Args:
        parts: by slot, in the order of the pipeline.
        options: of the training.
        validation: recordings that validation batches are cut from.
        reference: score of what stands beside the parts, for the ranking: of constant motion, or of the VO alone.

    Attributes:
        score: of the last validation, or None.
        started: whether a step was begun, in this process.

    Raises:
        ConfigError: ``trainer.train`` names a slot that has nothing to train.
    """

    def __init__(
        self,
        parts: Mapping[str, Trainable],
        options: TrainerOptions,
        validation: Sequence[StoredSequence],
        reference: Score,
    ) -> None:
        super().__init__()
        chosen = list(parts) if options.train is None else list(options.train)
        odd = [slot for slot in chosen if slot not in parts]
        if odd or not chosen:
            raise ConfigError(
                f"trainer.train={chosen} must name parts that can be trained: {', '.join(parts) or 'there is none'}"
            )
        self.nets = nn.ModuleDict({slot: part.net for slot, part in parts.items()})
        self.score: Score | None = None
        self.started = False
        self._parts = dict(parts)
        self._options = options
        self._chosen = chosen
        self._validation = tuple(validation)
        self._reference = reference
        self._predicted: list[Array] = []
        self._answered: list[np.ndarray] = []
        for slot, net in self.nets.items():
            net.requires_grad_(slot in chosen)
        if not any(parameter.requires_grad for parameter in self.nets.parameters()):
            raise ConfigError(f"trainer.train={chosen}: these parts have no weights to train; choose one that has")

    def run_parts(self, batch: WindowBatch) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """What all parts return, by name, and their losses as ``slot/name``, with the sum as ``loss``.

        Where the batch brings what a VO answered, that stands in for the parts before the first one: ``"T_prev_cur"``,
        ``"covariance"`` and ``"valid"``.

        Raises:
            ConfigError: no part that is trained has a loss.
        """
        known: dict[str, Tensor] = {}
        if batch.vo is not None:
            known = {MOTION: batch.vo.T_prev_cur, "covariance": batch.vo.covariance, "valid": batch.vo.valid}
        losses: dict[str, Tensor] = {}
        total: Tensor | None = None
        for slot, part in self._parts.items():
            outputs = part.forward_batch(batch, known)
            known.update(outputs)
            for name, value in part.loss(outputs, batch).items():
                losses[f"{slot}/{name}"] = value
                if name == "loss":
                    total = value if total is None else total + value
        if total is None or (not total.requires_grad and torch.is_grad_enabled()):
            raise ConfigError(
                f"trainer.train={self._chosen}: no part has a loss that depends on what is to be trained; train the "
                "part that estimates the motion too"
            )
        return known, {"loss": total, **losses}

    def on_train_epoch_start(self) -> None:
        """Seed dropout by the epoch, so that a resumed run drops what it would have dropped."""
        self.started = True
        torch.manual_seed(self._options.seed + 1_000_003 * (self.current_epoch + 1) + self.global_rank)
        for slot, net in self.nets.items():
            # A frozen net stays as it answers in use: no dropout, no new statistics.
            net.train(slot in self._chosen)

    def training_step(self, batch: WindowBatch, batch_idx: int) -> dict[str, Tensor]:
        """One step's losses."""
        _, losses = self.run_parts(batch)
        return {name: value if name == "loss" else value.detach() for name, value in losses.items()}

    def on_train_batch_end(self, outputs: Any, batch: Any, batch_idx: int) -> None:
        """Have validated what a training ends with, whatever ``validate_every`` says."""
        if self.trainer.should_stop or self.current_epoch + 1 == self.trainer.max_epochs:
            self.trainer.check_val_every_n_epoch = 1

    def on_validation_epoch_start(self) -> None:
        """Forget the predictions of the last validation."""
        self._predicted = [np.tile(np.eye(4), (len(sequence) - 1, 1, 1)) for sequence in self._validation]
        self._answered = [np.zeros(len(sequence) - 1, dtype=np.bool_) for sequence in self._validation]

    def validation_step(self, batch: WindowBatch, batch_idx: int) -> dict[str, Tensor]:
        """Keep the motions that are predicted; return the losses."""
        known, losses = self.run_parts(batch)
        if MOTION not in known:
            raise ConfigError(f"no part of {', '.join(self._parts)} predicts {MOTION}, so there is nothing to validate")
        if known[MOTION].dtype not in (torch.float32, torch.float64):
            raise DataError(
                f"{MOTION} comes as {known[MOTION].dtype}, in which a trajectory cannot be chained: the part must "
                "compute motions in float32 (output.float()) also where trainer.precision is lower"
            )
        motions = known[MOTION].detach().to("cpu", torch.float64).numpy()
        if motions.ndim != 4 or motions.shape[1] > batch.pairs:
            raise DataError(
                f"{MOTION} must have shape (B, at most {batch.pairs}, 4, 4), got {tuple(known[MOTION].shape)}"
            )
        first = batch.pairs - motions.shape[1]
        for recording, start, predicted in zip(batch.recording.tolist(), batch.start.tolist(), motions, strict=True):
            covered = np.arange(start + first, start + batch.pairs)
            # Windows come in order: what an earlier one has answered it has answered with more to look back at.
            new = ~self._answered[recording][covered]
            self._predicted[recording][covered[new]] = predicted[new]
            self._answered[recording][covered] = True
        return losses

    def on_validation_epoch_end(self) -> None:
        """Score the trajectories that the predictions make."""
        self.score = score_motions(
            self._validation,
            self._predicted,
            self._answered,
            lengths_m=[float(length) for length in self._options.segment_lengths_m],
            step=self._options.segment_step,
        )

    @property
    def rank_value(self) -> float:
        """What checkpoints are ranked by, less is better: the last score relative to the reference's."""
        return float("inf") if self.score is None else self.score.relative_to(self._reference)

    def trajectories(self) -> list[tuple[StoredSequence, Array, np.ndarray]]:
        """Each validation recording with its predicted motions and where there are any, of the last validation."""
        return list(zip(self._validation, self._predicted, self._answered, strict=True))

    def configure_optimizers(self) -> Any:
        """Adam or AdamW over what is trained, with the schedule, which moves at every step."""
        parameters = [(name, each) for name, each in self.nets.named_parameters() if each.requires_grad]
        decay = self._options.weight_decay
        optimizer: torch.optim.Optimizer
        if self._options.optimizer == "adam":
            optimizer = torch.optim.Adam(
                [each for _, each in parameters], lr=self._options.learning_rate, weight_decay=decay
            )
        else:
            # Decay is meant to keep maps from growing; on biases, scales and the weights of a loss it is only a bias.
            groups = [
                {"params": [each for _, each in parameters if each.ndim > 1], "weight_decay": decay},
                {"params": [each for _, each in parameters if each.ndim <= 1], "weight_decay": 0.0},
            ]
            optimizer = torch.optim.AdamW(groups, lr=self._options.learning_rate)
        total = max(int(self.trainer.estimated_stepping_batches), 1)
        factor = rate_factor(self._options, total_steps=total, epoch_steps=max(total // self._options.max_epochs, 1))
        scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, factor)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}
