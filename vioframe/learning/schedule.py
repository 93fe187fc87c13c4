"""The learning rate over the steps."""

import math
from collections.abc import Callable

from vioframe.learning.options import TrainerOptions


def rate_factor(options: TrainerOptions, *, total_steps: int, epoch_steps: int) -> Callable[[int], float]:
    """The factor on ``trainer.learning_rate`` at each step.

    Args:
        options: ``schedule``, ``halve_every`` and ``warmup_steps`` of it.
        total_steps: of the whole training.
        epoch_steps: of one epoch.
    """
    # A warm-up longer than a tenth of a short training would be most of it.
    warmup = min(options.warmup_steps, total_steps // 10)

    def factor(step: int) -> float:
        if step < warmup:
            return (step + 1) / (warmup + 1)
        if options.schedule == "halving":
            return float(0.5 ** (step // (epoch_steps * options.halve_every)))
        if options.schedule == "cosine":
            share = min((step - warmup) / max(total_steps - warmup, 1), 1.0)
            return 0.5 * (1.0 + math.cos(math.pi * share))
        return 1.0

    return factor
