"""What the encoders and heads are built of."""

from torch import nn


def convolution(
    inputs: int, outputs: int, kernel: int = 3, *, stride: int = 1, groups: int = 1, active: nn.Module | None = None
) -> nn.Sequential:
    """A convolution that keeps the size (up to its stride), batch normalisation, and an activation or none.

    Args:
        inputs: channels.
        outputs: channels.
        kernel: odd side.
        stride: of 2 it halves an even size.
        groups: as many as channels make it depthwise.
        active: the activation.
    """
    layers = [
        nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, groups=groups, bias=False),
        nn.BatchNorm2d(outputs),
    ]
    return nn.Sequential(*layers) if active is None else nn.Sequential(*layers, active)


def divisible(channels: float, by: int) -> int:
    """Channels rounded to a multiple, by at most a tenth down (Sandler et al.'s and Han et al.'s code alike)."""
    rounded = max(by, int(channels + by / 2) // by * by)
    return rounded + by if rounded < 0.9 * channels else rounded
