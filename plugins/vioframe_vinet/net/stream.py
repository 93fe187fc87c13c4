"""What the fuser does with a stream: one window after the other, remembering."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from vioframe.checks import Array
from vioframe.geometry import se3, so3
from vioframe.learning.motion import covariance_from_log_variances
from vioframe.pose_chain import LastingErrors
from vioframe.types import SyncedWindow
from vioframe_vinet.net.core import CoreAnswer, CoreState
from vioframe_vinet.net.seeing import seen_in_window
from vioframe_vinet.net.teaching import axes_of_answer
from vioframe_vinet.options import NetOptions


class Moved(NamedTuple):
    """Motion of the body over a window.

    Attributes:
        motion: (4, 4).
        covariance: (6, 6) of what is new in its error, right perturbation, or None where none is stated.
        lasting: what its error shares with others', or None.
    """

    motion: Array
    covariance: Array | None
    lasting: LastingErrors | None


class Stream:
    """A net and what it remembers.

    Args:
        net: as :func:`vioframe_vinet.net.assembly.make_net` makes it, in use.
        options: of it.
        T_body_cam: (4, 4).
        device: of the net.
    """

    def __init__(self, net: nn.Module, options: NetOptions, T_body_cam: Array, device: torch.device) -> None:
        self._core = net.get_submodule("core")
        self._options = options
        camera = torch.from_numpy(T_body_cam.astype(np.float32)).to(device)
        self._axes = axes_of_answer(options.axes, camera)
        self._T_body_axes = T_body_cam if options.axes == "camera" else np.eye(4)
        self._state: CoreState | None = None

    def forget(self) -> None:
        """Begin anew."""
        self._state = None

    def rest(self) -> None:
        """After a hole of unknown length: forget what was seen, not what is known of the gyro."""
        self._state = None if self._state is None else self._state.rested()

    def answer(self, embedding: Array | None, window: SyncedWindow) -> Moved | None:
        """What the net answers; None if it is no number.

        Args:
            embedding: (D,), or None where an image is missing.
            window: with the inertial samples.
        """
        options = self._options
        with torch.inference_mode():
            seen = seen_in_window(
                window, embedding, self._axes, size=options.embedding, intervals=options.imu_intervals
            )
            answer: CoreAnswer
            answer, self._state = self._core(seen, self._state)
            motion = _plain(answer.T_prev_cur)
            covariance: Array | None = None
            variances: Array = np.zeros(0)
            kept: Array = np.zeros(0)
            if answer.log_variances is not None and answer.lasting is not None:
                spread = covariance_from_log_variances(answer.vector.double(), answer.log_variances.double())
                covariance = _plain(spread)
                variances, kept = _plain(answer.lasting.variance), _plain(answer.lasting.kept)
            duration_s = float(seen.duration_s)
        if not all(np.isfinite(each).all() for each in (motion, variances, kept)):
            return None
        motion[:3, :3] = so3.normalise(motion[:3, :3])
        if covariance is None:
            return Moved(self._of_body(motion), None, None)
        if not np.isfinite(covariance).all():
            return None
        jacobian = np.zeros((6, 4))
        jacobian[:3, :3] = duration_s * np.eye(3)
        jacobian[3:, 3] = motion[:3, :3].T @ motion[:3, 3]
        into_body = se3.adjoint(self._T_body_axes)
        return Moved(
            self._of_body(motion),
            into_body @ covariance @ into_body.T,
            LastingErrors(jacobian=into_body @ jacobian, variances=variances, kept=kept),
        )

    def _of_body(self, motion: Array) -> Array:
        moved: Array = self._T_body_axes @ motion @ se3.inverse(self._T_body_axes)
        return moved


def _plain(batched: Tensor) -> Array:
    """The one pair of the one sequence, in double precision."""
    values: Array = batched[0, 0].double().cpu().numpy()
    return values
