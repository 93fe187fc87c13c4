"""Inception v3 with torchvision's parameter names, without its auxiliary classifier.

Szegedy et al., "Rethinking the Inception Architecture for Computer Vision", CVPR 2016.
"""

import torch
from torch import Tensor, nn
from torch.nn.functional import adaptive_avg_pool2d, avg_pool2d, max_pool2d

from vioframe_tsvo.net.googlenet import BasicConv2d

_ROW, _COLUMN = (1, 7), (7, 1)
_ROW_PADDING, _COLUMN_PADDING = (0, 3), (3, 0)


class InceptionA(nn.Module):
    """1×1, 5×5, two 3×3 and pool side by side."""

    def __init__(self, channels: int, pool: int) -> None:
        """Build from ``channels`` to 224 + ``pool``."""
        super().__init__()
        self.branch1x1 = BasicConv2d(channels, 64, 1)
        self.branch5x5_1 = BasicConv2d(channels, 48, 1)
        self.branch5x5_2 = BasicConv2d(48, 64, 5, padding=2)
        self.branch3x3dbl_1 = BasicConv2d(channels, 64, 1)
        self.branch3x3dbl_2 = BasicConv2d(64, 96, 3, padding=1)
        self.branch3x3dbl_3 = BasicConv2d(96, 96, 3, padding=1)
        self.branch_pool = BasicConv2d(channels, pool, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Maps of the size of (N, C, H, W)."""
        five = self.branch5x5_2(self.branch5x5_1(x))
        double = self.branch3x3dbl_3(self.branch3x3dbl_2(self.branch3x3dbl_1(x)))
        return torch.cat([self.branch1x1(x), five, double, self.branch_pool(avg_pool2d(x, 3, 1, 1))], 1)


class InceptionB(nn.Module):
    """Halves the maps: 3×3, two 3×3 and pool side by side."""

    def __init__(self, channels: int) -> None:
        """Build from ``channels`` to 480 more."""
        super().__init__()
        self.branch3x3 = BasicConv2d(channels, 384, 3, 2)
        self.branch3x3dbl_1 = BasicConv2d(channels, 64, 1)
        self.branch3x3dbl_2 = BasicConv2d(64, 96, 3, padding=1)
        self.branch3x3dbl_3 = BasicConv2d(96, 96, 3, 2)

    def forward(self, x: Tensor) -> Tensor:
        """Maps of about half the size of (N, C, H, W)."""
        double = self.branch3x3dbl_3(self.branch3x3dbl_2(self.branch3x3dbl_1(x)))
        return torch.cat([self.branch3x3(x), double, max_pool2d(x, 3, 2)], 1)


class InceptionC(nn.Module):
    """7×7 kernels as rows and columns."""

    def __init__(self, channels: int, inner: int) -> None:
        """Build from ``channels`` to 768, with ``inner`` channels between."""
        super().__init__()
        self.branch1x1 = BasicConv2d(channels, 192, 1)
        self.branch7x7_1 = BasicConv2d(channels, inner, 1)
        self.branch7x7_2 = BasicConv2d(inner, inner, _ROW, padding=_ROW_PADDING)
        self.branch7x7_3 = BasicConv2d(inner, 192, _COLUMN, padding=_COLUMN_PADDING)
        self.branch7x7dbl_1 = BasicConv2d(channels, inner, 1)
        self.branch7x7dbl_2 = BasicConv2d(inner, inner, _COLUMN, padding=_COLUMN_PADDING)
        self.branch7x7dbl_3 = BasicConv2d(inner, inner, _ROW, padding=_ROW_PADDING)
        self.branch7x7dbl_4 = BasicConv2d(inner, inner, _COLUMN, padding=_COLUMN_PADDING)
        self.branch7x7dbl_5 = BasicConv2d(inner, 192, _ROW, padding=_ROW_PADDING)
        self.branch_pool = BasicConv2d(channels, 192, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Maps of the size of (N, C, H, W)."""
        seven = self.branch7x7_3(self.branch7x7_2(self.branch7x7_1(x)))
        double = self.branch7x7dbl_3(self.branch7x7dbl_2(self.branch7x7dbl_1(x)))
        double = self.branch7x7dbl_5(self.branch7x7dbl_4(double))
        return torch.cat([self.branch1x1(x), seven, double, self.branch_pool(avg_pool2d(x, 3, 1, 1))], 1)


class InceptionD(nn.Module):
    """Halves the maps: 3×3, 7×7 with 3×3, and pool side by side."""

    def __init__(self, channels: int) -> None:
        """Build from ``channels`` to 512 more."""
        super().__init__()
        self.branch3x3_1 = BasicConv2d(channels, 192, 1)
        self.branch3x3_2 = BasicConv2d(192, 320, 3, 2)
        self.branch7x7x3_1 = BasicConv2d(channels, 192, 1)
        self.branch7x7x3_2 = BasicConv2d(192, 192, _ROW, padding=_ROW_PADDING)
        self.branch7x7x3_3 = BasicConv2d(192, 192, _COLUMN, padding=_COLUMN_PADDING)
        self.branch7x7x3_4 = BasicConv2d(192, 192, 3, 2)

    def forward(self, x: Tensor) -> Tensor:
        """Maps of about half the size of (N, C, H, W)."""
        three = self.branch3x3_2(self.branch3x3_1(x))
        seven = self.branch7x7x3_4(self.branch7x7x3_3(self.branch7x7x3_2(self.branch7x7x3_1(x))))
        return torch.cat([three, seven, max_pool2d(x, 3, 2)], 1)


class InceptionE(nn.Module):
    """3×3 kernels fanned out into a row and a column."""

    def __init__(self, channels: int) -> None:
        """Build from ``channels`` to 2048."""
        super().__init__()
        self.branch1x1 = BasicConv2d(channels, 320, 1)
        self.branch3x3_1 = BasicConv2d(channels, 384, 1)
        self.branch3x3_2a = BasicConv2d(384, 384, (1, 3), padding=(0, 1))
        self.branch3x3_2b = BasicConv2d(384, 384, (3, 1), padding=(1, 0))
        self.branch3x3dbl_1 = BasicConv2d(channels, 448, 1)
        self.branch3x3dbl_2 = BasicConv2d(448, 384, 3, padding=1)
        self.branch3x3dbl_3a = BasicConv2d(384, 384, (1, 3), padding=(0, 1))
        self.branch3x3dbl_3b = BasicConv2d(384, 384, (3, 1), padding=(1, 0))
        self.branch_pool = BasicConv2d(channels, 192, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Maps of the size of (N, C, H, W)."""
        three = self.branch3x3_1(x)
        double = self.branch3x3dbl_2(self.branch3x3dbl_1(x))
        return torch.cat(
            [
                self.branch1x1(x),
                self.branch3x3_2a(three),
                self.branch3x3_2b(three),
                self.branch3x3dbl_3a(double),
                self.branch3x3dbl_3b(double),
                self.branch_pool(avg_pool2d(x, 3, 1, 1)),
            ],
            1,
        )


class InceptionV3(nn.Module):
    """Features of 2048 numbers, or scores of classes; no padding in the stem, hence a smallest image."""

    features = 2048
    smallest_px = 75
    first_convolution = "Conv2d_1a_3x3.conv"
    classifier_prefixes = ("fc.", "AuxLogits.")

    def __init__(self, channels: int = 3, classes: int | None = None) -> None:
        """Build the network.

        Args:
            channels: of the input.
            classes: end in a linear layer with so many scores, as for ImageNet; None ends in the pooled features.
        """
        super().__init__()
        self.Conv2d_1a_3x3 = BasicConv2d(channels, 32, 3, 2)
        self.Conv2d_2a_3x3 = BasicConv2d(32, 32, 3)
        self.Conv2d_2b_3x3 = BasicConv2d(32, 64, 3, padding=1)
        self.maxpool1 = nn.MaxPool2d(3, 2)
        self.Conv2d_3b_1x1 = BasicConv2d(64, 80, 1)
        self.Conv2d_4a_3x3 = BasicConv2d(80, 192, 3)
        self.maxpool2 = nn.MaxPool2d(3, 2)
        self.Mixed_5b = InceptionA(192, 32)
        self.Mixed_5c = InceptionA(256, 64)
        self.Mixed_5d = InceptionA(288, 64)
        self.Mixed_6a = InceptionB(288)
        self.Mixed_6b = InceptionC(768, 128)
        self.Mixed_6c = InceptionC(768, 160)
        self.Mixed_6d = InceptionC(768, 160)
        self.Mixed_6e = InceptionC(768, 192)
        self.Mixed_7a = InceptionD(768)
        self.Mixed_7b = InceptionE(1280)
        self.Mixed_7c = InceptionE(2048)
        self.dropout = nn.Dropout(0.5)
        self.fc = nn.Linear(self.features, classes) if classes is not None else None

    def forward(self, x: Tensor) -> Tensor:
        """(N, 2048) or (N, classes) of (N, C, H, W)."""
        x = self.maxpool1(self.Conv2d_2b_3x3(self.Conv2d_2a_3x3(self.Conv2d_1a_3x3(x))))
        x = self.maxpool2(self.Conv2d_4a_3x3(self.Conv2d_3b_1x1(x)))
        x = self.Mixed_5d(self.Mixed_5c(self.Mixed_5b(x)))
        x = self.Mixed_6e(self.Mixed_6d(self.Mixed_6c(self.Mixed_6b(self.Mixed_6a(x)))))
        x = self.Mixed_7c(self.Mixed_7b(self.Mixed_7a(x)))
        x = torch.flatten(adaptive_avg_pool2d(x, 1), 1)
        return x if self.fc is None else self.fc(self.dropout(x))
