"""``vo=error_model``: the true motion of the camera, spoilt as a learned odometer would spoil it."""

import zlib
from typing import ClassVar

import numpy as np

from vioframe.checks import Array
from vioframe.conventions import seconds
from vioframe.data.exposure import exposure_ns
from vioframe.data.vo_errors import ErrorCourse, VoErrors
from vioframe.errors import ConfigError, StateError
from vioframe.geometry import se3, so3
from vioframe.geometry.interpolation import interpolate_poses
from vioframe.interfaces import METRIC_SCALE, RELATIVE_POSE, VOEstimator
from vioframe.types import RelativePose, SensorRig, Trajectory, VisualFeatures

# KITTI's truth comes with the images, every 0.1 s; further from a true pose than this the answer is invalid.
_MAX_GAP_NS = 110_000_000
_LOST = 2


class ErrorModelVO(VOEstimator):
    """An odometer with errors that last, after :mod:`vioframe.data.vo_errors`; needs no image.

    It states the variance of each pair's error alone, as a network does that was trained pair by pair: true of every
    pair, and too little for many in a row, since their errors are correlated.

    Args:
        errors: how it errs.
        rotation_level: factor on all errors of rotation.
        translation_level: factor on all errors of translation.
        lost_share: expected share of motions that come as invalid.
        seed: of all that is drawn.

    Raises:
        ConfigError: a factor that is negative, or a share outside [0, 1].
    """

    requires: ClassVar[frozenset[str]] = frozenset()
    provides: ClassVar[frozenset[str]] = frozenset({RELATIVE_POSE, METRIC_SCALE})

    def __init__(
        self,
        *,
        errors: VoErrors,
        rotation_level: float = 1.0,
        translation_level: float = 1.0,
        lost_share: float = 0.0,
        seed: int = 0,
    ) -> None:
        for name, value in (("rotation_level", rotation_level), ("translation_level", translation_level)):
            if not 0.0 <= value < float("inf"):
                raise ConfigError(f"vo.{name} must not be negative, got {value}")
        if not 0.0 <= lost_share <= 1.0:
            raise ConfigError(f"vo.lost_share must lie in [0, 1], got {lost_share}")
        if seed < 0:
            raise ConfigError(f"vo.seed must not be negative, got {seed}")
        self._errors = errors.scaled(rotation_level, translation_level)
        self._lost_share = lost_share
        self._seed = seed
        self._T_body_cam: Array = np.eye(4)
        self._truth: Trajectory | None = None
        self._course: ErrorCourse | None = None

    def setup(self, rig: SensorRig) -> None:
        """Take the mounting of camera 0, and forget the last recording."""
        self._T_body_cam = rig.cameras[0].T_body_cam if rig.cameras else np.eye(4)
        self._truth = self._course = None

    def take_ground_truth(self, trajectory: Trajectory) -> None:
        """Receive the true trajectory of the body, and draw the errors of this recording."""
        self._truth = trajectory
        self._key = (self._seed, _name(trajectory))
        start_ns, end_ns = int(trajectory.stamps_ns[0]), int(trajectory.stamps_ns[-1])
        self._course = ErrorCourse(self._errors, start_ns, end_ns, self._key)

    def estimate(self, previous: VisualFeatures, current: VisualFeatures) -> RelativePose:
        """The spoilt motion between the instants of the two frames, whatever their stamps say.

        Raises:
            StateError: the truth was never given.
        """
        if self._truth is None or self._course is None:
            raise StateError(
                "vo=error_model has no ground truth: choose a dataset that has one, "
                "or call take_ground_truth(trajectory) after setup"
            )
        instants = [exposure_ns(previous.frame), exposure_ns(current.frame)]
        poses, covered = interpolate_poses(self._truth, np.array(instants), max_gap_ns=_MAX_GAP_NS)
        if not covered.all() or instants[1] <= instants[0] or self._lost(*instants):
            return RelativePose.invalid()
        T_world_cam = poses @ self._T_body_cam
        T_prev_cur = se3.inverse(T_world_cam[0]) @ T_world_cam[1]
        duration_s = seconds(instants[1] - instants[0])
        spoilt = self._errors.spoil(T_prev_cur, duration_s, *self._course.draw(instants[0], instants[1]))
        return RelativePose(
            T_prev_cur=spoilt, covariance=self._errors.covariance(spoilt, duration_s) + _TINY, inliers=100
        )

    def _lost(self, previous_ns: int, current_ns: int) -> bool:
        if not self._lost_share:
            return False
        instants = [stamp_ns & (2**64 - 1) for stamp_ns in (previous_ns, current_ns)]
        return bool(np.random.default_rng((*self._key, _LOST, *instants)).random() < self._lost_share)


# 0.01 mrad and 0.1 mm: with all errors switched off the covariance must still have an inverse.
_TINY = np.diag(np.repeat([1e-10, 1e-8], 3))


def _name(trajectory: Trajectory) -> int:
    """A number for the recording, which does not change with the place of the camera that looks at it.

    Simulated recordings all have the same stamps, so how the body turned is part of it; the angles of its turns
    are those of whatever is fixed to it.
    """
    R = trajectory.T_world_body[:, :3, :3]
    turned = float(so3.angle(np.swapaxes(R[:-1], -1, -2) @ R[1:]).sum())
    return zlib.crc32(trajectory.stamps_ns.tobytes() + f"{turned:.3f}".encode())
