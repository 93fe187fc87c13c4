"""One seed for all that draws."""

import random

import numpy as np
import torch


def seed_everything(seed: int) -> None:
    """Seed Python, numpy's old generator and torch on every device, for whatever draws from these.

    What vioframe itself draws in training comes from generators of its own, seeded with the same number.
    """
    random.seed(seed)
    np.random.seed(seed)
    torch.manual_seed(seed)
