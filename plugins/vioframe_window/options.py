"""The options of the fixed-lag smoother, in the groups that its YAML nests."""

from dataclasses import dataclass

from vioframe.checks import check_positive
from vioframe.errors import ConfigError


@dataclass(frozen=True, slots=True, kw_only=True)
class WindowOptions:
    """Which images become keyframes, how long they stay, and how they are solved for.

    Attributes:
        lag_s: seconds a keyframe stays in the window.
        keyframe_s: seconds from one keyframe to the next.
        sparse_below: an image in which less than this share of the last keyframe's points is still seen becomes a
            keyframe before its time; 0 for never.
        iterations: Gauss–Newton steps after a keyframe.
        relinearise_above: change of a variable (rad, m, …) above which its factors are linearised again.
        covariance_every: keyframes from one computation of the covariance to the next; those between carry it on by
            the inertial samples.
    """

    lag_s: float = 2.0
    keyframe_s: float = 0.2
    sparse_below: float = 0.5
    iterations: int = 1
    relinearise_above: float = 0.005
    covariance_every: int = 3

    def __post_init__(self) -> None:
        check_positive(
            "fuser.window", lag_s=self.lag_s, keyframe_s=self.keyframe_s, relinearise_above=self.relinearise_above
        )
        if self.lag_s < 2.0 * self.keyframe_s:
            raise ConfigError(
                f"fuser.window.lag_s must span at least two keyframes ({2.0 * self.keyframe_s:g} s), got {self.lag_s}"
            )
        if not 0.0 <= self.sparse_below < 1.0:
            raise ConfigError(f"fuser.window.sparse_below must be in [0, 1), got {self.sparse_below}")
        for name in ("iterations", "covariance_every"):
            if getattr(self, name) < 1:
                raise ConfigError(f"fuser.window.{name} must be at least 1, got {getattr(self, name)}")


@dataclass(frozen=True, slots=True, kw_only=True)
class LandmarkOptions:
    """Which points enter the window, and how far their observations are believed.

    Attributes:
        most: points held at a time.
        most_new: points that enter at a keyframe; what bounds its cost.
        min_views: keyframes that must have seen a point before it enters, with one camera.
        min_parallax_deg: angle at the point between its outermost rays before it enters.
        max_error_px: largest distance of an observation from the point's projection.
        min_depth: m, along the optical axis of every camera that saw the point.
        max_depth: m.
        sigma_px: of an observation, an axis.
        huber: multiple of ``sigma_px`` from which an observation counts linearly instead of squared.
    """

    most: int = 90
    most_new: int = 30
    min_views: int = 3
    min_parallax_deg: float = 1.0
    max_error_px: float = 3.0
    min_depth: float = 0.2
    max_depth: float = 60.0
    sigma_px: float = 0.6
    huber: float = 1.8

    def __post_init__(self) -> None:
        check_positive(
            "fuser.landmarks",
            most=self.most,
            most_new=self.most_new,
            min_parallax_deg=self.min_parallax_deg,
            max_error_px=self.max_error_px,
            min_depth=self.min_depth,
            sigma_px=self.sigma_px,
            huber=self.huber,
        )
        if self.min_views < 2:
            raise ConfigError(f"fuser.landmarks.min_views must be at least 2, got {self.min_views}")
        if not self.max_depth > self.min_depth:
            raise ConfigError(
                f"fuser.landmarks.max_depth must be above min_depth ({self.min_depth:g} m), got {self.max_depth}"
            )
