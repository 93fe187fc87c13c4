"""What flows between the common shell of a tightly coupled estimator and its method."""

from dataclasses import dataclass

from vioframe.checks import Array
from vioframe.types import ImuNoise, InertialDelta, Measurement, NavState, SyncedWindow, Tracks
from vioframe.vision.keypoints import Keypoints


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Start:
    """Where an estimator begins.

    Attributes:
        state: with its covariance (15, 15), at ``state.stamp_ns``; the world's z axis is up.
        method: ``rest``, ``motion`` or ``given``.
        T_body_cam: (4, 4) of camera 0 where the start found it otherwise than calibrated, else None.
        rotation_sigma: rad, standard deviation of its rotation, where it was found.
        camera_delay_s: s, of the camera's clock, with what the stamps of the windows contain of it already
            (``t_imu = t_cam + delay``); None where only the rig knows.
        replay: the windows after ``state.stamp_ns`` that have already been seen, oldest first: the estimator
            goes through them again from here, so that what they hold is not lost (and not used twice: the
            covariance of ``state`` must be wide enough to stand for a guess).
    """

    state: NavState
    method: str
    T_body_cam: Array | None = None
    rotation_sigma: float = 0.0
    camera_delay_s: float | None = None
    replay: tuple[Measurement, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Step:
    """One window as a tightly coupled estimator sees it.

    Attributes:
        window: inertial samples and stamps; ``window.camera_delay_ns`` is the delay that its stamps contain.
        delta: increment over the window, at the estimator's bias, with the trust in it, holes included.
        noise: densities that the samples of the window are believed with, holes apart.
        tracks: points in camera 0 at ``window.current``; empty where no image came.
        stereo: the same points in camera 1, as far as found, or None.
        untracked: described points of camera 0 beside the tracks, or None.
        at_rest: the body seems to stand still.
    """

    window: SyncedWindow
    delta: InertialDelta
    noise: ImuNoise
    tracks: Tracks
    stereo: Tracks | None
    at_rest: bool
    untracked: Keypoints | None = None

    @property
    def stamp_ns(self) -> int:
        """At the end of the window."""
        return self.window.current.stamp_ns


@dataclass(frozen=True, slots=True, kw_only=True)
class Support:
    """How far the images of one window supported the new state.

    Attributes:
        used: observations that were used, of any kind.
        refused: observations that a gate refused.
        points: points that the estimator now holds in three dimensions.
        at_rest: a standstill was measured.
    """

    used: int = 0
    refused: int = 0
    points: int = 0
    at_rest: bool = False
