"""How far motions are from the truth, and how much a radian weighs against a metre.

All take motion vectors (..., 6), rotation first, and mean over the leading axes.
"""

import torch
from torch import Tensor, nn

from vioframe.errors import ConfigError


def squared_errors(predicted: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Mean squared lengths of the errors of rotation (rad²) and translation (squared units): scalars."""
    squared = (predicted - target).square()
    return squared[..., :3].sum(-1).mean(), squared[..., 3:].sum(-1).mean()


class LearnedWeights(nn.Module):
    """Both errors weighed by variances that are learned with the net.

    ``L = L_t exp(−s_t) + s_t + L_r exp(−s_r) + s_r`` (Kendall & Cipolla, CVPR 2017, eq. 4; Zhao et al. 2022, eq. 7).
    At its minimum each s is the logarithm of its error, and the loss 2 + log L_t + log L_r: negative values are good
    news. A weight decay that reaches the two draws them to zero; the optimiser ``adamw`` of the trainer spares them.
    """

    def __init__(self, *, log_variance_translation: float = 0.0, log_variance_rotation: float = -3.0) -> None:
        """Start from these log-variances; the defaults are the paper's."""
        super().__init__()
        self.log_variance_translation = nn.Parameter(torch.tensor(float(log_variance_translation)))
        self.log_variance_rotation = nn.Parameter(torch.tensor(float(log_variance_rotation)))

    def forward(self, predicted: Tensor, target: Tensor) -> dict[str, Tensor]:
        """``loss``, which is minimised, and what it is made of, for the record."""
        rotation, translation = squared_errors(predicted, target)
        s_r, s_t = self.log_variance_rotation, self.log_variance_translation
        loss = translation * torch.exp(-s_t) + s_t + rotation * torch.exp(-s_r) + s_r
        return {
            "loss": loss,
            "rotation": rotation.detach(),
            "translation": translation.detach(),
            "log_variance_rotation": s_r.detach().clone(),
            "log_variance_translation": s_t.detach().clone(),
        }


class FixedWeights(nn.Module):
    """``L = L_t + κ L_r``: the fixed 1 : 100 of TSVO's comparison, and DeepVO's loss (eq. 11, κ = 100)."""

    def __init__(self, *, rotation_weight: float = 100.0) -> None:
        """Take κ, squared units of translation per rad².

        Raises:
            ConfigError: not positive.
        """
        super().__init__()
        if not rotation_weight > 0.0:
            raise ConfigError(f"the weight of rotation must be positive, got {rotation_weight}")
        self.rotation_weight = rotation_weight

    def forward(self, predicted: Tensor, target: Tensor) -> dict[str, Tensor]:
        """``loss``, which is minimised, and what it is made of, for the record."""
        rotation, translation = squared_errors(predicted, target)
        return {
            "loss": translation + self.rotation_weight * rotation,
            "rotation": rotation.detach(),
            "translation": translation.detach(),
        }


class GaussianLikelihood(nn.Module):
    """For a net that states variances: ``½ Σ (e² exp(−s) + s)`` over the six numbers, so that errors set each s."""

    def forward(self, predicted: Tensor, target: Tensor, log_variances: Tensor) -> dict[str, Tensor]:
        """``loss``, which is minimised, and the plain errors, for the record."""
        rotation, translation = squared_errors(predicted, target)
        squared = (predicted - target).square()
        return {
            "loss": 0.5 * (squared * torch.exp(-log_variances) + log_variances).sum(-1).mean(),
            "rotation": rotation.detach(),
            "translation": translation.detach(),
        }
