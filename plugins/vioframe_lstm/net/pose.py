"""The fusion net of EE-LCVIO: two branches of convolutions over the window, an LSTM, and six numbers."""

import itertools

import torch
from torch import Tensor, nn
from torch.nn import functional

from vioframe.learning.motion import exp_so3, from_parts, log_so3, product
from vioframe_lstm.net.relu_lstm import ReluLstm
from vioframe_lstm.options import PoseOptions

# Of the units, what corrections are measured in.
_REFINED = 0.1


class Branch(nn.Module):
    """Three convolutions and a pool over frames; what lies before the recording stays zero."""

    def __init__(self, inputs: int, options: PoseOptions) -> None:
        super().__init__()
        widths = [inputs, *[options.scaled(options.channels)] * 3]
        padding = options.kernel // 2 if options.padding == "same" else 0
        self.convolutions = nn.ModuleList(
            nn.Conv1d(a, b, options.kernel, padding=padding) for a, b in itertools.pairwise(widths)
        )
        self._reach = (options.kernel, padding)
        self._pool = options.pool

    def forward(self, signal: Tensor, present: Tensor) -> Tensor:
        """(W, C, M) and (W, 1, M) of ones and zeros to (W, channels, steps)."""
        kernel, padding = self._reach
        for convolution in self.convolutions:
            present = functional.max_pool1d(present, kernel, stride=1, padding=padding)
            signal = functional.relu(convolution(signal)) * present
        return functional.max_pool1d(signal, self._pool)


class PoseNet(nn.Module):
    """A window's stack to the pose at its end, or to what the VO's is to be corrected by.

    Args:
        options: of the head.
        poses: N, of the inertial sensor for each image.

    Attributes:
        interval_s: from image to image in the training recordings, s; zero before any.
    """

    interval_s: Tensor

    def __init__(self, options: PoseOptions, poses: int) -> None:
        super().__init__()
        self._share = _REFINED if options.refines else 1.0
        self._units = (options.rotation_unit, options.translation_unit)
        self.register_buffer("interval_s", torch.zeros((), dtype=torch.float64))
        self.attitude = Branch(3 * (poses + 1), options)
        self.position = Branch(3 * (poses + 1), options)
        hidden, width = options.scaled(options.hidden), 2 * options.scaled(options.channels)
        kind = ReluLstm if options.activation == "relu" else TanhLstm
        self.first, self.second = kind(width, hidden), kind(hidden, hidden)
        self.dropout = nn.Dropout(options.dropout)
        self.neck = nn.Linear(hidden, options.scaled(options.head))
        self.exit = nn.Linear(options.scaled(options.head), 6)
        if options.refines:
            # Untrained, the poses are the VO's.
            nn.init.zeros_(self.exit.weight)
            nn.init.zeros_(self.exit.bias)

    def forward(self, rotation: Tensor, p: Tensor, present: Tensor) -> Tensor:
        """Poses (W, 4, 4) of stacks (W, M, N + 1, 3) of rotation vectors and positions, and present (W, M) bool."""
        rotation_unit, translation_unit = self._units
        mask = present[:, None].to(p.dtype)
        attitude = (rotation / rotation_unit).flatten(2).transpose(1, 2) * mask
        position = (p / translation_unit).flatten(2).transpose(1, 2) * mask
        joint = torch.cat([self.attitude(attitude, mask), self.position(position, mask)], dim=1).transpose(1, 2)
        remembered = self.dropout(self.second(self.dropout(self.first(joint))))
        numbers = self._share * self.exit(self.neck(remembered[:, -1])).float()
        return from_parts(exp_so3(rotation_unit * numbers[:, :3]), translation_unit * numbers[:, 3:])


class TanhLstm(nn.Module):
    """One layer of the usual LSTM."""

    def __init__(self, inputs: int, hidden: int) -> None:
        super().__init__()
        self.lstm = nn.LSTM(inputs, hidden, batch_first=True)

    def forward(self, signal: Tensor) -> Tensor:
        """(W, steps, inputs) to (W, steps, hidden)."""
        answers: Tensor = self.lstm(signal)[0]
        return answers


class AbsoluteErrors(nn.Module):
    """L1 errors of poses, weighed by log-variances that are learned with the net (Zhao et al. 2022, eq. 7).

    ``L = L_t exp(−s_t) + s_t + L_r exp(−s_r) + s_r``, L_t in m, L_r in rad, both summed over axes.
    """

    def __init__(self, log_variance_translation: float, log_variance_rotation: float) -> None:
        super().__init__()
        self.log_variance_translation = nn.Parameter(torch.tensor(float(log_variance_translation)))
        self.log_variance_rotation = nn.Parameter(torch.tensor(float(log_variance_rotation)))

    def forward(self, T: Tensor, T_true: Tensor) -> dict[str, Tensor]:
        """Of poses (..., 4, 4): ``loss``, and what it is made of, for the record."""
        back = T[..., :3, :3].transpose(-1, -2)
        rotation = log_so3(product(back, T_true[..., :3, :3])).abs().sum(-1).mean()
        translation = (T[..., :3, 3] - T_true[..., :3, 3]).abs().sum(-1).mean()
        s_r, s_t = self.log_variance_rotation, self.log_variance_translation
        return {
            "loss": translation * torch.exp(-s_t) + s_t + rotation * torch.exp(-s_r) + s_r,
            "rotation": rotation.detach(),
            "translation": translation.detach(),
        }
