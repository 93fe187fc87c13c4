"""Signals that end a task early."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

INTERRUPTED = 130
"""Exit status after Ctrl-C, as shells have it: 128 + SIGINT."""


@contextmanager
def terminate_like_interrupt() -> Iterator[None]:
    """Treat SIGTERM, which schedulers send, as Ctrl-C: what there is gets saved."""

    def interrupt(signum: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    try:
        before = signal.signal(signal.SIGTERM, interrupt)
    except ValueError:
        # Only the main thread may set handlers; elsewhere a scheduler's signal is not ours to take.
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
