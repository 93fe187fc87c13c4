"""Lightning run quietly, and what it and torch raise as this package's own errors."""

import logging
import signal
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from lightning.fabric.utilities.exceptions import MisconfigurationException

from vioframe.errors import ConfigError
from vioframe.learning.options import TrainerOptions


@contextmanager
def running(options: TrainerOptions) -> Iterator[None]:
    """Ctrl-C and a GPU that is full as what callers can tell, while lightning runs; it is quiet."""
    before = signal.getsignal(signal.SIGINT)
    try:
        with quiet():
            yield
    except SystemExit as error:
        # Lightning ends the process after Ctrl-C; what it was called from has things to close first.
        raise KeyboardInterrupt from error
    except torch.cuda.OutOfMemoryError as error:
        raise ConfigError(
            f"trainer.batch_size={options.batch_size} at trainer.size_px={list(options.size_px)} does not fit into the "
            "memory of the GPU: make one of them smaller"
        ) from error
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def told(options: str) -> Iterator[None]:
    """What lightning finds wrong with the options, as one sentence that names them."""
    try:
        yield
    except MisconfigurationException as error:
        raise ConfigError(f"{options}: {str(error).strip().splitlines()[0]}") from error


@contextmanager
def quiet() -> Iterator[None]:
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
