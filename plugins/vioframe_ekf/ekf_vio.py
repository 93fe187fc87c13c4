"""``fuser=ekf_vio``: a robocentric Kalman filter that learns how far to believe each sensor."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from vioframe.checks import check_not_negative, check_positive
from vioframe.errors import ConfigError
from vioframe.fusion_options import InertialOptions, StandstillOptions, StartOptions, VisualOptions
from vioframe.learning.holder import NetHolder
from vioframe.loose_fusion import VisualMotion
from vioframe.metric_fusion import RelativePoseFuser
from vioframe.types import ImuBias, InertialDelta, Measurement, NavState, SensorRig

if TYPE_CHECKING:
    from torch import Tensor, nn

    from vioframe.error_state import InertialFilter
    from vioframe.learning.batch import WindowBatch
    from vioframe_ekf.net.noise import FilterNoise


@dataclass(frozen=True, slots=True, kw_only=True)
class ImuTrust:
    """How far inertial samples are believed, as they come out of the sensor on its vehicle.

    Not the data sheet's: it states the noise of a sensor that does not shake.

    Attributes:
        gyro_noise: rad/s/√Hz.
        gyro_walk: rad/s²/√Hz, of its bias.
        accel_noise: m/s²/√Hz.
        accel_walk: m/s³/√Hz, of its bias.
        learn: learn factors on the four, and on the sigmas of both biases that ``start`` states.
        gravity_sigma: m/s², of the size of gravity.
        gap_allowed_s: a longer hole between samples widens the covariance.
        gap_rate_sigma: rad/s, unknown rate inside such a hole.
        gap_accel_sigma: m/s², unknown acceleration inside such a hole.
    """

    gyro_noise: float = 1e-3
    gyro_walk: float = 1e-5
    accel_noise: float = 1e-2
    accel_walk: float = 1e-3
    learn: bool = False
    gravity_sigma: float = 1e-4
    gap_allowed_s: float = 0.05
    gap_rate_sigma: float = 0.5
    gap_accel_sigma: float = 2.0

    def __post_init__(self) -> None:
        check_positive("fuser.inertial", gyro_noise=self.gyro_noise, accel_noise=self.accel_noise)
        check_not_negative(
            "fuser.inertial", gyro_walk=self.gyro_walk, accel_walk=self.accel_walk, gravity_sigma=self.gravity_sigma
        )

    @property
    def densities(self) -> tuple[float, float, float, float]:
        """Of gyro, accelerometer, and their biases."""
        return self.gyro_noise, self.accel_noise, self.gyro_walk, self.accel_walk

    def options(self) -> InertialOptions:
        """What the fuser around the filter takes; noise that adapts itself would be no function of a window."""
        return InertialOptions(
            adapt_most=1.0,
            gap_allowed_s=self.gap_allowed_s,
            gap_rate_sigma=self.gap_rate_sigma,
            gap_accel_sigma=self.gap_accel_sigma,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class LearningOptions:
    """What is learned of the filter, and from what.

    Attributes:
        learns_from: ``answers`` of a VO that is finished, or ``images``, together with the VO.
        window: pairs of images that the filter has seen before what it answers counts in validation.
        decades: powers of ten by which a variance can change at most (β).
        slope: of that change by its weight (γ).
        relative, absolute, likelihood: weights of the terms of the loss; see the README.
        relative_rotation: κ1, m²/rad².
        absolute_rotation: κ2, m².
        draw_start: begin training windows with pose, velocity and gravity that are wrong by a draw from their
            covariance.
    """

    learns_from: Literal["answers", "images"] = "answers"
    window: int = 32
    decades: float = 3.0
    slope: float = 10.0
    relative: float = 3.0
    absolute: float = 3.0
    likelihood: float = 1.0
    relative_rotation: float = 100.0
    absolute_rotation: float = 500.0
    draw_start: bool = True

    def __post_init__(self) -> None:
        if self.learns_from not in ("answers", "images"):
            raise ConfigError(f"fuser.learning.learns_from must be answers or images, got {self.learns_from!r}")
        if not isinstance(self.window, int) or self.window < 1:
            raise ConfigError(f"fuser.learning.window must be a whole number of 1 or more, got {self.window!r}")
        check_positive("fuser.learning", decades=self.decades, slope=self.slope)
        terms = {"relative": self.relative, "absolute": self.absolute, "likelihood": self.likelihood}
        check_not_negative("fuser.learning", **terms)
        if not any(terms.values()):
            raise ConfigError(
                "fuser.learning: relative, absolute and likelihood are all 0, so there is nothing to learn"
            )
        check_positive(
            "fuser.learning", relative_rotation=self.relative_rotation, absolute_rotation=self.absolute_rotation
        )


class EkfVioFuser(RelativePoseFuser):
    """Robocentric error-state Kalman filter, trained through all its steps; see the README.

    Args:
        visual: trust in the relative poses (metres), before what is learned.
        inertial: trust in the inertial samples, before what is learned.
        standstill: measuring no motion at rest; only in use, not in training.
        start: what is assumed of the first state.
        learning: what is learned, from what.
        weights: file of trained weights, in MLflow too, or None.

    Raises:
        ConfigError: an option outside its range, or torch is missing.
    """

    def __init__(
        self,
        *,
        visual: VisualOptions | None = None,
        inertial: ImuTrust | None = None,
        standstill: StandstillOptions | None = None,
        start: StartOptions | None = None,
        learning: LearningOptions | None = None,
        weights: str | None = None,
    ) -> None:
        self._trust = inertial or ImuTrust()
        super().__init__(visual=visual, inertial=self._trust.options(), standstill=standstill, start=start)
        self._learning = learning or LearningOptions()
        self._stated_start = self._start
        self._untrained = weights is None
        self._holder = NetHolder(self, "fuser", "ekf_vio", self._make, weights, "cpu", works_untrained=True)

    @property
    def learns_from(self) -> str:
        """``answers`` of a VO, or ``images`` together with it."""
        return self._learning.learns_from

    @property
    def net(self) -> "nn.Module":
        """The learned factors."""
        return self._holder.net

    @property
    def context_pairs(self) -> int:
        """Pairs that the filter has seen before an answer counts."""
        return self._learning.window

    @property
    def needs_training(self) -> bool:
        """It was given no weights: it works, but believes each sensor only as far as the options say."""
        return self._untrained

    @property
    def architecture(self) -> Mapping[str, str | int | float | bool]:
        """What a file of weights must agree with: what its factors are factors on."""
        gyro, accel, gyro_walk, accel_walk = self._trust.densities
        visual = self._visual
        return {
            "part": "ekf_vio",
            "decades": self._learning.decades,
            "slope": self._learning.slope,
            "learn_inertial": self._trust.learn,
            "gyro_noise": gyro,
            "accel_noise": accel,
            "gyro_walk": gyro_walk,
            "accel_walk": accel_walk,
            "gyro_bias_sigma": self._stated_start.gyro_bias_sigma,
            "accel_bias_sigma": self._stated_start.accel_bias_sigma,
            "covariance_scale": visual.covariance_scale,
            "rotation_sigma": visual.rotation_sigma,
            "translation_sigma": visual.translation_sigma,
            "translation_ratio": visual.translation_ratio,
        }

    def forward_batch(self, batch: "WindowBatch", upstream: "Mapping[str, Tensor]") -> "dict[str, Tensor]":
        """Run the filter over the pairs that the VO answered for, from the true velocity and gravity.

        Args:
            batch: with inertial samples; without, it can only be made to coast.
            upstream: ``"T_prev_cur"`` (B, S', 4, 4) of the last S' pairs, and where there are, ``"valid"`` (B, S'),
                ``"covariance"`` (B, S', 6, 6) or ``"log_variances"`` (B, S', 6).

        Raises:
            ConfigError: no part before this one answers with motions.
        """
        from vioframe_ekf.net.training import run_filter

        self._holder.taught()
        if "T_prev_cur" not in upstream:
            raise ConfigError(
                "fuser=ekf_vio learns from the motions of a VO, which no part before it gives here: choose one, such "
                "as vo=tsvo or vo=error_model"
            )
        return run_filter(
            self._learned(),
            batch,
            upstream,
            visual=self._visual,
            gate=self._gate,
            start=self._stated_start,
            trust=self._inertial,
            gravity_sigma=self._trust.gravity_sigma,
            draw_start=self._learning.draw_start and self.net.training,
            answered=batch.pairs - self.context_pairs + 1,
        )

    def loss(self, outputs: "Mapping[str, Tensor]", batch: "WindowBatch") -> "dict[str, Tensor]":
        """``loss``, and what it is made of; see the README."""
        from vioframe_ekf.net.losses import LossWeights, filter_losses

        options = self._learning
        weights = LossWeights(
            relative=options.relative,
            absolute=options.absolute,
            likelihood=options.likelihood,
            relative_rotation=options.relative_rotation,
            absolute_rotation=options.absolute_rotation,
        )
        return filter_losses(outputs["filter_poses"], outputs["filter_covariances"], outputs["filter_truth"], weights)

    def setup(self, rig: SensorRig) -> None:
        """Forget the last sequence and take the next one's calibration.

        Raises:
            ConfigError: the rig has no camera, or there is no such file of weights.
            DataError: the file of weights cannot be used.
        """
        self._holder.prepare()
        gyro, accel = self._learned().bias_sigmas().tolist()
        self._start = replace(self._stated_start, gyro_bias_sigma=gyro, accel_bias_sigma=accel)
        self._integrated_at = ImuBias()
        super().setup(rig)

    def bias(self) -> ImuBias:
        """What the integrator should subtract: the estimate as it was when the increment's first order last held."""
        return self._integrated_at if self._ready else ImuBias()

    def update(self, measurement: Measurement) -> list[NavState]:
        """As of the interface; the increment's covariance is replaced by that of the learned densities."""
        delta = measurement.inertial_delta
        if delta is not None and len(measurement.window.imu):
            measurement = replace(measurement, inertial_delta=self._weighed(delta))
        states = super().update(measurement)
        if delta is not None and states:
            self._follow_bias(delta)
        return states

    def _weighed(self, delta: InertialDelta) -> InertialDelta:
        import torch

        from vioframe_ekf.net.increments import increment_covariance

        with torch.no_grad():
            covariance = increment_covariance(
                torch.from_numpy(delta.delta_R),
                torch.from_numpy(delta.delta_v),
                torch.tensor(delta.duration_s, dtype=torch.float64),
                self._densities[:2],
            )
        return replace(delta, covariance=covariance.numpy(), reintegrate=None)

    def _follow_bias(self, delta: InertialDelta) -> None:
        bias = self._filter.body.bias
        gyro = np.linalg.norm(bias.gyro - self._integrated_at.gyro)
        accel = np.linalg.norm(bias.accel - self._integrated_at.accel)
        if gyro > delta.max_bias_change[0] or accel > delta.max_bias_change[1]:
            self._integrated_at = bias

    def _fuse(self, motion: VisualMotion, duration_s: float) -> bool:
        used, sound = self._robocentric.measure_motion(
            motion.T_prev_cur, motion.covariance, self._T_body_cam, self._gate
        )
        if not used:
            self._count("gated VO updates" if sound else "VO covariances that are none")
        return used

    def _new_filter(self) -> "InertialFilter":
        import torch

        from vioframe_ekf.net.stream import RobocentricFilter

        with torch.no_grad():
            noise = self._learned()
            self._densities: Tensor = noise.densities()
            self._robocentric = RobocentricFilter(
                gravity=self._gravity,
                gravity_sigma=self._trust.gravity_sigma,
                densities=self._densities,
                visual_factors=noise.visual_factors(),
            )
        return self._robocentric

    def _learned(self) -> "FilterNoise":
        from vioframe_ekf.net.noise import FilterNoise

        net = self.net
        if not isinstance(net, FilterNoise):
            raise ConfigError(f"fuser=ekf_vio cannot work with a net of type {type(net).__name__}")
        return net

    def _make(self) -> "nn.Module":
        from vioframe_ekf.net.noise import FilterNoise

        return FilterNoise(
            densities=self._trust.densities,
            bias_sigmas=(self._stated_start.gyro_bias_sigma, self._stated_start.accel_bias_sigma),
            decades=self._learning.decades,
            slope=self._learning.slope,
            learn_inertial=self._trust.learn,
        )
