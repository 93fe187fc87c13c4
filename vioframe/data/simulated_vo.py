"""``vo=simulated``: the true motion of the camera, spoilt by exactly the noise that it states."""

from typing import ClassVar

import numpy as np

from vioframe.checks import Array
from vioframe.conventions import seconds
from vioframe.data.exposure import exposure_ns
from vioframe.errors import ConfigError, StateError
from vioframe.geometry import se3
from vioframe.geometry.interpolation import interpolate_poses
from vioframe.interfaces import CONSISTENT_SCALE, METRIC_SCALE, RELATIVE_POSE, VOEstimator
from vioframe.types import RelativePose, SensorRig, Trajectory, VisualFeatures

# Truth is asked at frames; further from a true pose than this, the estimate is honest and says invalid.
_MAX_GAP_NS = 50_000_000


class SimulatedVO(VOEstimator):
    """An odometer with known errors, for testing what comes after it; needs no image.

    The motion between two frames is ``T_true Exp(n)`` with n ~ N(0, Σ), Σ diagonal in the tangent (rotation,
    translation) of camera 0 at the later frame; its translation is then divided by the scale. Σ grows with
    the time between the frames, so that the drift of a sequence does not depend on the frame rate. The stated
    covariance is Σ in the units of the output.

    Args:
        rotation_noise: rad/√s, each axis.
        translation_noise: m/√s, each axis.
        scale: metres per unit of the translation given out; 1 gives metres.
        scale_drift: standard deviation of the change of log scale, 1/√s.
        lost_share: expected share of motions that come as invalid.
        seed: of the noise.

    Raises:
        ConfigError: negative noise, or a scale that is not positive.
    """

    requires: ClassVar[frozenset[str]] = frozenset()

    def __init__(
        self,
        *,
        rotation_noise: float = 0.002,
        translation_noise: float = 0.01,
        scale: float = 1.0,
        scale_drift: float = 0.0,
        lost_share: float = 0.0,
        seed: int = 0,
    ) -> None:
        for name, value in (
            ("rotation_noise", rotation_noise),
            ("translation_noise", translation_noise),
            ("scale_drift", scale_drift),
        ):
            if not value >= 0.0:
                raise ConfigError(f"vo.{name} must not be negative, got {value}")
        if not scale > 0.0:
            raise ConfigError(f"vo.scale must be positive, got {scale}")
        if not 0.0 <= lost_share <= 1.0:
            raise ConfigError(f"vo.lost_share must lie in [0, 1], got {lost_share}")
        self._sigma_per_root_s = np.repeat([rotation_noise, translation_noise], 3)
        self._first_scale = scale
        self._scale_drift = scale_drift
        self._lost_share = lost_share
        self._seed = seed
        metric = scale == 1.0 and scale_drift == 0.0
        # What it provides depends on its options, so the instance says it, not the class.
        self.provides = frozenset(  # type: ignore[misc]
            {RELATIVE_POSE, METRIC_SCALE} if metric else {RELATIVE_POSE, CONSISTENT_SCALE}
        )
        self._truth: Trajectory | None = None
        self._T_body_cam: Array = np.eye(4)
        self._scale = scale
        self._rng = np.random.default_rng(seed)

    def setup(self, rig: SensorRig) -> None:
        """Take the mounting of camera 0, and begin the noise anew."""
        self._T_body_cam = rig.cameras[0].T_body_cam if rig.cameras else np.eye(4)
        self._scale = self._first_scale
        self._rng = np.random.default_rng(self._seed)

    def take_ground_truth(self, trajectory: Trajectory) -> None:
        """Receive the true trajectory of the body."""
        self._truth = trajectory

    def estimate(self, previous: VisualFeatures, current: VisualFeatures) -> RelativePose:
        """The noisy motion between the instants of the two frames, whatever their stamps say.

        Raises:
            StateError: the truth was never given.
        """
        if self._truth is None:
            raise StateError(
                "vo=simulated has no ground truth: choose a dataset that has one, "
                "or call take_ground_truth(trajectory) after setup"
            )
        stamps = np.array([exposure_ns(previous.frame), exposure_ns(current.frame)])
        poses, covered = interpolate_poses(self._truth, stamps, max_gap_ns=_MAX_GAP_NS)
        # Drawn in any case, so that a lost motion does not change the noise of the others.
        draws = self._rng.standard_normal(7)
        lost = self._rng.uniform() < self._lost_share
        elapsed_s = seconds(int(stamps[1] - stamps[0]))
        self._scale *= float(np.exp(self._scale_drift * np.sqrt(elapsed_s) * draws[6]))
        if lost or not covered.all():
            return RelativePose.invalid()
        T_world_cam = poses @ self._T_body_cam
        T_prev_cur = se3.inverse(T_world_cam[0]) @ T_world_cam[1]
        sigma = self._sigma_per_root_s * np.sqrt(elapsed_s)
        T_noisy = T_prev_cur @ se3.exp(sigma * draws[:6])
        T_noisy[:3, 3] /= self._scale
        sigma = sigma / np.repeat([1.0, self._scale], 3)
        return RelativePose(T_prev_cur=T_noisy, covariance=np.diag(sigma**2), inliers=100)
