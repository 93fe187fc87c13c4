"""``fuser.head=pose``: the net of EE-LCVIO puts poses out, and nothing filters them."""

from collections import deque
from collections.abc import Mapping
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from vioframe.checks import Array
from vioframe.conventions import seconds
from vioframe.errors import ConfigError, StateError
from vioframe.fusion_options import InertialOptions, VisualOptions
from vioframe.geometry import se3, so3
from vioframe.inertial import level
from vioframe.interfaces import INERTIAL_DELTA, METRIC_SCALE, RELATIVE_POSE, Fuser
from vioframe.learning.holder import NetHolder
from vioframe.types import Measurement, NavState, SensorRig
from vioframe_lstm.options import PoseOptions
from vioframe_lstm.streaming import IntervalCheck, pair_of, samples_of, unstated_of

if TYPE_CHECKING:
    from torch import Tensor, nn

    from vioframe.learning.batch import WindowBatch
    from vioframe_lstm.net.pairs import Pairs
    from vioframe_lstm.net.pose import PoseNet
    from vioframe_lstm.net.stack import Paths


class PoseFuser(Fuser):
    """Convolutions and an LSTM over the last frames put out the pose of the body; see the README.

    It states no covariance: nothing in it knows one. Without a camera it goes on with what the gyro says and the last
    speed, without inertial samples with what the VO says.

    Args:
        frames: M, pairs of images in a window.
        poses: N, of the inertial sensor for each image.
        pose: of the net and its training.
        visual: sigmas that stand in where the VO states no covariance.
        inertial: the longest hole between samples that is none.
        weights: file of trained weights, in MLflow too, or None.
        device: ``cpu``, ``cuda`` or ``auto``.

    Raises:
        ConfigError: an option outside its range, or torch is missing.
    """

    requires: ClassVar[frozenset[str]] = frozenset({INERTIAL_DELTA, RELATIVE_POSE, METRIC_SCALE})
    learns_from: ClassVar[str] = "answers"

    def __init__(
        self,
        *,
        frames: int,
        poses: int,
        pose: PoseOptions,
        visual: VisualOptions | None = None,
        inertial: InertialOptions | None = None,
        weights: str | None = None,
        device: str = "auto",
    ) -> None:
        if pose.frames_left(frames) < 1:
            raise ConfigError(
                f"fuser.frames={frames} leaves nothing of a window after three convolutions of "
                f"fuser.pose.kernel={pose.kernel} and a pool of {pose.pool}: take more frames, or padding=same"
            )
        self._frames, self._poses, self._options = frames, poses, pose
        self._unstated = unstated_of(visual or VisualOptions(), inertial or InertialOptions())
        self._absolute = pose.pose == "absolute"
        self._holder = NetHolder(self, "fuser", "lstm", self._make_net, weights, device)
        self._ready = False

    @property
    def net(self) -> "nn.Module":
        """``pose``, the network, and ``weighing``, its loss."""
        return self._holder.net

    @property
    def context_pairs(self) -> int:
        """Pairs that an answer looks at."""
        return self._frames

    @property
    def needs_training(self) -> bool:
        """Without weights its poses are those of a random net."""
        return self._holder.needs_training

    @property
    def architecture(self) -> Mapping[str, str | int | float | bool]:
        """What a file of weights must agree with."""
        options = self._options
        return {
            "part": "lstm pose",
            "frames": self._frames,
            "poses": self._poses,
            **{
                name: getattr(options, name)
                for name in ("pose", "activation", "padding", "kernel", "pool", "translation_unit", "rotation_unit")
            },
            **{name: options.scaled(getattr(options, name)) for name in ("channels", "hidden", "head")},
        }

    def setup(self, rig: SensorRig) -> None:
        """Forget the last sequence, take the calibration, and bring the net to its device.

        Raises:
            ConfigError: the rig has no camera, so its place on the body is unknown.
        """
        if not rig.cameras:
            raise ConfigError(
                "fuser=lstm needs the place of the camera on the body (rig.cameras[0].T_body_cam), but the recording "
                "has no camera: choose fuser=imu_only, or a recording with a camera"
            )
        self._holder.prepare()
        self._T_body_cam = rig.cameras[0].T_body_cam
        self._interval = IntervalCheck(float(self._pose_net().interval_s))
        self._given: NavState | None = None
        self._past: deque[tuple[Pairs, Paths]] = deque(maxlen=self._frames)
        # At the starts of the window to come and of those after it: states, and where the VO alone is since the first.
        self._states: deque[Array] = deque(maxlen=self._frames)
        self._visual: deque[Tensor] = deque(maxlen=self._frames)
        self._T_world_first: Array = np.eye(4)
        self._T_world_body: Array = np.eye(4)
        self._begun = False
        self._stamp_ns = self._seen_ns = 0
        self._counts: dict[str, int] = {}
        self._ready = True

    def start_from(self, state: NavState) -> None:
        """Start from the pose of a given state."""
        self._given = state

    def counters(self) -> Mapping[str, int]:
        """Windows without a motion of the VO, and holes between windows."""
        return dict(self._counts) if self._ready else {}

    def update(self, measurement: Measurement) -> list[NavState]:
        """The pose at the window's end; the first call also gives the one at its beginning."""
        if not self._ready:
            raise StateError("fuser=lstm was updated before setup(rig): set the fuser up first")
        window, pose = measurement.window, measurement.relative_pose
        duration = seconds(window.current.stamp_ns - window.previous.stamp_ns)
        self._interval.push(duration)
        states = []
        if not self._begun:
            states.append(self._begin(measurement))
        elif self._stamp_ns != window.previous.stamp_ns:
            # What lies between is unknown: begin anew where the last state was.
            self._count("missing windows")
            self._restart()
        if pose is None or not pose.valid:
            self._count("missing VO updates")
        else:
            self._seen_ns = window.current.stamp_ns
        before = self._T_world_body
        self._T_world_body = self._answer(measurement)
        self._stamp_ns = window.current.stamp_ns
        velocity = (self._T_world_body[:3, 3] - before[:3, 3]) / duration
        states.append(self._state(velocity))
        return states

    def forward_batch(self, batch: "WindowBatch", upstream: "Mapping[str, Tensor]") -> "dict[str, Tensor]":
        """Poses at the ends of some windows, drawn in training; of all that matter, as motions, otherwise.

        Args:
            batch: images are not looked at.
            upstream: what the VO answered, for the last pairs of each window.
        """
        import torch

        from vioframe.learning.motion import inverse, product
        from vioframe_lstm.net.answers import answer_windows, chain_answers, needed_ends, visual_poses
        from vioframe_lstm.net.pairs import learn_interval, pairs_of_batch
        from vioframe_lstm.net.stack import sample_paths

        self._holder.taught()
        net, frames = self._pose_net(), self._frames
        pairs = pairs_of_batch(batch, upstream, self._unstated)
        count = len(pairs)
        imu, time_s, mask = (each[:, -count:] for each in (batch.imu, batch.imu_time_s, batch.imu_mask))
        paths = sample_paths(imu, time_s, mask, pairs.duration_s, self._poses)
        answered = max(count - frames + 1, 1)
        if net.training:
            learn_interval(net.interval_s, pairs)
            ends = sorted((torch.randperm(count)[: self._options.answers] + 1).tolist())
        else:
            ends = needed_ends(count, answered, frames)
        first = torch.tensor(ends, device=imu.device) - frames
        starts = visual_poses(pairs)[:, first.clamp_min(0)] if self._absolute else None
        answers = answer_windows(net, pairs, paths, ends, frames, starts)
        told = {"fused_poses": answers, "fused_ends": torch.tensor(ends), "fused_pairs": torch.tensor(count)}
        if net.training:
            return told
        poses = chain_answers(answers, ends, frames, absolute=self._absolute)
        row = torch.stack([poses[end] for end in range(count - answered, count + 1)], dim=1)
        T_body_cam = batch.rig.T_body_cam[:, None]
        motions = product(inverse(row[:, :-1]), row[:, 1:])
        return {"T_prev_cur": product(product(inverse(T_body_cam), motions), T_body_cam), **told}

    def loss(self, outputs: "Mapping[str, Tensor]", batch: "WindowBatch") -> "dict[str, Tensor]":
        """``loss``, and mean errors in rad and m."""
        from vioframe_lstm.net.answers import true_poses

        ends, motions = outputs["fused_ends"].tolist(), batch.T_prev_cur[:, -int(outputs["fused_pairs"]) :]
        truth = true_poses(motions, batch.rig.T_body_cam, ends, self._frames, absolute=self._absolute)
        losses: dict[str, Tensor] = self.net.get_submodule("weighing")(outputs["fused_poses"], truth)
        return losses

    def _answer(self, measurement: Measurement) -> Array:
        """T_world_body at the window's end."""
        import torch

        from vioframe_lstm.net.answers import answer_windows, visual_poses
        from vioframe_lstm.net.pairs import joined
        from vioframe_lstm.net.stack import joined_paths, sample_paths

        device = self._holder.device()
        with torch.inference_mode():
            pair = pair_of(measurement, self._T_body_cam, self._unstated, device)
            samples, times = samples_of(measurement, device)
            mask = torch.ones_like(times, dtype=torch.bool)
            path = sample_paths(samples, times, mask, pair.duration_s, self._poses)
            self._past.append((pair, path))
            pairs, paths = joined([one for one, _ in self._past]), joined_paths([one for _, one in self._past])
            starts = self._visual[0][:, None] if self._absolute else None
            T = answer_windows(self._pose_net(), pairs, paths, [len(pairs)], self._frames, starts)[0, 0]
            if self._absolute:
                before, after = visual_poses(pairs)[:, -2:].unbind(1)
                self._visual.append(self._visual[-1] @ torch.linalg.solve(before, after))
        T_start = self._T_world_first if self._absolute else self._states[0]
        T_world_body: Array = T_start @ T.double().cpu().numpy()
        T_world_body[:3, :3] = so3.normalise(T_world_body[:3, :3])
        self._states.append(T_world_body)
        return T_world_body

    def _begin(self, measurement: Measurement) -> NavState:
        window = measurement.window
        given, self._given = self._given, None
        velocity: Array = np.zeros(3)
        if given is not None:
            self._T_world_body, velocity = given.T_world_body, given.v_world_body
        elif len(window.imu):
            # Roll and pitch from the first samples, which errs by the body's acceleration over gravity.
            self._T_world_body = se3.from_parts(level(window.imu.accel.mean(axis=0)), np.zeros(3))
        self._restart()
        self._begun = True
        self._stamp_ns = self._seen_ns = window.previous.stamp_ns
        return self._state(velocity)

    def _restart(self) -> None:
        """Forget the frames before, and go on from the last pose."""
        import torch

        self._past.clear()
        self._states.clear()
        self._visual.clear()
        self._states.append(self._T_world_body)
        self._visual.append(torch.eye(4, device=self._holder.device())[None])
        self._T_world_first = self._T_world_body

    def _state(self, velocity: Array) -> NavState:
        lost = seconds(self._stamp_ns - self._seen_ns) > self._options.lost_after_s
        return NavState(
            stamp_ns=self._stamp_ns,
            T_world_body=self._T_world_body.copy(),
            v_world_body=velocity,
            status="lost" if lost else "tracking",
        )

    def _count(self, what: str) -> None:
        self._counts[what] = self._counts.get(what, 0) + 1

    def _make_net(self) -> "nn.Module":
        from torch import nn

        from vioframe_lstm.net.pose import AbsoluteErrors, PoseNet

        weighing = AbsoluteErrors(self._options.log_variance_translation, self._options.log_variance_rotation)
        return nn.ModuleDict({"pose": PoseNet(self._options, self._poses), "weighing": weighing})

    def _pose_net(self) -> "PoseNet":
        from vioframe_lstm.net.pose import PoseNet

        net = self.net.get_submodule("pose")
        if not isinstance(net, PoseNet):
            raise StateError(f"the net of fuser.head=pose is a {type(net).__name__}")
        return net
