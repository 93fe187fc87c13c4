"""ResNet-50 with torchvision's parameter names.

He, Zhang, Ren, Sun, "Deep Residual Learning for Image Recognition", CVPR 2016. As in torchvision, the stride of a
stage is in the 3 × 3 convolution of its first block, not in the 1 × 1 before it.
"""

import torch
from torch import Tensor, nn

_STAGES = ((3, 64, 1), (4, 128, 2), (6, 256, 2), (3, 512, 2))
"""Blocks, inner channels and stride of each stage."""

_EXPANSION = 4


class Bottleneck(nn.Module):
    """1 × 1, 3 × 3 and 1 × 1 convolutions beside a shortcut."""

    def __init__(self, channels: int, inner: int, stride: int) -> None:
        """Build a block from ``channels`` to four times ``inner``."""
        super().__init__()
        out = inner * _EXPANSION
        self.conv1 = nn.Conv2d(channels, inner, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(inner)
        self.conv2 = nn.Conv2d(inner, inner, 3, stride, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(inner)
        self.conv3 = nn.Conv2d(inner, out, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(out)
        self.relu = nn.ReLU(inplace=True)
        self.downsample: nn.Module | None = None
        if stride != 1 or channels != out:
            self.downsample = nn.Sequential(nn.Conv2d(channels, out, 1, stride, bias=False), nn.BatchNorm2d(out))

    def forward(self, x: Tensor) -> Tensor:
        """(N, 4 inner, H/stride, W/stride) of (N, C, H, W)."""
        shortcut = x if self.downsample is None else self.downsample(x)
        x = self.relu(self.bn1(self.conv1(x)))
        x = self.relu(self.bn2(self.conv2(x)))
        out: Tensor = self.relu(self.bn3(self.conv3(x)) + shortcut)
        return out


class ResNet50(nn.Module):
    """Features of 2048 numbers, or scores of classes."""

    features = 2048
    smallest_px = 1
    first_convolution = "conv1"
    classifier_prefixes = ("fc.",)

    def __init__(self, channels: int = 3, classes: int | None = None) -> None:
        """Build the network.

        Args:
            channels: of the input.
            classes: end in a linear layer with so many scores, as for ImageNet; None ends in the pooled features.
        """
        super().__init__()
        self.conv1 = nn.Conv2d(channels, 64, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        self.relu = nn.ReLU(inplace=True)
        self.maxpool = nn.MaxPool2d(3, 2, 1)
        depth = 64
        for number, (blocks, inner, stride) in enumerate(_STAGES, start=1):
            stage = []
            for block in range(blocks):
                stage.append(Bottleneck(depth, inner, stride if block == 0 else 1))
                depth = inner * _EXPANSION
            self.add_module(f"layer{number}", nn.Sequential(*stage))
        self.fc = nn.Linear(depth, classes) if classes is not None else None

    def forward(self, x: Tensor) -> Tensor:
        """(N, 2048) or (N, classes) of (N, C, H, W)."""
        x = self.maxpool(self.relu(self.bn1(self.conv1(x))))
        for number in range(1, len(_STAGES) + 1):
            x = self.get_submodule(f"layer{number}")(x)
        x = torch.flatten(nn.functional.adaptive_avg_pool2d(x, 1), 1)
        return x if self.fc is None else self.fc(x)
