"""``fuser.head=pose``: the net of EE-LCVIO puts poses out, and nothing filters them."""

from collections import deque
from collections.abc import Mapping
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from vioframe.checks import Array, Mask
from vioframe.conventions import seconds
from vioframe.errors import ConfigError, StateError
from vioframe.fusion_options import InertialOptions, VisualOptions
from vioframe.geometry import se3, so3
from vioframe.inertial import level
from vioframe.interfaces import INERTIAL_DELTA, METRIC_SCALE, RELATIVE_POSE, Fuser
from vioframe.learning.holder import NetHolder
from vioframe.types import Measurement, NavState, SensorRig
from vioframe_lstm.options import PoseOptions, unstated_of
from vioframe_lstm.pairs import Pairs, doubles, joined, pair_of, pairs_of_batch, samples_of
from vioframe_lstm.stack import Paths, joined_paths, sample_paths, visual_poses
from vioframe_lstm.warning import IntervalCheck
from vioframe_lstm.windows import chain_answers, needed_ends, stacks, starts_of, true_poses

if TYPE_CHECKING:
    from torch import Tensor, nn

    from vioframe.learning.batch import WindowBatch
    from vioframe_lstm.net.pose import PoseNet


# Options on which a file of weights must agree.
_AGREED = ("pose", "refines", "activation", "padding", "kernel", "pool", "translation_unit", "rotation_unit")


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
                for name in (
                    "pose",
                    "refines",
                    "activation",
                    "padding",
                    "kernel",
                    "pool",
                    "translation_unit",
                    "rotation_unit",
                )
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
        self._visual: deque[Array] = deque(maxlen=self._frames)
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

        self._holder.taught()
        net, frames = self._pose_net(), self._frames
        pairs = pairs_of_batch(batch, upstream, self._unstated)
        count = len(pairs)
        imu, time_s = doubles(batch.imu[:, -count:]), doubles(batch.imu_time_s[:, -count:])
        mask = batch.imu_mask[:, -count:].cpu().numpy()
        paths = sample_paths(imu, time_s, mask, pairs.duration_s, self._poses)
        answered = max(count - frames + 1, 1)
        if net.training:
            if not float(net.interval_s):
                net.interval_s.fill_(float(np.median(pairs.duration_s)))
            ends = sorted((torch.randperm(count)[: self._options.answers] + 1).tolist())
        else:
            ends = needed_ends(count, answered, frames)
        T_start = visual_poses(pairs)[:, starts_of(ends, frames)] if self._absolute else None
        answers = self._ask(stacks(pairs, paths, ends, frames, T_start)).reshape(-1, len(ends), 4, 4)
        told = {"fused_poses": answers, "fused_ends": torch.tensor(ends), "fused_pairs": torch.tensor(count)}
        if net.training:
            return told
        poses = chain_answers(doubles(answers), ends, frames, absolute=self._absolute)
        row = np.stack([poses[end] for end in range(count - answered, count + 1)], axis=1)
        T_body_cam = doubles(batch.rig.T_body_cam)[:, None]
        motions = se3.inverse(T_body_cam) @ se3.inverse(row[:, :-1]) @ row[:, 1:] @ T_body_cam
        return {"T_prev_cur": torch.from_numpy(motions).to(answers), **told}

    def loss(self, outputs: "Mapping[str, Tensor]", batch: "WindowBatch") -> "dict[str, Tensor]":
        """``loss``, and mean errors in rad and m."""
        import torch

        ends, poses = outputs["fused_ends"].tolist(), outputs["fused_poses"]
        motions = doubles(batch.T_prev_cur[:, -int(outputs["fused_pairs"]) :])
        truth = true_poses(motions, doubles(batch.rig.T_body_cam), ends, self._frames, absolute=self._absolute)
        losses: dict[str, Tensor] = self.net.get_submodule("weighing")(poses, torch.from_numpy(truth).to(poses))
        return losses

    def _ask(self, shown: tuple[Array, Array, Mask]) -> "Tensor":
        """The net's poses (W, 4, 4) of stacks."""
        import torch

        R, p, present = shown
        device = self.net.get_parameter("weighing.log_variance_rotation").device
        rotation = torch.from_numpy(so3.log(R).astype(np.float32)).to(device)
        position = torch.from_numpy(p.astype(np.float32)).to(device)
        answers: Tensor = self._pose_net()(rotation, position, torch.from_numpy(present.copy()).to(device))
        if not self._options.refines:
            return answers
        # The first of the poses of each frame is the VO's.
        visual = torch.from_numpy(se3.from_parts(R[:, -1, 0], p[:, -1, 0]).astype(np.float32)).to(device)
        return visual @ answers

    def _answer(self, measurement: Measurement) -> Array:
        """T_world_body at the window's end."""
        import torch

        pair = pair_of(measurement, self._T_body_cam, self._unstated)
        samples, times = samples_of(measurement)
        path = sample_paths(samples, times, np.ones(times.shape, dtype=np.bool_), pair.duration_s, self._poses)
        self._past.append((pair, path))
        pairs, paths = joined([one for one, _ in self._past]), joined_paths([one for _, one in self._past])
        T_start = self._visual[0][None, None] if self._absolute else None
        with torch.inference_mode():
            T = doubles(self._ask(stacks(pairs, paths, [len(pairs)], self._frames, T_start)))[0]
        if self._absolute:
            before, after = visual_poses(pairs)[0, -2:]
            self._visual.append(self._visual[-1] @ se3.inverse(before) @ after)
        T_world_body: Array = (self._T_world_first if self._absolute else self._states[0]) @ T
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
        self._past.clear()
        self._states.clear()
        self._visual.clear()
        self._states.append(self._T_world_body)
        self._visual.append(np.eye(4))
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
