"""An LSTM layer with ReLU in place of tanh, at the cell's input and at its output, as EE-LCVIO has it."""

import torch
from torch import Tensor, nn
from torch.nn import functional


class ReluLstm(nn.Module):
    """``c = f c + i relu(g), h = o relu(c)`` with sigmoid gates; unbounded, unlike the usual one.

    The paper says that ReLU replaces the sigmoid; gates of ReLU would not be gates, so it is the activation here.
    """

    def __init__(self, inputs: int, hidden: int) -> None:
        super().__init__()
        self.from_input = nn.Linear(inputs, 4 * hidden)
        self.from_output = nn.Linear(hidden, 4 * hidden, bias=False)
        self._hidden = hidden

    def forward(self, signal: Tensor) -> Tensor:
        """(W, steps, inputs) to (W, steps, hidden)."""
        driven = self.from_input(signal)
        output = cell = signal.new_zeros(len(signal), self._hidden)
        outputs = []
        for step in driven.unbind(1):
            entry, forget, out, candidate = (step + self.from_output(output)).chunk(4, dim=-1)
            cell = forget.sigmoid() * cell + entry.sigmoid() * functional.relu(candidate)
            output = out.sigmoid() * functional.relu(cell)
            outputs.append(output)
        return torch.stack(outputs, dim=1)
