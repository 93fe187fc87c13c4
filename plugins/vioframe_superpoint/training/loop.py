"""One stage of training: from a net and batches to a trained net, in sessions that may be cut short anywhere.

A plain loop, not lightning's: a batch is a function of its iteration, so that all there is to resume is the iteration,
the weights and the state of the optimizer.
"""

import json
import logging
import math
import os
import pickle
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from vioframe.errors import ConfigError, DataError
from vioframe.learning.rows import Row, write_rows
from vioframe.tracking import Tracker
from vioframe_superpoint.net.superpoint import SuperPointNet
from vioframe_superpoint.training.bar import Bar
from vioframe_superpoint.training.data import MakeBatch, loader
from vioframe_superpoint.training.precision import autocast
from vioframe_superpoint.training.schedule import RateOptions, rate_factor
from vioframe_superpoint.training.steps import laid_out

log = logging.getLogger(__name__)

RESUME_FILE = "resume.ckpt"
FORMAT = "vioframe-superpoint-resume-1"

StepLoss = Callable[[SuperPointNet, Mapping[str, Tensor], int], dict[str, Tensor]]
"""(net, batch, iteration) → losses by name, of which ``"loss"`` is minimised."""

_BIASES_BELOW = 2
# May be changed when a training is resumed.
_MAY_CHANGE = frozenset({"iterations", "validate_every"})


@dataclass(slots=True, kw_only=True)
class Progress:
    """How far a stage is; all of it is kept in the resume file.

    Attributes:
        iteration: how many are done.
        seconds: of training so far, over all sessions, validation included.
        best: (rank, iteration) of the best validation, or None.
        rows: of the curve.
    """

    iteration: int = 0
    seconds: float = 0.0
    best: tuple[float, int] | None = None
    rows: list[Row] = field(default_factory=list)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Stage:
    """What is to be done.

    Attributes:
        name: of the stage.
        loss: of a step.
        make: batches by their iteration.
        rate: how steps are taken.
        gradient_clip: largest norm of the gradient; 0 for no limit.
        save_every, validate_every: iterations.
        validate: iteration → figures; ``"rank"``, higher is better, chooses among weights.
        keep: called when the weights are the best so far.
        rate_key: the option of the learning rate, for messages.
        settings: all options that have a bearing on the weights, as plain values; a resumed training has the same.
    """

    name: str
    loss: StepLoss
    make: MakeBatch
    rate: RateOptions
    gradient_clip: float
    save_every: int
    validate_every: int
    validate: Callable[[int], Mapping[str, float]]
    keep: Callable[[Progress, Mapping[str, float]], None]
    rate_key: str
    settings: Mapping[str, object]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Session:
    """Where and for how long.

    Attributes:
        device: of the net.
        precision: ``32`` or ``bf16``.
        workers: processes that make batches.
        folder: of the curve and the resume file.
        tracker: of the run.
        shown: whether to show a bar.
        until: time, as :func:`time.monotonic` counts, at which it ends; None for no limit.
    """

    device: torch.device
    precision: str
    workers: int
    folder: Path
    tracker: Tracker
    shown: bool
    until: float | None

    @property
    def is_over(self) -> bool:
        """Whether the time is."""
        return self.until is not None and time.monotonic() >= self.until


