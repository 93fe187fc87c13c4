"""The options of the filter's own part: how points are kept, measured and refused."""

from dataclasses import dataclass

from vioframe.errors import ConfigError


@dataclass(frozen=True, slots=True, kw_only=True)
class PointOptions:
    """How image points are used.

    Attributes:
        sigma_px: px, noise of an image point an axis.
        landmark_sigma_px: px, the same of a point in the state. A tracker's errors drift slowly (EuRoC replays: 0.06 px
            from one image to the next, 0.4 px over a track), and a point in the state meets the same error in
            image after image.
        clones: past camera poses that are kept; at least 3.
        landmarks: most points kept in the state; 0 keeps none.
        tracks_per_frame: most tracks that are used up at one image.
        min_observations: a shorter track is not used; at least 2.
        track_gate: a track is refused whose χ² exceeds this many times the value that 95 % of true ones stay below.
        landmark_gate: the same for a point in the state.
        landmark_parallax_deg: degrees between the outermost rays of a track that becomes a point in the state.
        min_depth_m: a point nearer to a camera that saw it is not used, nor one behind it.
        max_depth_m: a point farther than this is not used.
        max_depth_ratio: nor is a point whose depth has a larger standard deviation than this many times itself.
    """

    sigma_px: float = 0.7
    landmark_sigma_px: float = 3.0
    clones: int = 15
    landmarks: int = 30
    tracks_per_frame: int = 60
    min_observations: int = 4
    track_gate: float = 4.0
    landmark_gate: float = 1.0
    landmark_parallax_deg: float = 1.0
    min_depth_m: float = 0.1
    max_depth_m: float = 60.0
    max_depth_ratio: float = 0.2

    def __post_init__(self) -> None:
        for name in (
            "sigma_px",
            "landmark_sigma_px",
            "track_gate",
            "landmark_gate",
            "landmark_parallax_deg",
            "min_depth_m",
        ):
            if not getattr(self, name) > 0.0:
                raise ConfigError(f"fuser.points.{name} must be positive, got {getattr(self, name)}")
        for name, least in (("clones", 3), ("landmarks", 0), ("tracks_per_frame", 1), ("min_observations", 2)):
            if getattr(self, name) < least:
                raise ConfigError(f"fuser.points.{name} must be at least {least}, got {getattr(self, name)}")
        if not self.max_depth_m > self.min_depth_m:
            raise ConfigError(
                f"fuser.points.max_depth_m must exceed min_depth_m, got {self.max_depth_m} and {self.min_depth_m}"
            )
        if self.min_observations > self.clones:
            raise ConfigError(
                f"fuser.points.min_observations must not exceed clones, got {self.min_observations} and {self.clones}"
            )
