"""``fuser=vinet``: motion from an embedding of the images and the raw inertial samples, by one recurrent net."""

import logging
from collections import Counter
from collections.abc import Mapping
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from vioframe.checks import Array, check_not_negative, check_positive
from vioframe.conventions import seconds
from vioframe.errors import ConfigError, DataError, StateError
from vioframe.geometry import se3, so3
from vioframe.interfaces import EMBEDDING, Fuser
from vioframe.learning.holder import NetHolder
from vioframe.pose_chain import PoseChain
from vioframe.types import Measurement, NavState, SensorRig, Status, SyncedWindow
from vioframe_vinet.options import Axes, Feedback, Loss, NetOptions, Rotation

if TYPE_CHECKING:
    from torch import Tensor, nn

    from vioframe.learning.batch import WindowBatch
    from vioframe_vinet.net.core import CoreAnswer, CoreState

log = logging.getLogger(__name__)


class VinetFuser(Fuser):
    """VINet (Clark et al. 2017): remembers from image to image without end, and states the motions it composes.

    Where images are missing it goes on with inertial samples, where those are missing with images, as it has been
    trained to; where both are, with what it remembers.

    Args:
        embedding: numbers that the front end gives for a pair of images.
        window: pairs of a training window; in use it remembers without end.
        imu_intervals: to which the inertial samples between two images are brought, whatever their rate.
        imu_hidden: neurons of each layer of the LSTM over them.
        imu_layers: its layers.
        hidden: neurons of each layer of the core's LSTM.
        layers: its layers.
        joined: neurons of the layer before the answer.
        dropout: in training, after the core and between its layers.
        axes: in which samples and motions are expressed: ``camera``, so that another mounting needs no training, or
            ``body``, for which no calibration of it is needed.
        rotation: the ``gyro``'s, corrected by what images say of its bias, or ``learned`` whole.
        gyro_bias_sigma: rad/s an axis, of that bias at first.
        gyro_memory: pairs after which what images said of it counts 1/e.
        feedback: the core sees its own ``pose`` since it began to remember, or ``none``.
        rotation_unit_rad: what an output of 1 means.
        translation_unit_m: likewise.
        loss: ``learned`` weights, or the ``likelihood`` of a Gaussian, with which it states a covariance.
        pose_weight: of the composed poses beside the motions, in training.
        log_variance_rotation: from which ``learned`` starts, ln rad².
        log_variance_translation: likewise, ln m².
        lost_images: share of training windows in which a stretch of images is left out.
        lost_imu: likewise of inertial samples.
        level: begin with roll and pitch from the first window's specific force.
        tilt_sigma: rad, of roll and pitch at such a start.
        lost_after_s: without images for longer the status is ``lost``.
        blind_rate_sigma: rad/s an axis, unknown rate of the answers' error while there are no images.
        blind_accel_sigma: m/s² an axis, unknown acceleration of it.
        weights: file of trained weights, in MLflow too, or None.
        device: ``cpu``, ``cuda`` or ``auto``.

    Raises:
        ConfigError: an option outside its range, or torch is missing.
    """

    requires: ClassVar[frozenset[str]] = frozenset({EMBEDDING})

    def __init__(
        self,
        *,
        embedding: int = 256,
        window: int = 8,
        imu_intervals: int = 10,
        imu_hidden: int = 64,
        imu_layers: int = 2,
        hidden: int = 256,
        layers: int = 2,
        joined: int = 128,
        dropout: float = 0.1,
        axes: Axes = "camera",
        rotation: Rotation = "gyro",
        gyro_bias_sigma: float = 0.01,
        gyro_memory: int = 300,
        feedback: Feedback = "none",
        rotation_unit_rad: float = 0.005,
        translation_unit_m: float = 1.0,
        loss: Loss = "likelihood",
        pose_weight: float = 1.0,
        log_variance_rotation: float = -12.0,
        log_variance_translation: float = 0.0,
        lost_images: float = 0.1,
        lost_imu: float = 0.1,
        level: bool = True,
        tilt_sigma: float = 0.02,
        lost_after_s: float = 0.5,
        blind_rate_sigma: float = 0.01,
        blind_accel_sigma: float = 0.5,
        weights: str | None = None,
        device: str = "auto",
    ) -> None:
        self._options = NetOptions(
            embedding=embedding,
            window=window,
            imu_intervals=imu_intervals,
            imu_hidden=imu_hidden,
            imu_layers=imu_layers,
            hidden=hidden,
            layers=layers,
            joined=joined,
            dropout=dropout,
            axes=axes,
            rotation=rotation,
            gyro_bias_sigma=gyro_bias_sigma,
            gyro_memory=gyro_memory,
            feedback=feedback,
            rotation_unit_rad=rotation_unit_rad,
            translation_unit_m=translation_unit_m,
            loss=loss,
            pose_weight=pose_weight,
            log_variance_rotation=log_variance_rotation,
            log_variance_translation=log_variance_translation,
            lost_images=lost_images,
            lost_imu=lost_imu,
        )
        check_positive("fuser", tilt_sigma=tilt_sigma)
        check_not_negative(
            "fuser", lost_after_s=lost_after_s, blind_rate_sigma=blind_rate_sigma, blind_accel_sigma=blind_accel_sigma
        )
        self._lost_after_s = lost_after_s
        self._chain = PoseChain(
            levelled=level, tilt_sigma=tilt_sigma, rate_sigma=blind_rate_sigma, accel_sigma=blind_accel_sigma
        )
        self._holder = NetHolder(self, "fuser", "vinet", self._make_net, weights, device)
        self._ready = False

    @property
    def net(self) -> "nn.Module":
        """``core``, the network, and ``weighing``, its loss; made when first asked for: torch is slow to import.

        Raises:
            ConfigError: there is no such file of weights.
            DataError: the file is of another architecture, or damaged.
        """
        return self._holder.net

    @property
    def context_pairs(self) -> int:
        """So many that in validation each answer remembers a window, as in training."""
        return self._options.window

    @property
    def needs_training(self) -> bool:
        """Without weights its motions are those of a random net."""
        return self._holder.needs_training

    @property
    def architecture(self) -> Mapping[str, str | int | float | bool]:
        """What a file of weights must agree with."""
        return self._options.architecture()

    def setup(self, rig: SensorRig) -> None:
        """Forget the last sequence, take the camera's place on the body, and bring the net to its device.

        Raises:
            ConfigError: the rig has no camera; a GPU or a file of weights that is not there.
            DataError: the file of weights cannot be used.
        """
        if not rig.cameras:
            raise ConfigError(
                "fuser=vinet needs the place of the camera on the body (rig.cameras[0].T_body_cam), but the recording "
                "has no camera: choose fuser=imu_only, or a recording with a camera"
            )
        self._holder.prepare()
        self._T_body_cam: Array = rig.cameras[0].T_body_cam
        self._chain.forget()
        self._given: NavState | None = None
        self._state: CoreState | None = None
        self._unseen_s = 0.0
        self._counts: Counter[str] = Counter()
        self._told_of_rate = False
        self._ready = True

    def start_from(self, state: NavState) -> None:
        """Start from the pose of a given state."""
        self._given = state

    def counters(self) -> Mapping[str, int]:
        """Windows that lacked a sensor, that never came, and whose answer was no number."""
        return dict(self._counts) if self._ready else {}

    def update(self, measurement: Measurement) -> list[NavState]:
        """Append the window's motion; the first call also gives the state at ``window.previous``.

        Raises:
            StateError: called before ``setup``.
            DataError: an embedding of another length than the net was built for.
        """
        if not self._ready:
            raise StateError("VinetFuser.update was called before setup(rig): set the fuser up first")
        window = measurement.window
        states = []
        if not self._chain.begun:
            self._chain.begin(window.previous.stamp_ns, self._given, window.imu)
            self._given = None
            states.append(self._chain.state("tracking"))
        elif self._chain.stamp_ns != window.previous.stamp_ns:
            # What it remembers is of another time.
            self._counts["missing windows"] += 1
            self._state = None if self._state is None else self._state.rested()
            self._chain.coast(window.previous.stamp_ns)
        embedding = self._embedding(measurement)
        self._account(window, seen=embedding is not None)
        found = self._answer(embedding, window)
        if found is None:
            self._counts["answers that are no numbers"] += 1
            self._state = None
            self._chain.coast(window.current.stamp_ns)
        else:
            self._chain.follow(*found, window.current.stamp_ns, known=embedding is not None)
        status: Status = "lost" if found is None or self._unseen_s > self._lost_after_s else "tracking"
        states.append(self._chain.state(status))
        return states

    def forward_batch(self, batch: "WindowBatch", upstream: "Mapping[str, Tensor]") -> "dict[str, Tensor]":
        """Motions of all pairs of each window to learn from; of those that remember a whole window as answers.

        Args:
            batch: with inertial samples.
            upstream: ``"embedding"``, (B, S, D).

        Raises:
            ConfigError: no part before this one makes embeddings in training, or they have another length.
            DataError: windows of fewer pairs than ``window``.
        """
        from vioframe.learning.motion import inverse, product
        from vioframe_vinet.net.seeing import moved_to, seen_in_batch

        if EMBEDDING not in upstream:
            raise ConfigError(
                "fuser=vinet learns from embeddings of images, which no part before it computes here: use "
                "frontend=pair_encoder"
            )
        self._check_embedding(upstream[EMBEDDING].shape[-1])
        if batch.pairs < self._options.window:
            raise DataError(
                f"windows have {batch.pairs} pairs of images, but fuser.window={self._options.window} needs as many"
            )
        self._holder.taught()
        learning = self.net.training
        axes = self._axes(batch.rig.T_body_cam)
        seen = seen_in_batch(
            batch,
            upstream[EMBEDDING],
            axes,
            intervals=self._options.imu_intervals,
            lost_images=self._options.lost_images if learning else 0.0,
            lost_imu=self._options.lost_imu if learning else 0.0,
        )
        answer, _ = self.net.get_submodule("core")(seen)
        answered = answer.T_prev_cur[:, self._options.window - 1 :]
        into_camera = product(inverse(batch.rig.T_body_cam), inverse(axes))[:, None]
        named = {
            "vector": answer.vector,
            "motion": answer.T_prev_cur,
            "T_prev_cur": moved_to(into_camera, answered),
        }
        if answer.log_variances is not None:
            named["log_variances"] = answer.log_variances
        if answer.sight is not None:
            named |= {"sight": answer.sight.vector, "sight_log_variances": answer.sight.log_variances}
            named["visible"] = seen.visible
        return named

    def loss(self, outputs: "Mapping[str, Tensor]", batch: "WindowBatch") -> "dict[str, Tensor]":
        """``loss``, and mean squared errors (rad², m²) of motions and of poses since the window began."""
        from vioframe.learning.motion import product
        from vioframe_vinet.net.core import CoreAnswer
        from vioframe_vinet.net.gyro import Sight
        from vioframe_vinet.net.loss import sight_loss
        from vioframe_vinet.net.seeing import moved_to

        T_body_cam = batch.rig.T_body_cam
        truth = moved_to(product(self._axes(T_body_cam), T_body_cam)[:, None], batch.T_prev_cur)
        answer = CoreAnswer(outputs["motion"], outputs["vector"], None)
        losses: dict[str, Tensor] = self.net.get_submodule("weighing")(answer, truth, outputs.get("log_variances"))
        if "sight" in outputs:
            sight = Sight(outputs["sight"], outputs["sight_log_variances"])
            losses["sight"] = sight_loss(sight, outputs["visible"], truth)
            losses["loss"] = losses["loss"] + losses["sight"]
            losses["sight"] = losses["sight"].detach()
        return losses

    def _embedding(self, measurement: Measurement) -> Array | None:
        """What the images of a window show; None where one of them is missing."""
        window, features = measurement.window, measurement.features
        if features is None or features.embedding is None or not window.previous.images or not window.current.images:
            return None
        self._check_embedding(len(features.embedding))
        return features.embedding

    def _check_embedding(self, length: int) -> None:
        if length != self._options.embedding:
            raise ConfigError(
                f"fuser.embedding={self._options.embedding}, but the front end gives {length} numbers: set it alike"
            )

    def _account(self, window: SyncedWindow, *, seen: bool) -> None:
        """Keep count of what is missing, and say once that samples come at another rate."""
        duration = seconds(window.current.stamp_ns - window.previous.stamp_ns)
        self._unseen_s = 0.0 if seen else self._unseen_s + duration
        if not seen:
            self._counts["windows without images"] += 1
        if len(window.imu) < 2:
            self._counts["windows without inertial samples"] += 1
        elif not self._told_of_rate and len(window.imu) - 1 != self._options.imu_intervals:
            log.info(
                "fuser=vinet brings the %d inertial intervals between two images to the %d it is made for",
                len(window.imu) - 1,
                self._options.imu_intervals,
            )
            self._told_of_rate = True

    def _answer(self, embedding: Array | None, window: SyncedWindow) -> tuple[Array, Array | None] | None:
        """Motion (4, 4) of the body over a window and its covariance (6, 6); None if they are no numbers."""
        import torch

        from vioframe.learning.motion import covariance_from_log_variances
        from vioframe_vinet.net.seeing import seen_in_window

        options = self._options
        with torch.inference_mode():
            T_body_cam = torch.from_numpy(self._T_body_cam.astype(np.float32)).to(self._holder.device())
            seen = seen_in_window(
                window, embedding, self._axes(T_body_cam), size=options.embedding, intervals=options.imu_intervals
            )
            answer: CoreAnswer
            answer, self._state = self.net.get_submodule("core")(seen, self._state)
            motion = answer.T_prev_cur[0, 0].double().cpu().numpy()
            covariance = None
            if answer.log_variances is not None:
                vector, spread = answer.vector[0, 0].double(), answer.log_variances[0, 0].double()
                covariance = covariance_from_log_variances(vector, spread).cpu().numpy()
        if not np.isfinite(motion).all() or (covariance is not None and not np.isfinite(covariance).all()):
            return None
        motion[:3, :3] = so3.normalise(motion[:3, :3])
        if options.axes == "camera":
            motion = self._T_body_cam @ motion @ se3.inverse(self._T_body_cam)
            if covariance is not None:
                into_body = se3.adjoint(self._T_body_cam)
                covariance = into_body @ covariance @ into_body.T
        return motion, covariance

    def _axes(self, T_body_cam: "Tensor") -> "Tensor":
        """T_axes_body (..., 4, 4) of the axes of the answer."""
        import torch

        from vioframe.learning.motion import inverse

        if self._options.axes == "camera":
            return inverse(T_body_cam)
        return torch.eye(4, dtype=T_body_cam.dtype, device=T_body_cam.device).expand_as(T_body_cam)

    def _make_net(self) -> "nn.Module":
        from vioframe_vinet.net.assembly import make_net

        return make_net(self._options)
