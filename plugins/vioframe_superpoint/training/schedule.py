"""The learning rate over the iterations."""

import math
from collections.abc import Callable
from dataclasses import dataclass

# Share of a trapezoid over which the rate falls to zero.
_FALL = 0.2


@dataclass(frozen=True, slots=True, kw_only=True)
class RateOptions:
    """How steps are taken.

    Attributes:
        iterations: of the stage.
        learning_rate: at its highest.
        schedule: ``constant``, ``cosine`` or ``trapezoid``.
        warmup: iterations over which the rate rises.
        weight_decay: of AdamW; 0 is Adam.
    """

    iterations: int
    learning_rate: float
    schedule: str
    warmup: int
    weight_decay: float


def rate_factor(rate: RateOptions) -> Callable[[int], float]:
    """The factor on the learning rate at each iteration."""
    # A warm-up longer than a tenth of a short training would be most of it.
    warmup = min(rate.warmup, rate.iterations // 10)

    def factor(iteration: int) -> float:
        if iteration < warmup:
            return (iteration + 1) / (warmup + 1)
        if rate.schedule == "cosine":
            done = min((iteration - warmup) / max(rate.iterations - warmup, 1), 1.0)
            return 0.5 * (1.0 + math.cos(math.pi * done))
        if rate.schedule == "trapezoid":
            return min(max(1.0 - iteration / rate.iterations, 0.0) / _FALL, 1.0)
        return 1.0

    return factor
