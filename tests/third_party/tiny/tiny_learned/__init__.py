"""A stranger's learned odometer: what the contract asks for and no more. Importing it imports no torch."""

from typing import ClassVar

import numpy as np

from vioframe.interfaces import IMAGES, METRIC_SCALE, RELATIVE_POSE, VOEstimator
from vioframe.learning import require_torch
from vioframe.types import RelativePose


class TinyVo(VOEstimator):
    """Two grey images, four by three patches each, into a motion."""

    requires: ClassVar[frozenset[str]] = frozenset({IMAGES})
    provides: ClassVar[frozenset[str]] = frozenset({RELATIVE_POSE, METRIC_SCALE})

    def __init__(self, *, width: int, weights: str | None) -> None:
        require_torch("vo=tiny")
        from tiny_learned.net import TinyNet

        self._width = width
        self.needs_training = weights is None
        self.net = TinyNet(width)
        if weights is not None:
            from vioframe.learning.weights import load_weights, locate_weights

            load_weights(locate_weights(weights, "vo.weights"), self, "vo.weights")
        self.net.eval()

    @property
    def context_pairs(self):
        return 1

    @property
    def architecture(self):
        return {"part": "tiny", "width": self._width}

    def forward_batch(self, batch, upstream):
        grey = batch.images.mean(dim=2)
        import torch

        pairs = torch.stack([grey[:, :-1], grey[:, 1:]], dim=2)
        return {"T_prev_cur": self.net(pairs.flatten(0, 1)).unflatten(0, pairs.shape[:2])}

    def loss(self, outputs, batch):
        return {"loss": (outputs["T_prev_cur"] - batch.T_prev_cur).square().mean()}

    def estimate(self, previous, current):
        import torch

        images = [np.atleast_3d(each.frame.images[0]).mean(axis=2) for each in (previous, current)]
        with torch.inference_mode():
            T = self.net(torch.from_numpy(np.stack(images)[None] / 255.0).float())[0]
        return RelativePose(T_prev_cur=T.double().numpy(), covariance=None)
