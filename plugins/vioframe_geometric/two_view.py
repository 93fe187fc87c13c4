"""``vo=twoview``: rotation and direction of the translation between two images, without a memory."""

from typing import ClassVar

import numpy as np

from vioframe.checks import Array
from vioframe.errors import ConfigError, DataError, StateError
from vioframe.geometry import se3
from vioframe.interfaces import RELATIVE_POSE, TRACKS, VOEstimator
from vioframe.types import Camera, RelativePose, SensorRig, Tracks, VisualFeatures
from vioframe_geometric.epipolar import TwoViewFit, fit_rotation, fit_two_view, pair, parallax_px

_INLIER = 3.0
# The length of the translation is one by definition; this variance says that nothing is known of it.
_LENGTH_VARIANCE = 1.0
# With little parallax the cost is far from quadratic; measured on simulated walks, the squared error over the
# covariance is 3.5, 1.9, 1.5 and 0.8 times its expectation at 9, 18, 27 and 45 standard deviations of parallax.
_RUGGED = 18.0


def common_points(previous: Tracks, current: Tracks) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the points seen in both."""
    _, first, second = np.intersect1d(previous.ids, current.ids, assume_unique=True, return_indices=True)
    return first, second


class TwoViewVO(VOEstimator):
    """Essential matrix by USAC, refined on the Sampson distance; the translation has length one.

    Args:
        sigma_px: standard deviation of a pixel coordinate.
        threshold_px: of USAC, distance from the epipolar line.
        min_points: fewer common points give no motion.
        min_parallax_px: a smaller median displacement beyond rotation gives no motion: its direction is noise.
        max_direction_deg: a larger standard deviation of the direction gives no motion.

    Raises:
        ConfigError: an option that is not positive.
    """

    requires: ClassVar[frozenset[str]] = frozenset({TRACKS})
    provides: ClassVar[frozenset[str]] = frozenset({RELATIVE_POSE})

    def __init__(
        self,
        *,
        sigma_px: float = 0.5,
        threshold_px: float = 1.0,
        min_points: int = 15,
        min_parallax_px: float = 3.0,
        max_direction_deg: float = 20.0,
    ) -> None:
        require_positive(
            sigma_px=sigma_px,
            threshold_px=threshold_px,
            min_parallax_px=min_parallax_px,
            max_direction_deg=max_direction_deg,
        )
        if min_points < 8:
            raise ConfigError(f"vo.min_points must be at least 8, got {min_points}")
        self._sigma = sigma_px
        self._threshold = threshold_px
        self._min_points = min_points
        self._min_parallax = min_parallax_px
        self._max_direction = np.radians(max_direction_deg)
        self._camera: Camera | None = None

    def setup(self, rig: SensorRig) -> None:
        """Take the calibration of camera 0."""
        self._camera = first_camera(rig, "twoview")

    def estimate(self, previous: VisualFeatures, current: VisualFeatures) -> RelativePose:
        """Motion of camera 0 with a translation of length one; invalid where its direction is not observable."""
        if self._camera is None:
            raise StateError("TwoViewVO.estimate was called before setup(rig): set it up first")
        if previous.tracks is None or current.tracks is None:
            return RelativePose.invalid()
        first, second = common_points(previous.tracks, current.tracks)
        if len(first) < self._min_points:
            return RelativePose.invalid()
        camera = self._camera
        focal = float(np.mean(camera.intrinsics_px[:2]))
        pairs = pair(camera, previous.tracks.bearings[first], current.tracks.bearings[second])
        parallax = float(np.median(parallax_px(pairs, fit_rotation(pairs), focal)))
        if parallax < self._min_parallax:
            return RelativePose.invalid()
        fit = fit_two_view(pairs, focal_px=focal, sigma_px=self._sigma, threshold_px=self._threshold)
        if fit is None:
            return RelativePose.invalid()
        inliers = int((fit.errors < _INLIER).sum())
        # The measured spread, when larger than the stated one, is believed.
        inflation = max(1.0, float(np.median(fit.errors)) / 0.6745) ** 2
        inflation *= 1.0 + _RUGGED * self._sigma / parallax
        covariance = unit_covariance(fit, inflation)
        direction = inflation * np.linalg.eigvalsh(fit.covariance[3:, 3:])[-1]
        agreed = inliers >= max(self._min_points, 0.5 * len(pairs))
        valid = agreed and not fit.ambiguous and direction < self._max_direction**2
        return RelativePose(
            T_prev_cur=se3.from_parts(fit.R_prev_cur, fit.t), covariance=covariance, valid=bool(valid), inliers=inliers
        )


def unit_covariance(fit: TwoViewFit, inflation: float) -> Array:
    """(6, 6) of the right perturbation (rotation, translation): the fit's five directions and an unknown length."""
    spread = np.zeros((6, 5))
    spread[:3, :3] = np.eye(3)
    spread[3:, 3:] = fit.R_prev_cur.T @ fit.tangents
    covariance = inflation * spread @ fit.covariance @ spread.T
    along = np.zeros(6)
    along[3:] = fit.R_prev_cur.T @ fit.t
    full: Array = covariance + _LENGTH_VARIANCE * np.outer(along, along)
    return full


def first_camera(rig: SensorRig, name: str) -> Camera:
    """Camera 0 of the rig.

    Raises:
        DataError: there is none.
    """
    if not rig.cameras:
        raise DataError(f"vo={name} needs a camera, but the recording's calibration has none")
    return rig.cameras[0]


def require_positive(**options: float) -> None:
    """Refuse options that are not positive.

    Raises:
        ConfigError: with the option's key and value.
    """
    for option, value in options.items():
        if not value > 0:
            raise ConfigError(f"vo.{option} must be positive, got {value}")
