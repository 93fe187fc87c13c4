"""GoogLeNet with torchvision's parameter names, without its auxiliary classifiers.

Szegedy et al., "Going Deeper with Convolutions", CVPR 2015. As in torchvision: batch normalisation after each
convolution, and 3 × 3 kernels where the paper has 5 × 5 (its ImageNet weights were trained so).
"""

import torch
from torch import Tensor, nn

_BLOCKS = {
    "inception3a": (192, 64, 96, 128, 16, 32, 32),
    "inception3b": (256, 128, 128, 192, 32, 96, 64),
    "inception4a": (480, 192, 96, 208, 16, 48, 64),
    "inception4b": (512, 160, 112, 224, 24, 64, 64),
    "inception4c": (512, 128, 128, 256, 24, 64, 64),
    "inception4d": (512, 112, 144, 288, 32, 64, 64),
    "inception4e": (528, 256, 160, 320, 32, 128, 128),
    "inception5a": (832, 256, 160, 320, 32, 128, 128),
    "inception5b": (832, 384, 192, 384, 48, 128, 128),
}
"""Input channels, then those of the branches (table 1 of the paper): 1×1, 3×3 reduce, 3×3, 5×5 reduce, 5×5, pool."""


class BasicConv2d(nn.Module):
    """Convolution, batch normalisation, ReLU; shared by both Inception networks."""

    def __init__(
        self,
        channels: int,
        out: int,
        kernel: int | tuple[int, int],
        stride: int = 1,
        padding: int | tuple[int, int] = 0,
    ) -> None:
        """Build the three."""
        super().__init__()
        self.conv = nn.Conv2d(channels, out, kernel, stride, padding, bias=False)
        self.bn = nn.BatchNorm2d(out, eps=0.001)

    def forward(self, x: Tensor) -> Tensor:
        """(N, out, H', W') of (N, C, H, W)."""
        return nn.functional.relu(self.bn(self.conv(x)), inplace=True)


class Inception(nn.Module):
    """Four branches side by side."""

    def __init__(self, channels: int, one: int, three_in: int, three: int, five_in: int, five: int, pool: int) -> None:
        """Build the branches with the channel counts of one row of the table."""
        super().__init__()
        self.branch1 = BasicConv2d(channels, one, 1)
        self.branch2 = nn.Sequential(BasicConv2d(channels, three_in, 1), BasicConv2d(three_in, three, 3, padding=1))
        self.branch3 = nn.Sequential(BasicConv2d(channels, five_in, 1), BasicConv2d(five_in, five, 3, padding=1))
        self.branch4 = nn.Sequential(nn.MaxPool2d(3, 1, 1, ceil_mode=True), BasicConv2d(channels, pool, 1))

    def forward(self, x: Tensor) -> Tensor:
        """The branches' maps one after the other, of the size of (N, C, H, W)."""
        return torch.cat([self.branch1(x), self.branch2(x), self.branch3(x), self.branch4(x)], 1)


class GoogLeNet(nn.Module):
    """Features of 1024 numbers, or scores of classes."""

    features = 1024
    smallest_px = 1
    first_convolution = "conv1.conv"
    classifier_prefixes = ("fc.", "aux1.", "aux2.")

    def __init__(self, channels: int = 3, classes: int | None = None) -> None:
        """Build the network.

        Args:
            channels: of the input.
            classes: end in a linear layer with so many scores, as for ImageNet; None ends in the pooled features.
        """
        super().__init__()
        self.conv1 = BasicConv2d(channels, 64, 7, 2, 3)
        self.maxpool1 = nn.MaxPool2d(3, 2, ceil_mode=True)
        self.conv2 = BasicConv2d(64, 64, 1)
        self.conv3 = BasicConv2d(64, 192, 3, padding=1)
        self.maxpool2 = nn.MaxPool2d(3, 2, ceil_mode=True)
        for name, row in _BLOCKS.items():
            self.add_module(name, Inception(*row))
        self.maxpool3 = nn.MaxPool2d(3, 2, ceil_mode=True)
        self.maxpool4 = nn.MaxPool2d(2, 2, ceil_mode=True)
        self.dropout = nn.Dropout(0.2)
        self.fc = nn.Linear(self.features, classes) if classes is not None else None

    def forward(self, x: Tensor) -> Tensor:
        """(N, 1024) or (N, classes) of (N, C, H, W)."""
        x = self.maxpool1(self.conv1(x))
        x = self.maxpool2(self.conv3(self.conv2(x)))
        for name in _BLOCKS:
            if name == "inception4a":
                x = self.maxpool3(x)
            elif name == "inception5a":
                x = self.maxpool4(x)
            x = self.get_submodule(name)(x)
        x = torch.flatten(nn.functional.adaptive_avg_pool2d(x, 1), 1)
        return x if self.fc is None else self.fc(self.dropout(x))
