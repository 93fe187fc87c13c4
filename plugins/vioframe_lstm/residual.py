"""``fuser.head=residual``: a filter whose odometry is corrected, and valued, by a net."""

from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from vioframe.conventions import seconds
from vioframe.errors import ConfigError, StateError
from vioframe.fusion_options import InertialOptions, StandstillOptions, StartOptions, VisualOptions
from vioframe.learning.holder import NetHolder
from vioframe.metric_fusion import RelativePoseFuser
from vioframe.types import Measurement, NavState, RelativePose, SensorRig
from vioframe_lstm.options import ResidualOptions
from vioframe_lstm.streaming import IntervalCheck, pair_of, unstated_of

if TYPE_CHECKING:
    from torch import Tensor, nn

    from vioframe.learning.batch import WindowBatch
    from vioframe_lstm.net.pairs import Pairs
    from vioframe_lstm.net.residual import ResidualNet


class ResidualFuser(RelativePoseFuser):
    """Attitude from the bias-corrected gyro; translation from odometry that a net corrects and weighs; see the README.

    Args:
        frames: pairs of images that an answer of the net looks at.
        residual: of the net and its training.
        visual: trust in the relative poses; its sigmas stand in where the VO states no covariance.
        inertial: trust in the inertial increments.
        standstill: measuring no motion at rest.
        start: what is assumed of the first state.
        weights: file of trained weights, in MLflow too, or None.
        device: ``cpu``, ``cuda`` or ``auto``.

    Raises:
        ConfigError: an option outside its range, or torch is missing.
    """

    learns_from: ClassVar[str] = "answers"

    def __init__(
        self,
        *,
        frames: int,
        residual: ResidualOptions,
        visual: VisualOptions | None = None,
        inertial: InertialOptions | None = None,
        standstill: StandstillOptions | None = None,
        start: StartOptions | None = None,
        weights: str | None = None,
        device: str = "auto",
    ) -> None:
        super().__init__(visual=visual, inertial=inertial, standstill=standstill, start=start)
        if frames < 2:
            raise ConfigError(f"fuser.frames must be 2 or more, got {frames}: a change takes two pairs")
        self._frames = frames
        self._options = residual
        self._unstated = unstated_of(self._visual, self._inertial)
        self._holder = NetHolder(self, "fuser", "lstm", self._make_net, weights, device)

    @property
    def net(self) -> "nn.Module":
        """``residual``: the causal net."""
        return self._holder.net

    @property
    def context_pairs(self) -> int:
        """Pairs that an answer looks at."""
        return self._frames

    @property
    def needs_training(self) -> bool:
        """Without weights it is the filter alone, which has a name of its own."""
        return self._holder.needs_training

    @property
    def architecture(self) -> Mapping[str, str | int | float | bool]:
        """What a file of weights must agree with."""
        return {
            "part": "lstm residual",
            "frames": self._frames,
            "channels": self._options.channels,
            "corrects_rotation": self._options.corrects_rotation,
            "speed_unit": self._options.speed_unit,
            "rate_unit": self._options.rate_unit,
        }

    def setup(self, rig: SensorRig) -> None:
        """Forget the last sequence, take the calibration, and bring the net to its device; errors as of the holder."""
        super().setup(rig)
        net = self._residual(self._holder.prepare())
        self._interval = IntervalCheck(float(net.interval_s))
        self._features: deque[Tensor] = deque(maxlen=self._frames - 1)
        self._before: Pairs | None = None
        self._last_ns: int | None = None

    def update(self, measurement: Measurement) -> list[NavState]:
        """Correct the motion of the VO, then filter it."""
        if not self._ready:
            raise StateError("fuser=lstm was updated before setup(rig): set the fuser up first")
        return super().update(replace(measurement, relative_pose=self._corrected(measurement)))

    def _corrected(self, measurement: Measurement) -> RelativePose | None:
        import torch

        from vioframe_lstm.net.pairs import joined

        window, pose = measurement.window, measurement.relative_pose
        self._interval.push(seconds(window.current.stamp_ns - window.previous.stamp_ns))
        if self._last_ns != window.previous.stamp_ns:
            self._features.clear()
            self._before = None
        self._last_ns = window.current.stamp_ns
        net = self._residual(self.net)
        with torch.inference_mode():
            pair = pair_of(measurement, self._T_body_cam, self._unstated, self._holder.device())
            row = pair if self._before is None else joined([self._before, pair])
            self._features.append(net.features(row)[:, -1:])
            self._before = pair
            if pose is None or not pose.valid:
                return pose
            corrected = net.correct(pair, net.causal(torch.cat(list(self._features), dim=1))[:, -1:])
            T_prev_cur = pair.T_camera(corrected.R_body, corrected.t_body)[0, 0].double().cpu().numpy()
            variances = corrected.variances[0, 0].double().cpu().numpy()
        R_cam_body = self._T_body_cam[:3, :3].T
        covariance = np.zeros((6, 6))
        for block in (slice(0, 3), slice(3, 6)):
            turned = (R_cam_body * variances[block]) @ R_cam_body.T
            covariance[block, block] = 0.5 * (turned + turned.T)
        if not self._options.corrects_rotation:
            # As the VO gave it, in its full precision.
            T_prev_cur[:3, :3] = pose.T_prev_cur[:3, :3]
        return replace(pose, T_prev_cur=T_prev_cur, covariance=covariance)

    def forward_batch(self, batch: "WindowBatch", upstream: "Mapping[str, Tensor]") -> "dict[str, Tensor]":
        """Corrected motions of all pairs; as answers, those that look at as many pairs as in use.

        Args:
            batch: images are not looked at.
            upstream: what the VO answered, for the last pairs of each window.
        """
        from vioframe_lstm.net.dropping import lose_stretches
        from vioframe_lstm.net.pairs import learn_interval, pairs_of_batch
        from vioframe_lstm.net.residual import states

        self._holder.taught()
        net = self._residual(self.net)
        pairs = pairs_of_batch(batch, upstream, self._unstated)
        if net.training:
            learn_interval(net.interval_s, pairs)
            pairs = lose_stretches(pairs, self._options.lost_share, self._options.lost_pairs)
        corrected = net(pairs)
        answered = max(len(pairs) - self._frames + 1, 1)
        motions = states(corrected, pairs, self._start.gyro_bias_sigma)
        return {
            "T_prev_cur": motions[:, -answered:],
            "corrected_rotation": corrected.R_body,
            "corrected_shift": corrected.t_body,
            "corrected_variances": corrected.variances,
            "corrected_there": pairs.visual,
        }

    def loss(self, outputs: "Mapping[str, Tensor]", batch: "WindowBatch") -> "dict[str, Tensor]":
        """``loss``: negative log-likelihoods of rotation and translation; these, and root mean squared errors."""
        from vioframe_lstm.net.residual import Corrected, likelihoods

        corrected = Corrected(
            R_body=outputs["corrected_rotation"],
            t_body=outputs["corrected_shift"],
            variances=outputs["corrected_variances"],
        )
        counted = outputs["corrected_there"]
        told = likelihoods(
            corrected,
            counted,
            batch.T_prev_cur[:, -counted.shape[1] :],
            batch.rig.T_body_cam,
            self._options.horizons,
        )
        return {"loss": told["rotation"] + told["translation"], **{name: each.detach() for name, each in told.items()}}

    def _make_net(self) -> "nn.Module":
        from vioframe_lstm.net.residual import ResidualNet

        options = self._options
        return ResidualNet(
            frames=self._frames,
            channels=options.channels,
            dropout=options.dropout,
            speed_unit=options.speed_unit,
            rate_unit=options.rate_unit,
            corrects_rotation=options.corrects_rotation,
        )

    @staticmethod
    def _residual(net: "nn.Module") -> "ResidualNet":
        from vioframe_lstm.net.residual import ResidualNet

        if not isinstance(net, ResidualNet):
            raise StateError(f"the net of fuser.head=residual is a {type(net).__name__}")
        return net
