"""One window of a stream as the nets see it."""

import logging
from typing import TYPE_CHECKING

import numpy as np

from vioframe.checks import Array
from vioframe.conventions import NANOSECONDS, seconds
from vioframe.fusion_options import InertialOptions, VisualOptions
from vioframe.types import Measurement
from vioframe_lstm.options import Unstated

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from vioframe_lstm.net.pairs import Pairs

log = logging.getLogger(__name__)

# By this factor intervals of images may differ from those of the training before it is told.
_SAME_INTERVAL = 1.5


def samples_of(measurement: Measurement, device: "torch.device") -> "tuple[Tensor, Tensor]":
    """Samples (1, 1, K, 6) and times (1, 1, K) s since the window's start."""
    imu = measurement.window.imu
    samples = np.concatenate([imu.gyro, imu.accel], axis=1)
    times = (imu.stamps_ns - measurement.window.previous.stamp_ns) / NANOSECONDS
    return _tensor(samples, device), _tensor(times, device)


def pair_of(measurement: Measurement, T_body_cam: Array, unstated: Unstated, device: "torch.device") -> "Pairs":
    """The pair (1, 1) of a window."""
    import torch

    from vioframe_lstm.net.pairs import make_pairs

    window, pose = measurement.window, measurement.relative_pose
    if pose is not None and not pose.valid:
        pose = None
    samples, times = samples_of(measurement, device)
    # A hole that somebody filled is a hole.
    whole = window.gap_ns <= unstated.longest_gap_s * NANOSECONDS
    return make_pairs(
        T_prev_cur=_tensor(np.eye(4) if pose is None else pose.T_prev_cur, device),
        covariance=None if pose is None or pose.covariance is None else _tensor(pose.covariance, device),
        valid=torch.tensor([[pose is not None]], device=device),
        imu=samples,
        imu_time_s=times,
        imu_mask=torch.full(times.shape, whole, device=device),
        duration_s=_tensor(np.array(seconds(window.current.stamp_ns - window.previous.stamp_ns)), device),
        T_body_cam=_tensor(T_body_cam, device)[0],
        unstated=unstated,
    )


def unstated_of(visual: VisualOptions, inertial: InertialOptions) -> Unstated:
    """What the filter's options assume where nothing is stated."""
    return Unstated(
        rotation_sigma=visual.rotation_sigma,
        translation_sigma=visual.translation_sigma,
        translation_ratio=visual.translation_ratio,
        longest_gap_s=inertial.gap_allowed_s,
    )


def _tensor(array: Array, device: "torch.device") -> "Tensor":
    """(1, 1, …) in single precision."""
    import torch

    return torch.from_numpy(np.array(array, dtype=np.float32)).to(device)[None, None]


class IntervalCheck:
    """Tells, once a sequence, that images come at another rate than the net has learned from.

    Args:
        learned_s: interval in training, s; zero if there was none.
    """

    def __init__(self, learned_s: float) -> None:
        self._learned_s = learned_s
        self._told = learned_s <= 0.0

    def push(self, interval_s: float) -> None:
        """Take the length of a window, s."""
        if self._told:
            return
        ratio = interval_s / self._learned_s
        if not 1.0 / _SAME_INTERVAL < ratio < _SAME_INTERVAL:
            log.warning(
                "images come every %.3g s, but fuser=lstm has learned from one every %.3g s: its answers may be poor; "
                "train it on recordings of this rate",
                interval_s,
                self._learned_s,
            )
            self._told = True
