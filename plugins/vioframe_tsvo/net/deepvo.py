"""DeepVO: FlowNetS features of image pairs, remembered by two LSTM layers.

Wang, Clark, Wen, Trigoni, "DeepVO: Towards End-to-End Visual Odometry with Deep Recurrent Convolutional Neural
Networks", ICRA 2017.
"""

import torch
from torch import Tensor, nn

from vioframe.errors import ConfigError, ShapeError
from vioframe.learning.flownet import LAYERS, PAIR_CHANNELS, FlowNetConvolutions, centred, check_maps
from vioframe_tsvo.net.two_stream import MotionEstimate, MotionHead

DEEPVO_LAYERS = LAYERS[:9]
"""The paper ends at Conv6."""

LstmState = tuple[Tensor, Tensor]
"""Hidden and cell state, each (layers, B, hidden)."""


class DeepVoNet(nn.Module):
    """Nine convolutions, two LSTM layers, one linear layer."""

    def __init__(
        self,
        *,
        size_px: tuple[int, int],
        width: float = 1.0,
        hidden: int = 1000,
        layers: int = 2,
        conv_dropout: float = 0.2,
        last_conv_dropout: float = 0.5,
        lstm_dropout: float = 0.5,
        batch_norm: bool = False,
        log_variances: bool = False,
    ) -> None:
        """Build the network.

        Args:
            size_px: (width, height) of the images; one net is for one size.
            width: factor on the channels of the convolutions.
            hidden: neurons of each LSTM layer.
            layers: LSTM layers.
            conv_dropout: after each convolution but the last, and
            last_conv_dropout: after the last (as common re-implementations; the paper only says dropout).
            lstm_dropout: between and after the LSTM layers.
            batch_norm: after each convolution.
            log_variances: answer with variances too.

        Raises:
            ConfigError: less than one LSTM layer.
        """
        super().__init__()
        if layers < 1:
            raise ConfigError(f"vo.layers must be at least 1, got {layers}")
        self.size_px = size_px
        self.convolutions = FlowNetConvolutions(
            layers=DEEPVO_LAYERS,
            width=width,
            slope=0.1,
            batch_norm=batch_norm,
            dropout=conv_dropout,
            last_dropout=last_conv_dropout,
        )
        columns, rows = self.convolutions.out_size(size_px)
        features = self.convolutions.out_channels * columns * rows
        # Torch warns of a dropout between the layers of a single one.
        between = lstm_dropout if layers > 1 else 0.0
        self.lstm = nn.LSTM(features, hidden, layers, batch_first=True, dropout=between)
        for name, parameter in self.lstm.named_parameters():
            if name.startswith("weight_hh"):
                nn.init.orthogonal_(parameter)
            elif name.startswith("weight_ih"):
                nn.init.xavier_uniform_(parameter)
            else:
                nn.init.zeros_(parameter)
                if name.startswith("bias_ih"):
                    # Gates in torch's order: input, forget, cell, output. An open forget gate lets gradients reach
                    # back through the window from the first step (Jozefowicz et al., ICML 2015).
                    with torch.no_grad():
                        parameter[hidden : 2 * hidden].fill_(1.0)
        self.dropout = nn.Dropout(lstm_dropout)
        self.head = MotionHead(hidden, log_variances=log_variances)

    def forward(self, pairs: Tensor, state: LstmState | None = None) -> tuple[MotionEstimate, LstmState]:
        """Motions of the camera between the two images of each pair of sequences.

        Args:
            pairs: (B, S, 6, H, W) RGB of both images, the earlier first, in [0, 1].
            state: what the call before returned, where these sequences go on from there; None at a beginning.

        Returns:
            (B, S, 6) and, where asked for, their log-variances; the state to go on from.

        Raises:
            ShapeError: images of another size than the net was built for.
        """
        if pairs.ndim != 5:
            raise ShapeError(f"the net takes pairs of images in a row (B, S, 6, H, W), got {tuple(pairs.shape)}")
        batch, steps = pairs.shape[:2]
        flat = pairs.flatten(0, 1)
        check_maps("images", flat, PAIR_CHANNELS, self.size_px)
        features = torch.flatten(self.convolutions(centred(flat)), 1).reshape(batch, steps, -1)
        remembered, state = self.lstm(features, state)
        return self.head(self.dropout(remembered)), state
