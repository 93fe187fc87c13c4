"""``fuser=vinet``: motion from an embedding of the images and the raw inertial samples, by one recurrent net."""

import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar

from vioframe.checks import Array, check_not_negative, check_positive
from vioframe.conventions import seconds
from vioframe.errors import ConfigError, StateError
from vioframe.interfaces import EMBEDDING, Fuser
from vioframe.learning.holder import NetHolder
from vioframe.pose_chain import PoseChain
from vioframe.types import Measurement, NavState, SensorRig, Status, SyncedWindow
from vioframe_vinet.options import Axes, Feedback, Loss, NetOptions, Rotation

if TYPE_CHECKING:
    from torch import Tensor, nn

    from vioframe.learning.batch import WindowBatch
    from vioframe_vinet.net.stream import Stream

log = logging.getLogger(__name__)


class VinetFuser(Fuser):
    """VINet (Clark et al. 2017): remembers from image to image without end, and states the motions it composes.

    Where images are missing it goes on with inertial samples, where those are missing with images, as it has been
    trained to; where both are, with what it remembers.

    Args:
        embedding: numbers that the front end gives for a pair of images.
        window: pairs of a training window, and those over which poses are composed; in use it remembers without end.
        settling: pairs of the windows from which it learns by itself, when it and the front end are trained.
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
        scale_memory: pairs after which 1/e is left of an error of lengths.
        feedback: the core sees its own ``pose`` since it began to remember, or ``none``.
        rotation_unit_rad: what an output of 1 means.
        translation_unit_m: likewise.
        loss: ``learned`` weights, or those and the ``likelihood`` of a Gaussian, with which it states a covariance.
        horizons: pairs over which errors are summed up for that likelihood.
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
        window: int = 16,
        settling: int = 200,
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
        scale_memory: int = 300,
        feedback: Feedback = "none",
        rotation_unit_rad: float = 0.005,
        translation_unit_m: float = 1.0,
        loss: Loss = "likelihood",
        horizons: Sequence[int] = (50, 100, 200),
        pose_weight: float = 1.0,
        log_variance_rotation: float = -12.0,
        log_variance_translation: float = -3.0,
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
            settling=settling,
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
            scale_memory=scale_memory,
            feedback=feedback,
            rotation_unit_rad=rotation_unit_rad,
            translation_unit_m=translation_unit_m,
            loss=loss,
            horizons=tuple(horizons),
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
        self._stream: Stream | None = None
        self._given: NavState | None = None

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
        """From one pair on it answers."""
        return 1

    @property
    def training_pairs(self) -> int:
        """Pairs of the windows that it learns from together with the front end."""
        return self._options.window

    @property
    def settling_pairs(self) -> int:
        """Pairs of the windows that it learns from by itself."""
        return self._options.settling

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
        from vioframe_vinet.net.stream import Stream

        net = self._holder.prepare()
        self._stream = Stream(net, self._options, rig.cameras[0].T_body_cam, self._holder.device())
        self._chain.forget()
        self._given = None
        self._unseen_s = 0.0
        self._counts: Counter[str] = Counter()
        self._told_of_rate = False

    def start_from(self, state: NavState) -> None:
        """Start from the pose of a given state."""
        self._given = state

    def counters(self) -> Mapping[str, int]:
        """Windows that lacked a sensor, that never came, and whose answer was no number."""
        return {} if self._stream is None else dict(self._counts)

    def update(self, measurement: Measurement) -> list[NavState]:
        """Append the window's motion; the first call also gives the state at ``window.previous``.

        Raises:
            StateError: called before ``setup``.
            ConfigError: an embedding of another length than the net was built for.
        """
        if self._stream is None:
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
            self._stream.rest()
            self._chain.coast(window.previous.stamp_ns)
        embedding = self._embedding(measurement)
        self._account(window, seen=embedding is not None)
        found = self._stream.answer(embedding, window)
        if found is None:
            self._counts["answers that are no numbers"] += 1
            self._stream.forget()
            self._chain.coast(window.current.stamp_ns)
        else:
            self._chain.follow(
                found.motion,
                found.covariance,
                window.current.stamp_ns,
                known=embedding is not None,
                lasting=found.lasting,
            )
        status: Status = "lost" if found is None or self._unseen_s > self._lost_after_s else "tracking"
        states.append(self._chain.state(status))
        return states

    def forward_batch(self, batch: "WindowBatch", upstream: "Mapping[str, Tensor]") -> "dict[str, Tensor]":
        """Motions of all pairs of each window.

        Args:
            batch: with inertial samples.
            upstream: ``"embedding"``, (B, S, D).

        Raises:
            ConfigError: no part before this one makes embeddings in training, or they have another length.
        """
        from vioframe_vinet.net.teaching import outputs_of_batch

        if EMBEDDING not in upstream:
            raise ConfigError(
                "fuser=vinet learns from embeddings of images, which no part before it computes here: use "
                "frontend=pair_encoder"
            )
        self._check_embedding(upstream[EMBEDDING].shape[-1])
        self._holder.taught()
        return outputs_of_batch(self.net, self._options, batch, upstream[EMBEDDING])

    def loss(self, outputs: "Mapping[str, Tensor]", batch: "WindowBatch") -> "dict[str, Tensor]":
        """``loss``, and mean squared errors (rad², m²) of motions and of poses over ``window`` pairs."""
        from vioframe_vinet.net.teaching import losses_of_batch

        return losses_of_batch(self.net, self._options, outputs, batch)

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

    def _make_net(self) -> "nn.Module":
        from vioframe_vinet.net.assembly import make_net

        return make_net(self._options)
