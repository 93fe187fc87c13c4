"""``vo=tsvo``: motion from two images and the flows that led to them."""

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import cv2
import numpy as np

from vioframe.checks import Array, check_positive
from vioframe.errors import ConfigError, DataError
from vioframe.interfaces import FLOW, IMAGES
from vioframe.learning.images import check_size
from vioframe.types import RelativePose, SensorRig, VisualFeatures
from vioframe_tsvo.estimator import LearnedVO, MotionOptions

if TYPE_CHECKING:
    from torch import Tensor, nn

    from vioframe.learning.batch import WindowBatch
    from vioframe.learning.motion import Rotation


@dataclass(frozen=True, slots=True, kw_only=True)
class Backbone:
    """``backbone=``: the network of the temporal stream.

    Attributes:
        name: googlenet, resnet50 or inceptionv3.
        weights: an ImageNet file of torchvision to start training from, or None.
    """

    name: str
    weights: str | None = None


class Tsvo(LearnedVO):
    """Two-stream odometry (Zhao et al. 2022): FlowNetS convolutions on the pair, a backbone on L stacked flows.

    Args:
        backbone: of the temporal stream.
        stack: L, flows that end with the pair's own.
        size_px: (width, height) to which images and flows are brought.
        flow_size_px: (width, height) of the flows inside the backbone; None leaves ``size_px``.
        flow_unit: flow that is 1 to the net, as a share of the width.
        gray: take images in grey, even where the camera has colour.
        width: factor on the channels of the spatial stream.
        hidden: neurons of the layer that joins the streams.
        dropout: before both linear layers.
        batch_norm: in the spatial stream.
        rotation: what three numbers of rotation mean: ``log`` or ``euler``.
        rotation_unit_rad, translation_unit_m: what an output of 1 means.
        loss: ``learned``, ``fixed`` or ``likelihood``, with which it states a covariance.
        rotation_weight: of ``fixed``, m²/rad².
        log_variance_rotation, log_variance_translation: from which ``learned`` starts, ln rad² and ln m².
        weights: file of trained weights, in MLflow too, or None.
        device: ``cpu``, ``cuda`` or ``auto``.

    Raises:
        ConfigError: an option outside its range, or torch is missing.
    """

    requires: ClassVar[frozenset[str]] = frozenset({IMAGES, FLOW})

    def __init__(
        self,
        *,
        backbone: Backbone,
        stack: int = 10,
        size_px: Sequence[int] = (512, 256),
        flow_size_px: Sequence[int] | None = None,
        flow_unit: float = 0.09375,
        gray: bool = False,
        width: float = 1.0,
        hidden: int = 512,
        dropout: float = 0.5,
        batch_norm: bool = False,
        rotation: "Rotation" = "log",
        rotation_unit_rad: float = 0.05,
        translation_unit_m: float = 1.0,
        loss: str = "learned",
        rotation_weight: float = 100.0,
        log_variance_rotation: float = -8.0,
        log_variance_translation: float = 0.0,
        weights: str | None = None,
        device: str = "auto",
    ) -> None:
        options = MotionOptions(
            size_px=size_px,
            gray=gray,
            rotation=rotation,
            rotation_unit_rad=rotation_unit_rad,
            translation_unit_m=translation_unit_m,
            loss=loss,
            rotation_weight=rotation_weight,
            log_variance_rotation=log_variance_rotation,
            log_variance_translation=log_variance_translation,
            weights=weights,
            device=device,
        )
        check_positive("vo", stack=stack, flow_unit=flow_unit, width=width, hidden=hidden)
        if not 0.0 <= dropout < 1.0:
            raise ConfigError(f"vo.dropout must be from 0 to below 1, got {dropout}")
        if flow_size_px is not None:
            check_size("vo.flow_size_px", flow_size_px)
        super().__init__("tsvo", options)
        self._backbone = backbone
        self._stack = stack
        self._flow_size = None if flow_size_px is None else (flow_size_px[0], flow_size_px[1])
        self._flow_unit = flow_unit
        self._flow_unit_px = flow_unit * options.size[0]
        self._width, self._hidden, self._dropout, self._batch_norm = width, hidden, dropout, batch_norm
        self._flows: deque[Tensor] = deque(maxlen=stack)
        self._last_ns: int | None = None
        self._partial = 0

    @property
    def context_pairs(self) -> int:
        """One for each flow of the stack."""
        return self._stack

    @property
    def architecture(self) -> Mapping[str, str | int | float | bool]:
        """What a file of weights must agree with."""
        flow_width, flow_height = self._flow_size or self._options.size
        return {
            "part": "tsvo",
            "backbone": self._backbone.name,
            "stack": self._stack,
            "flow_width_px": flow_width,
            "flow_height_px": flow_height,
            "flow_unit": self._flow_unit,
            "width": self._width,
            "hidden": self._hidden,
            "batch_norm": self._batch_norm,
            **self._options.architecture(),
        }

    def make_motion_net(self) -> "nn.Module":
        """Both streams; the backbone with its ImageNet file, unless trained weights come anyway.

        Raises:
            ConfigError: an unknown backbone.
            DataError: the ImageNet file cannot be used.
        """
        from vioframe_tsvo.net.two_stream import TwoStreamNet

        start = self._backbone.weights if self._options.weights is None else None
        return TwoStreamNet(
            size_px=self._options.size,
            stack=self._stack,
            backbone=self._backbone.name,
            backbone_weights=None if start is None else Path(start).expanduser(),
            flow_size_px=self._flow_size,
            width=self._width,
            hidden=self._hidden,
            dropout=self._dropout,
            batch_norm=self._batch_norm,
            log_variances=self._options.log_variances,
        )

    def forward_batch(self, batch: "WindowBatch", upstream: "Mapping[str, Tensor]") -> "dict[str, Tensor]":
        """Motions of the last S - L + 1 pairs of each window.

        Args:
            batch: with images in [0, 1] of ``size_px``.
            upstream: ``"flow"``, (B, S, 2, H, W) px.

        Raises:
            ConfigError: no part before this one computes flow in training, or sizes differ.
            DataError: windows of fewer pairs than the stack has flows.
        """
        from vioframe_tsvo.net.two_stream import MotionEstimate, stack_flows

        if FLOW not in upstream:
            raise ConfigError(
                "vo=tsvo learns from flow, which no part before it computes here: use frontend=dis or frontend=tvnet"
            )
        if batch.pairs < self._stack:
            raise DataError(f"windows have {batch.pairs} pairs of images, but vo.stack={self._stack} needs as many")
        self.images.check_training_size("frontend.size_px", upstream[FLOW])
        stacks = stack_flows(upstream[FLOW] / self._flow_unit_px, self._stack)
        answered = stacks.shape[1]
        pairs = self.images.pairs_of_batch(batch.images)[:, -answered:]
        flat: MotionEstimate = self.net.get_submodule("motion")(pairs.flatten(0, 1), stacks.flatten(0, 1))
        shape = (len(batch), answered, 6)
        log_variances = None if flat.log_variances is None else flat.log_variances.reshape(shape)
        return self.outputs(MotionEstimate(flat.vector.reshape(shape), log_variances), answered)

    def setup(self, rig: SensorRig) -> None:
        """Forget the last sequence's flows; errors as of the interface."""
        super().setup(rig)
        self._flows.clear()
        self._last_ns = None
        self._partial = 0

    def counters(self) -> Mapping[str, int]:
        """How often the first flow stood in for those before it: at a beginning, and after a hole."""
        return {"answers from a short stack": self._partial} if self._partial else {}

    def estimate(self, previous: VisualFeatures, current: VisualFeatures) -> RelativePose:
        """Metric motion of camera 0 from ``previous`` to ``current``.

        Raises:
            StateError: called before ``setup``.
            DataError: frames without an image, or no flow.
        """
        import torch

        pair = self.pair(previous.frame, current.frame)
        if current.flow is None:
            raise DataError("vo=tsvo needs flow, which the front end did not give: use frontend=tvnet or frontend=dis")
        if self._last_ns != previous.frame.stamp_ns:
            self._flows.clear()
        self._last_ns = current.frame.stamp_ns
        self._flows.append(torch.from_numpy(self._flow(current.flow)).to(pair.device))
        missing = self._stack - len(self._flows)
        self._partial += missing > 0
        stack = torch.cat([self._flows[0]] * missing + list(self._flows))[None]
        with torch.inference_mode():
            return self.relative_pose(self.net.get_submodule("motion")(pair, stack))

    def _flow(self, flow: Array) -> np.ndarray:
        """(2, H, W) float32 in units of the net."""
        width, height = self._options.size
        if flow.shape[1::-1] != self._options.size:
            scale = np.array([width / flow.shape[1], height / flow.shape[0]])
            flow = cv2.resize(flow, (width, height), interpolation=cv2.INTER_AREA) * scale
        return np.ascontiguousarray((flow / self._flow_unit_px).transpose(2, 0, 1), dtype=np.float32)
