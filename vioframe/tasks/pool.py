"""Work on recordings, shared by as many processes as there are cores, with one progress bar for all."""

import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures import wait as wait_for
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing.sharedctypes import Synchronized
from typing import Any, TypeVar

from vioframe.errors import DataError
from vioframe.tasks.progress import share_progress

Job = TypeVar("Job")
Result = TypeVar("Result")

_done: "Synchronized[float] | None" = None


def in_processes(
    work: Callable[[Job], Result], jobs: Sequence[Job], *, title: str, shown: bool, most: int | None = None
) -> list[Result]:
    """Do each job in a process of a pool; the results in the order of the jobs.

    Args:
        work: a function that other processes can import; it tells by :func:`telling` how far it is.
        jobs: as they travel to other processes.
        title: of the progress bar.
        shown: whether there is one.
        most: processes; None: as many as there are cores.

    Raises:
        DataError: a process was ended from outside.
    """
    if not jobs:
        return []
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    # Spawned, not forked: a fork of a process with threads, such as torch's or MLflow's, may hang.
    context = multiprocessing.get_context("spawn")
    done = context.Value("d", 0.0)
    with (
        share_progress(title, len(jobs), shown=shown) as advance,
        _pool(min(most or cores, len(jobs)), context, done) as pool,
    ):
        futures: list[Future[Result]] = [pool.submit(_guarded, work, job) for job in jobs]
        waiting = set(futures)
        while waiting:
            ended, waiting = wait_for(waiting, timeout=0.5)
            advance(done.value)
            for future in ended:
                # An error of one ends the others, which cannot help any more.
                future.result()
        return [future.result() for future in futures]


def telling(total: int) -> Callable[[int], None]:
    """In a process of the pool: takes how many of ``total`` steps of a job are done."""
    told = 0

    def advance(steps: int) -> None:
        nonlocal told
        if _done is not None and steps > told:
            with _done.get_lock():
                _done.value += (steps - told) / total
            told = steps

    return advance


@contextmanager
def _pool(processes: int, context: Any, done: "Synchronized[float]") -> Iterator[ProcessPoolExecutor]:
    before = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(processes, mp_context=context, initializer=_share, initargs=(done,))
    try:
        yield pool
    except BaseException as error:
        # Nobody wants what they are busy with any more.
        for process in set(multiprocessing.active_children()) - before:
            process.terminate()
        pool.shutdown(wait=False, cancel_futures=True)
        if isinstance(error, BrokenProcessPool):
            raise DataError(
                "a process that was decoding recordings was ended from outside, for want of memory perhaps: free some, "
                "or allow it fewer cores (taskset)"
            ) from error
        raise
    pool.shutdown()


def _share(done: "Synchronized[float]") -> None:
    """In a process of the pool: where to tell how far it is, and no threads beside those of the other processes."""
    global _done
    import cv2

    _done = done
    # Ended on the way, it takes its unfinished folder with it.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    # Ctrl-C reaches all processes of a terminal; the first one ends the others.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)


def _guarded(work: Callable[[Job], Result], job: Job) -> Result:
    try:
        return work(job)
    except SystemExit:
        # The pool's own loop would take it for a result.
        os._exit(1)
