"""The net alone."""

import torch
from torch import nn


class TinyNet(nn.Module):
    """(B, 2, H, W) in [0, 1] into motions (B, 4, 4)."""

    def __init__(self, width):
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(2, width, 5, 4, 2),
            nn.ReLU(),
            nn.AdaptiveAvgPool2d((3, 4)),
            nn.Flatten(),
            nn.Linear(12 * width, 6),
        )

    def forward(self, images):
        tangent = self.layers(images)
        zero = torch.zeros_like(tangent[:, 0])
        x, y, z = 0.1 * tangent[:, 0], 0.1 * tangent[:, 1], 0.1 * tangent[:, 2]
        skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
        top = torch.cat([torch.linalg.matrix_exp(skew), tangent[:, 3:, None]], dim=2)
        bottom = torch.tensor([0.0, 0.0, 0.0, 1.0], device=images.device).expand(len(images), 1, 4)
        return torch.cat([top, bottom], dim=1)
