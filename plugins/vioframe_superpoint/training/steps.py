"""The loss of a step of either stage of training."""

import math
from collections.abc import Mapping
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from vioframe_superpoint.net.superpoint import SuperPointNet
from vioframe_superpoint.training.losses import DUSTBIN, descriptor_loss, detector_loss
from vioframe_superpoint.training.options import DescriptorLoss


class ShapesLoss:
    """Of the first stage: the detector's alone.

    Few cells of a drawing have a corner, and a net learns for long that none has. So those that have one weigh more; to
    a net that has learned this way corners seem more likely than they are, by just that factor, which
    :meth:`take_back` undoes.

    Args:
        corner_weight: of a cell with a corner.
    """

    def __init__(self, corner_weight: float) -> None:
        self._weight = corner_weight

    def __call__(self, net: SuperPointNet, batch: Mapping[str, Tensor], iteration: int) -> dict[str, Tensor]:
        """The loss of ``images`` (B, H, W) uint8 with ``classes`` (B, h, w)."""
        logits = net.detector(net.encoder(as_float(batch["images"])))
        weights = torch.full((DUSTBIN + 1,), self._weight, device=logits.device)
        weights[DUSTBIN] = 1.0
        return {"loss": F.cross_entropy(logits.float(), batch["classes"], weight=weights)}

    def take_back(self, net: SuperPointNet) -> None:
        """Make the answers of a net those of one that learned with a weight of 1."""
        *_, last = (layer for layer in net.detector.modules() if isinstance(layer, nn.Conv2d))
        with torch.no_grad():
            cast(Tensor, last.bias)[:DUSTBIN] -= math.log(self._weight)


class JointLoss:
    """Of the third stage, on a batch of pairs: ``L_p + L_p' + λ L_d``.

    Args:
        options: of the descriptors' loss, with λ.
    """

    def __init__(self, options: DescriptorLoss) -> None:
        self._options = options

    def __call__(self, net: SuperPointNet, batch: Mapping[str, Tensor], iteration: int) -> dict[str, Tensor]:
        """Losses of a batch, as :class:`~vioframe_superpoint.training.pairs.Pair` has it with an axis in front."""
        images = batch["images"]
        pairs = images.shape[0]
        # Both views in one pass, the first ones first.
        logits, maps = net(as_float(images.transpose(0, 1).flatten(0, 1)))
        classes, known = batch["classes"], batch["known"]
        detectors = [detector_loss(logits[at], classes[:, view], known[:, view]) for view, at in _views(pairs)]
        points, overlap = batch["points"], batch["overlap"]
        descriptors = descriptor_loss(
            self._options,
            maps[:pairs],
            maps[pairs:],
            batch["H"],
            points=(points[:, 0], points[:, 1]),
            matched=batch["matched"],
            valid=(overlap[:, 0], overlap[:, 1]),
            seed=iteration,
        )
        detector = detectors[0] + detectors[1]
        loss = detector + self._options.weight * descriptors
        return {"loss": loss, "detector": detector, "descriptors": descriptors}


def laid_out(net: SuperPointNet) -> SuperPointNet:
    """The net with its weights as convolutions read them fastest."""
    for parameter in net.parameters():
        if parameter.ndim == 4:
            parameter.data = parameter.data.contiguous(memory_format=torch.channels_last)
    return net


def as_float(images: Tensor) -> Tensor:
    """Grey images (B, 1, H, W) in [0, 1], as they lie best in memory, of (B, H, W) uint8."""
    return (images[:, None].float() / 255.0).contiguous(memory_format=torch.channels_last)


def _views(pairs: int) -> tuple[tuple[int, slice], tuple[int, slice]]:
    return (0, slice(0, pairs)), (1, slice(pairs, 2 * pairs))
