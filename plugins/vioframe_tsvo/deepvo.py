"""``vo=deepvo``: motion from the images of a sequence, remembered by an LSTM."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from vioframe.checks import check_positive
from vioframe.errors import ConfigError, DataError
from vioframe.types import RelativePose, SensorRig, VisualFeatures
from vioframe_tsvo.estimator import LearnedVO, MotionOptions

if TYPE_CHECKING:
    from torch import Tensor, nn

    from vioframe.learning.batch import WindowBatch
    from vioframe.learning.motion import Rotation
    from vioframe_tsvo.net.deepvo import LstmState


class DeepVo(LearnedVO):
    """DeepVO (Wang et al. 2017): FlowNetS convolutions and two LSTM layers; remembers from one image to the next.

    Args:
        size_px: (width, height) to which images are brought.
        gray: take images in grey, even where the camera has colour.
        window: pairs of a training window; in use it remembers without end.
        width: factor on the channels of the convolutions.
        hidden: neurons of each LSTM layer.
        layers: LSTM layers.
        conv_dropout: after each convolution but the last, and
        last_conv_dropout: after the last.
        lstm_dropout: between and after the LSTM layers.
        batch_norm: after each convolution.
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

    def __init__(
        self,
        *,
        size_px: Sequence[int] = (512, 256),
        gray: bool = False,
        window: int = 7,
        width: float = 1.0,
        hidden: int = 1000,
        layers: int = 2,
        conv_dropout: float = 0.2,
        last_conv_dropout: float = 0.5,
        lstm_dropout: float = 0.5,
        batch_norm: bool = True,
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
        check_positive("vo", window=window, width=width, hidden=hidden, layers=layers)
        dropouts = {
            "conv_dropout": conv_dropout,
            "last_conv_dropout": last_conv_dropout,
            "lstm_dropout": lstm_dropout,
        }
        for name, value in dropouts.items():
            if not 0.0 <= value < 1.0:
                raise ConfigError(f"vo.{name} must be from 0 to below 1, got {value}")
        super().__init__("deepvo", options)
        self._window = window
        self._width, self._hidden, self._layers, self._batch_norm = width, hidden, layers, batch_norm
        self._dropouts = dropouts
        self._state: LstmState | None = None
        self._last_ns: int | None = None

    @property
    def context_pairs(self) -> int:
        """So many that in validation each answer remembers a window, as in training."""
        return self._window

    @property
    def architecture(self) -> Mapping[str, str | int | float | bool]:
        """What a file of weights must agree with."""
        return {
            "part": "deepvo",
            "width": self._width,
            "hidden": self._hidden,
            "layers": self._layers,
            "batch_norm": self._batch_norm,
            **self._options.architecture(),
        }

    def make_motion_net(self) -> "nn.Module":
        """Convolutions and LSTM."""
        from vioframe_tsvo.net.deepvo import DeepVoNet

        return DeepVoNet(
            size_px=self._options.size,
            width=self._width,
            hidden=self._hidden,
            layers=self._layers,
            batch_norm=self._batch_norm,
            log_variances=self._options.log_variances,
            **self._dropouts,
        )

    def forward_batch(self, batch: "WindowBatch", upstream: "Mapping[str, Tensor]") -> "dict[str, Tensor]":
        """Motions of all pairs of each window to learn from; of those that remember a whole window as answers.

        Args:
            batch: with images in [0, 1] of ``size_px``.
            upstream: not used.

        Raises:
            ConfigError: images of another size than the net's.
            DataError: windows of fewer pairs than ``window``.
        """
        if batch.pairs < self._window:
            raise DataError(f"windows have {batch.pairs} pairs of images, but vo.window={self._window} needs as many")
        estimate, _ = self.net.get_submodule("motion")(self.images.pairs_of_batch(batch.images))
        return self.outputs(estimate, batch.pairs - self._window + 1)

    def setup(self, rig: SensorRig) -> None:
        """Forget the last sequence; errors as of the interface."""
        super().setup(rig)
        self._state = None
        self._last_ns = None

    def estimate(self, previous: VisualFeatures, current: VisualFeatures) -> RelativePose:
        """Metric motion of camera 0 from ``previous`` to ``current``; after a hole it begins to remember anew.

        Raises:
            StateError: called before ``setup``.
            DataError: frames without an image.
        """
        import torch

        pair = self.pair(previous.frame, current.frame)
        if self._last_ns != previous.frame.stamp_ns:
            self._state = None
        self._last_ns = current.frame.stamp_ns
        with torch.inference_mode():
            estimate, self._state = self.net.get_submodule("motion")(pair[:, None], self._state)
            return self.relative_pose(estimate)
