"""The recordings of a training, decoded into the cache by as many processes as there are cores."""

import multiprocessing
import os
import signal
import sys
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures import wait as wait_for
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.sharedctypes import Synchronized
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, OmegaConf

from vioframe.build import build
from vioframe.data.recording import Dataset
from vioframe.data.sequence_cache import SequenceCache, read_stored
from vioframe.data.windows import check_no_shared_images, check_split
from vioframe.errors import DataError
from vioframe.tasks.progress import share_progress

if TYPE_CHECKING:
    from vioframe.learning.options import TrainerOptions
    from vioframe.learning.training import Split

_SPLITS = ("train", "validation")
# What names a recording; its cache entry must not depend on which others were asked for.
_NAMING = ("sequence", "seed")

_done: "Synchronized[float] | None" = None


@dataclass(frozen=True, slots=True, kw_only=True)
class _Job:
    """One recording to decode, as it travels to another process."""

    data: dict[str, Any]
    split: str
    choice: str
    name: str
    source: str
    cache: SequenceCache


def read_splits(
    config: DictConfig, options: "TrainerOptions", choices: Mapping[str, str], *, shown: bool
) -> "tuple[Split, Split]":
    """Decode the recordings of ``training_data``, or find them decoded.

    Args:
        config: with ``training_data.train`` and ``training_data.validation``, each a data set.
        options: size and place of what is decoded.
        choices: by group, for messages.
        shown: whether to show a progress bar.

    Raises:
        ConfigError: a recording of both splits.
        DataError: a recording that cannot be read or stored.
    """
    from vioframe.learning.training import Split

    width, height = (int(size) for size in options.size_px) if len(options.size_px) == 2 else (0, 0)
    cache = SequenceCache(
        Path(options.cache).expanduser() / "recordings", size_px=(width, height), channels=options.channels
    )
    data = {"training_data": OmegaConf.to_container(config.training_data, resolve=True)}
    choice = choices.get("training_data", "")
    datasets = {split: build(config, f"training_data.{split}", Dataset, choice) for split in _SPLITS}
    check_split(datasets["train"].sequences, datasets["validation"].sequences)
    jobs = [
        _Job(data=data, split=split, choice=choice, name=name, source=_source(data, split), cache=cache)
        for split, dataset in datasets.items()
        for name in dataset.sequences
    ]
    folders = _decode(jobs, shown=shown)
    splits = []
    for split in _SPLITS:
        found = [read_stored(folder) for job, folder in zip(jobs, folders, strict=True) if job.split == split]
        splits.append(Split(sequences=tuple(one for one, _ in found), hashes=tuple(content for _, content in found)))
    check_no_shared_images(splits[0].sequences, splits[1].sequences)
    return splits[0], splits[1]


def _source(data: Mapping[str, Any], split: str) -> str:
    node = {name: value for name, value in data["training_data"][split].items() if name not in _NAMING}
    return OmegaConf.to_yaml(OmegaConf.create(node), sort_keys=True)


def _decode(jobs: Sequence[_Job], *, shown: bool) -> list[Path]:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    # Spawned, not forked: a fork of a process with threads, such as torch's or MLflow's, may hang.
    context = multiprocessing.get_context("spawn")
    done = context.Value("d", 0.0)
    with (
        share_progress(f"reading {len(jobs)} recordings", len(jobs), shown=shown) as advance,
        _pool(min(cores, len(jobs)), context, done) as pool,
    ):
        futures: list[Future[Path]] = [pool.submit(_store, job) for job in jobs]
        waiting = set(futures)
        while waiting:
            ended, waiting = wait_for(waiting, timeout=0.5)
            advance(done.value)
            for future in ended:
                # An error of one ends the others, which cannot help any more.
                future.result()
        return [future.result() for future in futures]


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


def _store(job: _Job) -> Path:
    dataset = build(OmegaConf.create(job.data), f"training_data.{job.split}", Dataset, job.choice)
    recording = dataset.open(job.name)
    total = recording.frame_count + 1
    told = 0

    def advance(frames: int) -> None:
        nonlocal told
        if _done is not None and frames > told:
            with _done.get_lock():
                _done.value += (frames - told) / total
            told = frames

    try:
        folder = job.cache.store(recording, job.source, advance)
    except SystemExit:
        # The pool's own loop would take it for a result.
        os._exit(1)
    advance(total)
    return folder
