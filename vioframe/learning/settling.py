"""A further stage for parts that need longer windows than can be had with images.

An encoder of images learns from many short windows; what remembers from image to image, and what has to know how its
errors add up, learns from long ones, in which the encoder's gradients would cost too much. So the parts are trained
together first, then those with ``settling_pairs`` by themselves, the others staying as they are.
"""

import hashlib
import logging
import pickle
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import torch

from vioframe.data.windows import StoredSequence, WindowIndex
from vioframe.interfaces import Trainable
from vioframe.learning.callbacks import RESUME_FILE, ResumePoint
from vioframe.learning.options import TrainerOptions

log = logging.getLogger(__name__)

FOLDER = "settled"
"""Of this stage's weights and curve, within the run's."""


def settling_options(
    parts: Mapping[str, Trainable],
    trained: Sequence[str],
    training: Sequence[StoredSequence],
    validation: Sequence[StoredSequence],
    options: TrainerOptions,
    *,
    pairs: int,
) -> TrainerOptions | None:
    """How the parts that wish it are trained further; None where there is none, or no longer window.

    Args:
        parts: by slot.
        trained: slots of those that were trained.
        training, validation: recordings.
        options: of the training before.
        pairs: of the windows of the training before.
    """
    wished = {slot: int(getattr(parts[slot], "settling_pairs", None) or 0) for slot in trained}
    slots = [slot for slot in trained if wished[slot]]
    if not slots or not options.settling:
        return None
    longest = [WindowIndex(split, pairs, split="settling").longest_run for split in (training, validation)]
    length = min(max(wished.values()), *longest)
    if length <= pairs:
        return None
    return replace(
        options,
        **{str(name): value for name, value in options.settling.items()},
        train=slots,
        pairs=length,
        resume=None,
        augmentation=options.augmentation.mirror_only(),
    )


def fingerprint(parts: Mapping[str, Trainable]) -> str:
    """Of all weights that this stage begins with, those that stay as they are included."""
    digest = hashlib.sha256()
    for slot, part in parts.items():
        for name, tensor in part.net.state_dict().items():
            digest.update(f"{slot}.{name} {tuple(tensor.shape)}".encode())
            digest.update(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy())
    return digest.hexdigest()


def resume_file(folder: Path, start: str) -> str | None:
    """Where this stage can go on, or None where it has to begin: it did not yet, or with other weights.

    Args:
        folder: of this stage.
        start: :func:`fingerprint` of the weights as they are now.
    """
    path = folder / RESUME_FILE
    if not path.is_file():
        return None
    try:
        before = torch.load(path, map_location="cpu", weights_only=True).get(ResumePoint.START)
    except (OSError, RuntimeError, EOFError, pickle.UnpicklingError):
        before = None
    if before == start:
        return str(path)
    log.warning("%s is of other weights than those trained since: this stage begins anew", path)
    return None
