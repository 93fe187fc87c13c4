"""A net that answers for every frame from that frame and those before it, no further back than a set number."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional


def dilations(frames: int) -> list[int]:
    """Steps of layers of two taps that together look at exactly ``frames`` frames."""
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
        self.dilation = dilation
        self.taps = nn.Linear(2 * channels, channels)
        self.mixing = nn.Linear(channels, channels)
        self.dropout = nn.Dropout(dropout)

    def forward(self, signal: Tensor, past: Tensor) -> Tensor:
        """Of frames (..., C) and those ``dilation`` before them; zero stands for what is before the first."""
        mixed: Tensor = signal + self.dropout(
            self.mixing(functional.silu(self.taps(torch.cat([past, signal], dim=-1))))
        )
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
        self.entry = nn.Linear(inputs, channels)
        self._blocks = [CausalBlock(channels, step, dropout) for step in dilations(frames)]
        self.blocks = nn.ModuleList(self._blocks)
        self.exit = nn.Linear(channels, outputs)
        nn.init.zeros_(self.exit.weight)
        nn.init.zeros_(self.exit.bias)

    @property
    def reaches(self) -> Sequence[int]:
        """How far each block looks back."""
        return [block.dilation for block in self._blocks]

    def forward(self, frames: Tensor) -> Tensor:
        """(B, S, inputs) to (B, S, outputs)."""
        signal = self.entry(frames)
        for block in self._blocks:
            past = functional.pad(signal, (0, 0, block.dilation, 0))[:, : signal.shape[1]]
            signal = block(signal, past)
        answers: Tensor = self.exit(functional.silu(signal))
        return answers

    def step(self, frame: Tensor, memory: "Memory") -> Tensor:
        """The answer (outputs,) to one more frame (inputs,), as :meth:`forward` would give it at the end of the row."""
        signal = self.entry(frame)
        for block, line in zip(self._blocks, memory.lines, strict=True):
            past = line.push(signal)
            signal = block(signal, past)
        answer: Tensor = self.exit(functional.silu(signal))
        return answer


class Memory:
    """What each block of a net has seen of a stream; bounded.

    Args:
        net: whose blocks they are.
    """

    def __init__(self, net: CausalNet) -> None:
        blank = torch.zeros_like(net.exit.weight[0])
        self.lines = [DelayLine(reach, blank) for reach in net.reaches]


class DelayLine:
    """Gives back what came ``reach`` frames ago, at first a blank."""

    def __init__(self, reach: int, blank: Tensor) -> None:
        self._kept = [blank] * reach
        self._next = 0

    def push(self, signal: Tensor) -> Tensor:
        """Take one more frame."""
        past = self._kept[self._next]
        self._kept[self._next] = signal
        self._next = (self._next + 1) % len(self._kept)
        return past
