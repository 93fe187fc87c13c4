"""TSVO: a spatial stream on two images and a temporal stream on L stacked flows.

Zhao, Qiao, Tan, Li, Sun, Chinese Journal of Computers 45(8), 2022, section 3.1.
"""

from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor, nn

from vioframe.errors import ConfigError
from vioframe.learning.flownet import PAIR_CHANNELS, SpatialStream, centred, check_maps
from vioframe_tsvo.net.backbones import make_backbone

MOTION = 6
"""Numbers of a motion vector: rotation, translation."""


class MotionEstimate(NamedTuple):
    """What the networks answer.

    Attributes:
        vector: (..., 6) motion vectors, see :mod:`vioframe.learning.motion`.
        log_variances: (..., 6) natural logarithms of their variances, or None where the net has no such outputs.
    """

    vector: Tensor
    log_variances: Tensor | None


class MotionHead(nn.Module):
    """The last linear layer: six numbers, or twelve with log-variances."""

    def __init__(self, features: int, *, log_variances: bool) -> None:
        """Build it for ``features`` inputs; at first it answers close to no motion, whatever it sees."""
        super().__init__()
        self.log_variances = log_variances
        self.linear = nn.Linear(features, 2 * MOTION if log_variances else MOTION)
        nn.init.normal_(self.linear.weight, std=0.1 * features**-0.5)
        nn.init.zeros_(self.linear.bias)

    def forward(self, x: Tensor) -> MotionEstimate:
        """Estimates of (..., F), in single precision even where the layers before ran in half."""
        numbers = self.linear(x).float()
        return MotionEstimate(numbers[..., :MOTION], numbers[..., MOTION:] if self.log_variances else None)


class TwoStreamNet(nn.Module):
    """Both streams, joined by two linear layers."""

    def __init__(
        self,
        *,
        size_px: tuple[int, int],
        stack: int,
        backbone: str,
        backbone_weights: Path | None = None,
        flow_size_px: tuple[int, int] | None = None,
        width: float = 1.0,
        hidden: int = 512,
        dropout: float = 0.5,
        batch_norm: bool = False,
        log_variances: bool = False,
    ) -> None:
        """Build the network.

        Args:
            size_px: (width, height) of images and flows; one net is for one size.
            stack: L, flows that end with the pair's own.
            backbone: googlenet, resnet50 or inceptionv3.
            backbone_weights: ImageNet file to start from, or None.
            flow_size_px: (width, height) to which the flows are resized for the backbone, such as (224, 224), for
                which ImageNet's weights were made; None leaves their size. A side shorter than the backbone can take is
                lengthened to that.
            width: factor on the channels of the spatial stream.
            hidden: neurons of the layer that joins the streams.
            dropout: before each of the two linear layers.
            batch_norm: in the spatial stream (the backbones always have it).
            log_variances: answer with variances too.

        Raises:
            ConfigError: a stack below 1, or an unknown backbone.
            DataError: ``backbone_weights`` cannot be used.
        """
        super().__init__()
        if stack < 1:
            raise ConfigError(f"vo.stack must be at least 1, got {stack}")
        self.size_px, self.stack = size_px, stack
        self.spatial = SpatialStream(size_px, width=width, batch_norm=batch_norm)
        self.temporal = make_backbone(backbone, 2 * stack, backbone_weights)
        width_px, height_px = flow_size_px or size_px
        self.flow_size_px = max(width_px, self.temporal.smallest_px), max(height_px, self.temporal.smallest_px)
        self.join = nn.Sequential(
            nn.Dropout(dropout),
            nn.Linear(self.spatial.features + self.temporal.features, hidden),
            nn.ReLU(inplace=True),
            nn.Dropout(dropout),
        )
        self.head = MotionHead(hidden, log_variances=log_variances)

    def forward(self, pair: Tensor, flow: Tensor) -> MotionEstimate:
        """Motions of the camera between the two images of each pair.

        Args:
            pair: (N, 6, H, W) RGB of both images, the earlier first, in [0, 1].
            flow: (N, 2L, H, W), see :func:`stack_flows`; 0 where nothing moves, of the order of 1 where much does.

        Returns:
            (N, 6) and, where asked for, their log-variances.

        Raises:
            ShapeError: images or flows of another size or stack than the net was built for.
        """
        check_maps("images", pair, PAIR_CHANNELS, self.size_px)
        check_maps("flows", flow, 2 * self.stack, self.size_px)
        if self.flow_size_px != self.size_px:
            flow = nn.functional.interpolate(flow, size=self.flow_size_px[::-1], mode="bilinear", antialias=True)
        joined = torch.cat([self.spatial(centred(pair)), self.temporal(flow)], dim=1)
        estimate: MotionEstimate = self.head(self.join(joined))
        return estimate


def stack_flows(flow: Tensor, stack: int) -> Tensor:
    """The last ``stack`` flows of each step, as channels.

    Args:
        flow: (B, S, 2, H, W), (right, down) of each pair in a row.
        stack: L.

    Returns:
        (B, S - L + 1, 2L, H, W): right and down of the earliest first, of the pair itself last.
    """
    windows = flow.unfold(1, stack, 1).permute(0, 1, 5, 2, 3, 4)
    return windows.reshape(*windows.shape[:2], 2 * stack, *windows.shape[-2:])