class Loop:
    """Trains one net through one stage.

    Args:
        net: on its device.
        stage: what is to be done.
        session: where and for how long.
    """

    def __init__(self, net: SuperPointNet, stage: Stage, session: Session) -> None:
        self.progress = Progress()
        # Other numbers would come out of other layouts in the last bits; this one is the fastest everywhere.
        self._net = laid_out(net)
        self._stage = stage
        self._session = session
        self._optimizer = _optimizer(net, stage.rate)
        self._factor = rate_factor(stage.rate)
        self._sums: dict[str, Tensor] = {}
        self._steps = 0

    def run(self) -> bool:
        """Train to the end of the stage, or until the time is over; whether it is done.

        Raises:
            ConfigError: the learning rate diverges.
        """
        stage, progress = self._stage, self.progress
        bar = Bar(stage.name, stage.rate.iterations) if self._session.shown else None
        batches = loader(stage.make, range(progress.iteration, stage.rate.iterations), self._session.workers)
        self._net.train()
        began = block = time.perf_counter()
        first = progress.iteration
        try:
            for batch in batches:
                if bar is not None:
                    bar.show(progress.iteration)
                self._step(batch)
                progress.iteration += 1
                if bar is not None:
                    bar.advance(progress.iteration, (progress.iteration - first) / (time.perf_counter() - began))
                done = progress.iteration == stage.rate.iterations
                if progress.iteration % stage.save_every == 0 or done or self._session.is_over:
                    figures = self._end_block(time.perf_counter() - block, last=done)
                    if bar is not None and figures:
                        bar.tell(figures)
                    progress.seconds += time.perf_counter() - block
                    self._save()
                    block = time.perf_counter()
                    if self._session.is_over:
                        break
        finally:
            self._net.eval()
            if bar is not None:
                bar.close()
        return progress.iteration >= stage.rate.iterations

    def resume(self, path: Path) -> None:
        """Go on from a file that :meth:`run` wrote in this stage.

        Raises:
            ConfigError: it was written with other options.
            DataError: it is of another net.
        """
        content = read_resume(path)
        differing = differences(content.get("settings", {}), _plain(self._stage.settings))
        if differing:
            raise ConfigError(
                f"trainer.resume={path} was written with other options: {', '.join(differing)}; give those of the run "
                "that wrote it, or begin anew"
            )
        try:
            self._net.load_state_dict(content["net"])
            self._optimizer.load_state_dict(content["optimizer"])
        except (RuntimeError, ValueError, KeyError) as error:
            first = str(error).strip().splitlines()[0]
            raise DataError(
                f"trainer.resume={path} does not fit this net ({first}): resume with the configuration of the run that "
                "wrote it, or begin anew"
            ) from error
        best = content["best"]
        self.progress = Progress(
            iteration=int(content["iteration"]),
            seconds=float(content["seconds"]),
            best=None if best is None else (float(best[0]), int(best[1])),
            rows=[dict(row) for row in content["rows"]],
        )

    def _step(self, batch: Mapping[str, Tensor]) -> None:
        iteration = self.progress.iteration
        moved = {name: value.to(self._session.device, non_blocking=True) for name, value in batch.items()}
        for group in self._optimizer.param_groups:
            group["lr"] = self._stage.rate.learning_rate * self._factor(iteration)
        with autocast(self._session.device, self._session.precision):
            losses = self._stage.loss(self._net, moved, iteration)
        losses["loss"].backward()  # type: ignore[no-untyped-call]
        if self._stage.gradient_clip:
            nn.utils.clip_grad_norm_(self._net.parameters(), self._stage.gradient_clip)
        self._optimizer.step()
        self._optimizer.zero_grad(set_to_none=True)
        for name, value in losses.items():
            # Kept on the device: asking for its value at every step would make a GPU wait.
            self._sums[name] = self._sums.get(name, torch.zeros((), device=value.device)) + value.detach().float()
        self._steps += 1

    def _end_block(self, elapsed_s: float, *, last: bool) -> dict[str, float]:
        """Write a row of the curve; figures of a validation, if it is time for one."""
        stage, progress = self._stage, self.progress
        row: Row = {"iteration": float(progress.iteration)}
        row |= {name: total.item() / self._steps for name, total in self._sums.items()}
        if not math.isfinite(row["loss"]):
            raise ConfigError(
                f"{stage.rate_key}={stage.rate.learning_rate:g} makes the training diverge: the loss is {row['loss']} "
                f"at iteration {progress.iteration}; choose a smaller one, or clip gradients "
                "(frontend.training.gradient_clip)"
            )
        row["learning_rate"] = float(self._optimizer.param_groups[0]["lr"])
        row["iterations_per_s"] = self._steps / max(elapsed_s, 1e-9)
        self._sums, self._steps = {}, 0
        figures: dict[str, float] = {}
        if progress.iteration % stage.validate_every == 0 or last:
            self._net.eval()
            figures = dict(stage.validate(progress.iteration))
            if progress.best is None or figures["rank"] > progress.best[0]:
                progress.best = (figures["rank"], progress.iteration)
                stage.keep(progress, figures)
            self._net.train()
            row |= {f"validation/{name}": value for name, value in figures.items()}
        progress.rows.append(row)
        write_rows(self._session.folder / f"{stage.name}.csv", progress.rows)
        numbers = {f"{stage.name}/{name}": value for name, value in row.items() if name != "iteration"}
        self._session.tracker.log_metrics(numbers, step=progress.iteration)
        return figures

    def _save(self) -> None:
        """Write beside, then rename: a kill on the way leaves the last one whole."""
        progress = self.progress
        content = {
            "format": FORMAT,
            "stage": self._stage.name,
            "iteration": progress.iteration,
            "seconds": progress.seconds,
            "best": None if progress.best is None else list(progress.best),
            "rows": progress.rows,
            "settings": _plain(self._stage.settings),
            "net": self._net.state_dict(),
            "optimizer": self._optimizer.state_dict(),
        }
        path = self._session.folder / RESUME_FILE
        torch.save(content, path.with_suffix(".partial"))
        os.replace(path.with_suffix(".partial"), path)


def read_resume(path: Path) -> dict[str, Any]:
    """A resume file, read as data.

    Raises:
        DataError: it is not one of a training of SuperPoint, or not whole.
    """
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
        if content["format"] != FORMAT:
            raise KeyError("format")
    except (pickle.UnpicklingError, EOFError, OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
        raise DataError(
            f"trainer.resume={path} is not a whole resume file of frontend=superpoint: begin anew"
        ) from error
    return dict(content)


def differences(stored: Mapping[str, Any], now: Mapping[str, Any], key: str = "frontend.training") -> list[str]:
    """Options that are not as they were, with both values; those that may change, and what was not stored, left out."""
    told: list[str] = []
    for name in sorted(stored.keys() & now.keys() - (_MAY_CHANGE if key == "frontend.training" else frozenset())):
        was, value = stored[name], now[name]
        if isinstance(was, Mapping) and isinstance(value, Mapping):
            told += differences(was, value, f"{key}.{name}")
        elif was != value:
            told.append(f"{key}.{name}={value} (it was {was})")
    return told


def _plain(settings: Mapping[str, object]) -> dict[str, Any]:
    """As a file that is read as data can hold them."""
    return dict(json.loads(json.dumps(settings)))


def _optimizer(net: nn.Module, rate: RateOptions) -> torch.optim.Optimizer:
    """Adam, or AdamW that spares biases and scales."""
    parameters = list(net.parameters())
    groups: list[dict[str, Any]] = [
        {"params": [p for p in parameters if p.ndim >= _BIASES_BELOW], "weight_decay": rate.weight_decay},
        {"params": [p for p in parameters if p.ndim < _BIASES_BELOW], "weight_decay": 0.0},
    ]
    return torch.optim.AdamW(groups, lr=rate.learning_rate)
