"""One stage of training, with lightning: from a net and batches to a trained net."""

import logging
import pickle
import signal
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import lightning
import torch

from vioframe.errors import ConfigError, DataError
from vioframe_superpoint.training.data import MakeBatch, loader
from vioframe_superpoint.training.module import StageModule
from vioframe_superpoint.training.watching import KeepBest, Progress, ResumePoint

log = logging.getLogger(__name__)


def fit_stage(
    module: StageModule,
    make: MakeBatch,
    *,
    iterations: int,
    block: int,
    workers: int,
    device: torch.device,
    precision: str,
    gradient_clip: float,
    folder: Path,
    resume: Path | None,
    watchers: tuple[Progress, KeepBest | None, ResumePoint],
) -> None:
    """Train to the end of the stage, or until its time is over.

    Args:
        module: the net and its loss.
        make: its batches.
        iterations: of the stage.
        block: iterations between resume points.
        workers: processes that make batches.
        device: where.
        precision: ``32`` or ``bf16``.
        gradient_clip: largest norm of the gradient; 0 for no limit.
        folder: lightning's.
        resume: file to go on from, or None.
        watchers: in their order.

    Raises:
        ConfigError: the learning rate diverges.
        DataError: the resume file does not fit.
        KeyboardInterrupt: the user stopped it; the resume file is that of the last block.
    """
    precision_name: Any = "bf16-mixed" if precision == "bf16" else "32-true"
    with _quiet():
        trainer = lightning.Trainer(
            accelerator="gpu" if device.type == "cuda" else "cpu",
            devices=1,
            precision=precision_name,
            max_steps=iterations,
            max_epochs=-1,
            gradient_clip_val=gradient_clip or None,
            num_sanity_val_steps=0,
            limit_val_batches=0,
            default_root_dir=folder,
            callbacks=[watcher for watcher in watchers if watcher is not None],
            logger=False,
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            use_distributed_sampler=False,
            benchmark=device.type == "cuda",
        )
    batches = loader(make, iterations, block, workers)
    before = signal.getsignal(signal.SIGINT)
    module.net.train()
    try:
        with _quiet():
            # Weights-only: the file is data, and one that holds anything else is refused.
            trainer.fit(module, batches, ckpt_path=resume, weights_only=True)
    except SystemExit as error:
        # Lightning ends the process after Ctrl-C; what it was called from has things to close first.
        raise KeyboardInterrupt from error
    except torch.cuda.OutOfMemoryError as error:
        raise ConfigError(
            "the batch does not fit into the memory of the GPU: make frontend.training.batch_size smaller"
        ) from error
    except (pickle.UnpicklingError, EOFError, OSError, RuntimeError, KeyError, ValueError) as error:
        # torch says all of these of a file that is cut or of another net; once a step is done they are bugs.
        if resume is None or module.started:
            raise
        first = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise DataError(
            f"trainer.resume={resume} does not fit this net or is not whole ({first}): resume with the configuration "
            "of the run that wrote it, or begin anew"
        ) from error
    finally:
        signal.signal(signal.SIGINT, before)
        module.net.eval()


def stage_of(resume: Path) -> tuple[str, int, int]:
    """The stage that a resume file belongs to, the iterations done, and those of a block.

    Raises:
        DataError: it is not one of a training of SuperPoint.
    """
    try:
        content = torch.load(resume, map_location="cpu", weights_only=True)
        state = content["callbacks"]["Progress"]
        return str(state["stage"]), int(content["global_step"]), int(state["block"])
    except (pickle.UnpicklingError, EOFError, OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
        raise DataError(
            f"trainer.resume={resume} is not a whole resume file of frontend=superpoint: begin anew"
        ) from error


@contextmanager
def _quiet() -> Iterator[None]:
    """Lightning tells at length which devices it found and what it would advise; the task says what matters."""
    chatty = logging.getLogger("lightning.pytorch"), logging.getLogger("lightning.fabric")
    levels = [logger.level for logger in chatty]
    for logger in chatty:
        logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", module=r"lightning\..*")
            yield
    finally:
        for logger, level in zip(chatty, levels, strict=True):
            logger.setLevel(level)
