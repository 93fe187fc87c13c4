"""Windows to batches: shuffled and changed the same way in every run with the same seed, however many workers help.

A window's changes are drawn from a generator seeded with (seed, epoch, number of the window), so they depend neither
on which worker cuts it nor on what came before: a run that is resumed sees exactly what it would have seen.
"""

import os
from collections.abc import Iterator

import lightning
import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset, Sampler

from vioframe.data.augmentation import Augmentation
from vioframe.data.windows import TrainingWindow, WindowIndex
from vioframe.learning.batch import WindowBatch, collate

_MOST_WORKERS = 16

Key = tuple[int, int]
"""Epoch, and number of a window."""


class WindowDataset(Dataset[TrainingWindow]):
    """The windows of an index, changed or as they are.

    Args:
        index: where windows begin.
        augmentation: None leaves them as they are.
        seed: of the changes.
    """

    def __init__(self, index: WindowIndex, augmentation: Augmentation | None, seed: int) -> None:
        self._index = index
        self._augmentation = augmentation
        self._seed = seed

    def __len__(self) -> int:
        return len(self._index)

    def __getitem__(self, key: Key) -> TrainingWindow:
        epoch, number = key
        if self._augmentation is None:
            return self._index[number]
        window = None
        if self._augmentation.sensors.active:
            sequence, start, recording = self._index.place(number)
            # Drawn apart, so that the other changes stay what they are without it.
            rng = np.random.default_rng([self._seed, epoch, number, 1])
            window = self._augmentation.sensors.cut(sequence, start, self._index.pairs, recording, rng)
        if window is None:
            window = self._index[number]
        return self._augmentation.apply(window, np.random.default_rng([self._seed, epoch, number]))


class EpochSampler(Sampler[Key]):
    """Numbers of windows with their epoch, in an order of each epoch's own.

    Args:
        windows: how many there are.
        drawn: how many make an epoch; None takes all. Over the epochs all are taken equally often.
        seed: of the order.
        shuffle: False gives them as they are.
        rank, world: which of how many processes asks; all get equally many, the last few being given twice if need be.
    """

    def __init__(
        self, windows: int, *, drawn: int | None, seed: int, shuffle: bool, rank: int = 0, world: int = 1
    ) -> None:
        self._windows = windows
        self._drawn = windows if drawn is None else drawn
        self._seed = seed
        self._shuffle = shuffle
        self._rank = rank
        self._world = world
        self.epoch = 0

    def set_epoch(self, epoch: int) -> None:
        """The epoch that the next iteration is of; lightning calls it."""
        self.epoch = epoch

    def __len__(self) -> int:
        return -(-self._drawn // self._world)

    def __iter__(self) -> Iterator[Key]:
        first = self.epoch * self._drawn
        places = np.arange(first, first + self._drawn)
        if not self._shuffle:
            numbers = places % self._windows
        else:
            # One endless deck after the other: an epoch that is shorter than the data goes on where the last one ended.
            decks = {
                deck: np.random.default_rng([self._seed, int(deck)]).permutation(self._windows)
                for deck in np.unique(places // self._windows)
            }
            numbers = np.array([decks[place // self._windows][place % self._windows] for place in places])
        padded = np.resize(numbers, len(self) * self._world)
        return iter([(self.epoch, int(number)) for number in padded[self._rank :: self._world]])


class WindowData(lightning.LightningDataModule):
    """Loaders of both splits.

    Args:
        training, validation: windows; those of validation are taken in order, unchanged.
        augmentation: of the training windows.
        batch_size: windows in a batch.
        epoch_windows: windows in an epoch; None for all.
        seed: of order and changes.
        workers: processes that cut windows; None: as many as there are cores to spare.
    """

    def __init__(
        self,
        training: WindowIndex,
        validation: WindowIndex,
        *,
        augmentation: Augmentation | None,
        batch_size: int,
        epoch_windows: int | None,
        seed: int,
        workers: int | None,
    ) -> None:
        super().__init__()
        self._training = training
        self._validation = validation
        self._augmentation = augmentation
        self._batch_size = batch_size
        self._epoch_windows = epoch_windows
        self._seed = seed
        spare = len(os.sched_getaffinity(0)) - 1 if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1) - 1
        self._workers = min(spare, _MOST_WORKERS) if workers is None else workers

    def train_dataloader(self) -> DataLoader[TrainingWindow]:
        """Shuffled and changed; each process of several has its share."""
        world = self.trainer.world_size if self.trainer is not None else 1
        rank = self.trainer.global_rank if self.trainer is not None else 0
        sampler = EpochSampler(
            len(self._training), drawn=self._epoch_windows, seed=self._seed, shuffle=True, rank=rank, world=world
        )
        return self._loader(WindowDataset(self._training, self._augmentation, self._seed), sampler, self._batch_size)

    def val_dataloader(self) -> DataLoader[TrainingWindow]:
        """In order; every process sees all of it, so that each knows the whole trajectories."""
        sampler = EpochSampler(len(self._validation), drawn=None, seed=0, shuffle=False)
        # Its windows may be longer, and what is in memory at once should not be more for it.
        further = max(self._validation.pairs - self._training.pairs, 0)
        return self._loader(WindowDataset(self._validation, None, 0), sampler, -(-self._batch_size // (1 + further)))

    def transfer_batch_to_device(self, batch: WindowBatch, device: torch.device, dataloader_idx: int) -> WindowBatch:
        """Move bytes, then make them numbers between 0 and 1 there."""
        return batch.to(device, non_blocking=True).as_float()

    def _loader(self, dataset: WindowDataset, sampler: EpochSampler, batch_size: int) -> DataLoader[TrainingWindow]:
        helped = self._workers > 0
        return DataLoader(
            dataset,
            batch_size=min(batch_size, len(sampler)),
            sampler=sampler,
            collate_fn=collate,
            num_workers=self._workers,
            persistent_workers=helped,
            prefetch_factor=4 if helped else None,
            pin_memory=torch.cuda.is_available(),
            # Of its own: one that it shared with dropout would be moved on by each start of the workers.
            generator=torch.Generator().manual_seed(self._seed),
            worker_init_fn=_calm if helped else None,
        )


def _calm(worker: int) -> None:
    """OpenCV's own threads would only get in each other's way beside other workers."""
    import cv2

    cv2.setNumThreads(0)
    torch.set_num_threads(1)
