"""A further stage for parts that need longer windows than can be had with images.

An encoder of images learns from many short windows; what remembers from image to image, and what has to know how its
errors add up, learns from long ones, in which the encoder's gradients would cost too much. So the parts are trained
together first, then those with ``settling_pairs`` by themselves, the others staying as they are.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from vioframe.data.windows import StoredSequence, WindowIndex
from vioframe.interfaces import Trainable
from vioframe.learning.options import TrainerOptions

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
    folder: Path,
) -> TrainerOptions | None:
    """How the parts that wish it are trained further; None where there is none, or no longer window.

    Args:
        parts: by slot.
        trained: slots of those that were trained.
        training, validation: recordings.
        options: of the training before.
        pairs: of the windows of the training before.
        folder: of the whole run; where it was resumed, this stage is too.
    """
    wished = {slot: int(getattr(parts[slot], "settling_pairs", None) or 0) for slot in trained}
    slots = [slot for slot in trained if wished[slot]]
    if not slots or not options.settling:
        return None
    longest = [WindowIndex(split, pairs, split="settling").longest_run for split in (training, validation)]
    length = min(max(wished.values()), *longest)
    if length <= pairs:
        return None
    resume = folder / FOLDER / "resume.ckpt"
    return replace(
        options,
        **{str(name): value for name, value in options.settling.items()},
        train=slots,
        pairs=length,
        resume=str(resume) if options.resume is not None and resume.is_file() else None,
        augmentation=options.augmentation.mirror_only(),
    )
