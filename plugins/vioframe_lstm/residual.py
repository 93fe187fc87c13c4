"""``fuser.head=residual``: a filter whose odometry is corrected, and valued, by a net."""

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from vioframe.checks import Array
from vioframe.conventions import seconds
from vioframe.error_state import BIAS_GYRO
from vioframe.errors import ConfigError, StateError
from vioframe.fusion_options import InertialOptions, StandstillOptions, StartOptions, VisualOptions
from vioframe.geometry import se3, so3
from vioframe.learning.holder import NetHolder
from vioframe.metric_fusion import RelativePoseFuser
from vioframe.types import Measurement, NavState, RelativePose, SensorRig
from vioframe_lstm.features import features
from vioframe_lstm.options import ResidualOptions, unstated_of
from vioframe_lstm.pairs import (
    Pairs,
    attitudes,
    doubles,
    held_shifts,
    joined,
    lose_stretches,
    pair_of,
    pairs_of_batch,
    transposed,
)
from vioframe_lstm.truth import gyro_errors, true_motions
from vioframe_lstm.warning import IntervalCheck

if TYPE_CHECKING:
    from torch import Tensor, nn

    from vioframe.learning.batch import WindowBatch
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
        self._stated_inertial = self._inertial
        self._unstated = unstated_of(self._visual, self._inertial)
        self._holder = NetHolder(self, "fuser", "lstm", self._make_net, weights, device)

    @property
    def net(self) -> "nn.Module":
        """The causal net and what it knows of gyros."""
        return self._holder.net

    @property
    def context_pairs(self) -> int:
        """Pairs that an answer looks at."""
        return self._frames

    @property
    def training_pairs(self) -> int:
        """As many as the longest stretch over which errors are summed up."""
        return max(self._frames, *self._options.horizons)

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
            "speed_unit": self._options.speed_unit,
            "rate_unit": self._options.rate_unit,
        }

    def setup(self, rig: SensorRig) -> None:
        """Forget the last sequence, take the calibration, and bring the net to its device; errors as of the holder."""
        net = self._residual(self._holder.prepare())
        self._inertial = self._trust_in_gyro(rig)
        super().setup(rig)
        self._interval = IntervalCheck(float(net.interval_s))
        self._last_ns: int | None = None

    def update(self, measurement: Measurement) -> list[NavState]:
        """Correct the motion of the VO, then filter it."""
        if not self._ready:
            raise StateError("fuser=lstm was updated before setup(rig): set the fuser up first")
        return super().update(replace(measurement, relative_pose=self.corrected(measurement)))

    def corrected(self, measurement: Measurement) -> RelativePose | None:
        """The VO's motion with the net's correction and covariance; what is not valid passes as it is."""
        import torch

        from vioframe_lstm.net.causal import Memory

        window, pose = measurement.window, measurement.relative_pose
        self._interval.push(seconds(window.current.stamp_ns - window.previous.stamp_ns))
        net = self._residual(self.net)
        pair = pair_of(measurement, self._T_body_cam, self._unstated)
        row = pair
        if self._last_ns == window.previous.stamp_ns:
            row = joined([self._before, pair])
        else:
            self._memory: Memory = Memory(net.causal)
        self._before: Pairs = pair
        self._last_ns = window.current.stamp_ns
        seen = features(row, self._options.speed_unit, self._options.rate_unit)[0, -1]
        with torch.inference_mode():
            answers = doubles(
                net.step(torch.from_numpy(seen.astype(np.float32)).to(self._holder.device()), self._memory)
            )
        if pose is None or not pose.valid:
            return pose
        t_body = pair.t_body * (1.0 + answers[:3]) + answers[3:6] * pair.duration_s[..., None]
        T_prev_cur = pose.T_prev_cur.copy()
        T_prev_cur[:3, 3] = pair.t_camera_of(t_body)[0, 0]
        return replace(pose, T_prev_cur=T_prev_cur, covariance=self._covariance(pair, answers))

    def _covariance(self, pair: Pairs, answers: Array) -> Array:
        variances = np.exp(pair.log_variances[0, 0] + answers[6:])
        R_cam_body = self._T_body_cam[:3, :3].T
        covariance = np.zeros((6, 6))
        for block in (slice(0, 3), slice(3, 6)):
            in_camera = (R_cam_body * variances[block]) @ R_cam_body.T
            covariance[block, block] = 0.5 * (in_camera + in_camera.T)
        return covariance

    def _started(self) -> None:
        """Add what was learned of gyros to what the first state says of the bias."""
        mean, sigma = self._gyro_bias()
        if sigma is None:
            return
        H = np.zeros((3, len(self._filter.covariance)))
        H[:, BIAS_GYRO] = np.eye(3)
        self._filter.correct(H, mean - self._filter.body.bias.gyro, np.diag(sigma**2))

    def _gyro_bias(self) -> tuple[Array, Array | None]:
        """Mean (3,) and standard deviation (3,) rad/s over the training recordings; None if there were none."""
        known = self._residual(self.net).gyros.summary() if self._options.bias_caution else None
        if known is None:
            return np.zeros(3), None
        return doubles(known[0]), self._options.bias_caution * doubles(known[1])

    def _trust_in_gyro(self, rig: SensorRig) -> InertialOptions:
        """The options with the noise that the gyros of the training recordings had, where that is more than stated."""
        known = self._residual(self.net).gyros.summary() if self._options.bias_caution else None
        if known is None or not rig.imu.gyro_noise:
            return self._stated_inertial
        more = max(float(known[2].square().mean().sqrt()) / rig.imu.gyro_noise, 1.0)
        return replace(self._stated_inertial, gyro_noise_scale=self._stated_inertial.gyro_noise_scale * more)

    def forward_batch(self, batch: "WindowBatch", upstream: "Mapping[str, Tensor]") -> "dict[str, Tensor]":
        """Corrected motions of all pairs; as answers, those that look at as many pairs as in use.

        Args:
            batch: images are not looked at.
            upstream: what the VO answered, for the last pairs of each window.
        """
        import torch

        self._holder.taught()
        net = self._residual(self.net)
        pairs = pairs_of_batch(batch, upstream, self._unstated)
        if net.training:
            if not float(net.interval_s):
                net.interval_s.fill_(float(np.median(pairs.duration_s)))
            errors, seconds_heard, which = gyro_errors(pairs, doubles(batch.T_prev_cur))
            heard = (torch.from_numpy(errors), torch.from_numpy(seconds_heard), batch.recording.cpu()[which])
            net.gyros.learn(*(each.to(net.interval_s.device) for each in heard))
            rng = np.random.default_rng(int(torch.randint(2**31, ())))
            pairs = lose_stretches(pairs, self._options.lost_share, self._options.lost_pairs, rng)

        def tensor(array: np.ndarray) -> "Tensor":
            return torch.from_numpy(array.astype(np.float32)).to(batch.T_prev_cur.device)

        answers = net(tensor(features(pairs, self._options.speed_unit, self._options.rate_unit)))
        t_body = tensor(pairs.t_body) * (1.0 + answers[..., :3]) + answers[..., 3:6] * tensor(
            pairs.duration_s[..., None]
        )
        log_variances = tensor(pairs.log_variances) + answers[..., 6:]
        told = {
            "corrected_shift": t_body,
            "corrected_log_variances": log_variances,
            "corrected_rotation": tensor(pairs.R_visual),
            "corrected_there": torch.from_numpy(pairs.visual).to(batch.T_prev_cur.device),
        }
        if net.training:
            return told
        answered = max(len(pairs) - self._frames + 1, 1)
        return {
            "T_prev_cur": tensor(self._states(pairs, doubles(t_body), doubles(log_variances))[:, -answered:]),
            **told,
        }

    def loss(self, outputs: "Mapping[str, Tensor]", batch: "WindowBatch") -> "dict[str, Tensor]":
        """``loss``: negative log-likelihoods of rotation and translation; these, and mean squared errors."""
        import torch

        from vioframe_lstm.net.residual import likelihoods

        there, shift = outputs["corrected_there"], outputs["corrected_shift"]
        R_true, t_true = true_motions(doubles(batch.T_prev_cur[:, -there.shape[1] :]), doubles(batch.rig.T_body_cam))
        rotation = so3.log(transposed(doubles(outputs["corrected_rotation"])) @ R_true)
        # In the body at the later image: Rᵀ (t_true − t).
        back = torch.from_numpy(transposed(R_true)).to(shift)
        translation = (back @ (torch.from_numpy(t_true).to(shift) - shift)[..., None])[..., 0]
        told = likelihoods(
            torch.cat([torch.from_numpy(rotation).to(shift), translation], dim=-1),
            outputs["corrected_log_variances"],
            torch.from_numpy(attitudes(R_true)).to(shift),
            there,
            self._options.horizons,
        )
        return {"loss": told["rotation"] + told["translation"], **{name: each.detach() for name, each in told.items()}}

    def _states(self, pairs: Pairs, t_body: Array, log_variances: Array) -> Array:
        """Motions (B, S, 4, 4) of the camera much as the filter will have them, for validation.

        Attitude from the gyro, whose constant bias b is estimated from the VO's rotations so far as the filter does it:
        ``Log(R_gyroᵀ R_vo) ≈ −b T`` with the stated variances, and what is known of b beforehand. Without samples it is
        the VO's; without a motion of the VO the last speed is held.
        """
        mean, sigma = self._gyro_bias()
        sigma = np.full(3, self._start.gyro_bias_sigma) if sigma is None else sigma
        both = (pairs.visual & pairs.inertial)[..., None].astype(float)
        T = pairs.duration_s[..., None]
        weight = both * np.exp(-log_variances[..., :3])
        told, known = -weight * T * pairs.disagreement, weight * T**2
        # What a pair itself tells comes too late for the bias that its samples are freed from.
        told, known = np.cumsum(told, axis=1) - told, np.cumsum(known, axis=1) - known
        bias = (told + mean * sigma**-2) / (known + sigma**-2)
        R_inertial = so3.exp(pairs.turn - bias * T)
        R_body = np.where(pairs.inertial[..., None, None], R_inertial, pairs.R_visual)
        return se3.from_parts(pairs.R_camera_of(R_body), pairs.t_camera_of(held_shifts(pairs, t_body)))

    def _make_net(self) -> "nn.Module":
        from vioframe_lstm.net.residual import ResidualNet

        options = self._options
        return ResidualNet(
            frames=self._frames, channels=options.channels, dropout=options.dropout, speed_unit=options.speed_unit
        )

    @staticmethod
    def _residual(net: "nn.Module") -> "ResidualNet":
        from vioframe_lstm.net.residual import ResidualNet

        if not isinstance(net, ResidualNet):
            raise StateError(f"the net of fuser.head=residual is a {type(net).__name__}")
        return net
