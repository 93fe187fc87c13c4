"""A net that answers for every pair from that pair and those before it, no further back than a set number."""

from torch import Tensor, nn
from torch.nn import functional


def dilations(frames: int) -> list[int]:
    """Steps of convolutions of two taps that together look at exactly ``frames`` frames."""
    steps, left, step = [], frames - 1, 1
    while left > 0:
        steps.append(min(step, left))
        left -= steps[-1]
        step *= 2
    return steps


class CausalBlock(nn.Module):
    """A dilated convolution of two taps and a layer within each frame, beside a short cut."""

    def __init__(self, channels: int, dilation: int, dropout: float) -> None:
        super().__init__()
        self.past = nn.Conv1d(channels, channels, kernel_size=2, dilation=dilation)
        self.mixing = nn.Conv1d(channels, channels, kernel_size=1)
        self.dropout = nn.Dropout(dropout)
        self._dilation = dilation

    def forward(self, signal: Tensor) -> Tensor:
        """(B, C, S) to the same shape; nothing precedes the first frame."""
        seen = functional.silu(self.past(functional.pad(signal, (self._dilation, 0))))
        mixed: Tensor = signal + self.dropout(self.mixing(seen))
        return mixed


class CausalNet(nn.Module):
    """Frames of numbers to frames of numbers; its first answer, untrained, is zero.

    Args:
        inputs: numbers a frame.
        outputs: numbers a frame.
        channels: width.
        frames: how many frames an answer looks at, its own included.
        dropout: share of what each block adds that is left out in training.
    """

    def __init__(self, inputs: int, outputs: int, *, channels: int, frames: int, dropout: float) -> None:
        super().__init__()
        self.entry = nn.Conv1d(inputs, channels, kernel_size=1)
        self.blocks = nn.Sequential(*(CausalBlock(channels, step, dropout) for step in dilations(frames)))
        self.exit = nn.Conv1d(channels, outputs, kernel_size=1)
        nn.init.zeros_(self.exit.weight)
        if self.exit.bias is not None:
            nn.init.zeros_(self.exit.bias)

    def forward(self, signal: Tensor) -> Tensor:
        """(B, S, inputs) to (B, S, outputs)."""
        answers: Tensor = self.exit(functional.silu(self.blocks(self.entry(signal.transpose(1, 2)))))
        return answers.transpose(1, 2)
