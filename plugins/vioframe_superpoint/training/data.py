"""Batches of the stages: each a pure function of the seed and the number of the iteration."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from vioframe_superpoint.synthetic import SyntheticShapes
from vioframe_superpoint.training.labels import LabelledPictures, cell_classes
from vioframe_superpoint.training.options import PairOptions, ShapesOptions
from vioframe_superpoint.training.pairs import make_pair, stack_pairs

MakeBatch = Callable[[int], Mapping[str, np.ndarray]]
"""Iteration → arrays by name."""

# What tells the random numbers of one purpose from those of another with the same seed.
_SHAPES, _PAIRS, _ORDER = 1, 2, 3


class Batches(Dataset[Mapping[str, Tensor]]):
    """Batches by the number of their iteration.

    Args:
        make: them.
    """

    def __init__(self, make: MakeBatch) -> None:
        self._make = make

    def __getitem__(self, iteration: int) -> Mapping[str, Tensor]:
        return {name: torch.from_numpy(array) for name, array in self._make(iteration).items()}


class ShapeBatches:
    """Drawn shapes and their corners: ``images`` (B, H, W) uint8 and ``classes`` (B, h, w).

    Args:
        options: of the first stage.
        seed: of all.
    """

    def __init__(self, options: ShapesOptions, seed: int) -> None:
        self._size = (int(options.size_px[0]), int(options.size_px[1]))
        self._shapes = SyntheticShapes(size_px=self._size, seed=seed)
        self._batch_size = options.batch_size
        self._seed = seed

    def __call__(self, iteration: int) -> dict[str, np.ndarray]:
        """The batch of an iteration."""
        images, classes = [], []
        for index in range(iteration * self._batch_size, (iteration + 1) * self._batch_size):
            picture, corners = self._shapes.picture(index)
            images.append(picture)
            classes.append(cell_classes(corners, self._size, np.random.default_rng([self._seed, _SHAPES, index])))
        return {"images": np.stack(images), "classes": np.stack(classes)}


class PairBatches:
    """Pairs of views of labelled pictures, as :class:`~vioframe_superpoint.training.pairs.Pair` has them.

    Args:
        pictures: all of which are taken equally often, in an order drawn anew each time.
        options: of the pairs.
        batch_size: pairs.
        seed: of all.
    """

    def __init__(self, pictures: LabelledPictures, options: PairOptions, batch_size: int, seed: int) -> None:
        self._pictures = pictures
        self._options = options
        self._batch_size = batch_size
        self._seed = seed
        self._deck: tuple[int, np.ndarray] = (-1, np.zeros(0, dtype=np.int64))

    def __call__(self, iteration: int) -> Mapping[str, np.ndarray]:
        """The batch of an iteration."""
        pairs = []
        for place in range(iteration * self._batch_size, (iteration + 1) * self._batch_size):
            number = self._drawn(place)
            rng = np.random.default_rng([self._seed, _PAIRS, place])
            pictures = self._pictures
            pair = make_pair(
                pictures.pictures[number], pictures.points[number], rng, self._options, pictures.seen_in(number)
            )
            pairs.append(pair)
        return stack_pairs(pairs)

    def _drawn(self, place: int) -> int:
        round_, position = divmod(place, len(self._pictures))
        if self._deck[0] != round_:
            rng = np.random.default_rng([self._seed, _ORDER, round_])
            self._deck = (round_, rng.permutation(len(self._pictures)))
        return int(self._deck[1][position])


def loader(make: MakeBatch, iterations: Sequence[int], workers: int) -> DataLoader[Any]:
    """The batches of iterations, in order, made by ``workers`` processes beside the training."""
    helped = workers > 0
    return DataLoader(
        Batches(make),
        batch_size=None,
        sampler=iterations,
        num_workers=workers,
        persistent_workers=helped,
        prefetch_factor=4 if helped else None,
        pin_memory=torch.cuda.is_available(),
        generator=torch.Generator().manual_seed(0),
        worker_init_fn=_calm if helped else None,
    )


def _calm(worker: int) -> None:
    """OpenCV's own threads would only get in each other's way beside other workers."""
    import cv2

    cv2.setNumThreads(0)
    torch.set_num_threads(1)
