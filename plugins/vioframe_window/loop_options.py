"""The options of loop closure, in the groups that its YAML nests."""

from dataclasses import dataclass

from vioframe.checks import check_positive
from vioframe.errors import ConfigError


@dataclass(frozen=True, slots=True, kw_only=True)
class Retrieval:
    """Which keyframes are remembered, and which of them may show the place of a new one.

    Attributes:
        spacing_m: a keyframe is remembered when the body has moved this far since the last one.
        spacing_deg: or has turned this far.
        corners: most corners described beside the tracked points.
        threshold: of FAST, grey levels.
        cell_px: at most one such corner in a square of this side.
        branching: children of a node of the vocabulary.
        leaf_capacity: descriptors of a word before it divides.
        exclude_s: keyframes younger than this are no candidates.
        candidates: most candidates verified for a keyframe.
        min_similarity: of a candidate, as a share of the similarity of the keyframe just before.
        most: keyframes remembered; beyond that, every second of the older half is forgotten.
    """

    spacing_m: float = 0.2
    spacing_deg: float = 10.0
    corners: int = 250
    threshold: int = 20
    cell_px: int = 24
    branching: int = 8
    leaf_capacity: int = 150
    exclude_s: float = 15.0
    candidates: int = 3
    min_similarity: float = 0.15
    most: int = 2000

    def __post_init__(self) -> None:
        check_positive(
            "loop.retrieval",
            spacing_m=self.spacing_m,
            spacing_deg=self.spacing_deg,
            threshold=self.threshold,
            cell_px=self.cell_px,
            exclude_s=self.exclude_s,
            candidates=self.candidates,
        )
        if self.corners < 0:
            raise ConfigError(f"loop.retrieval.corners must not be negative, got {self.corners}")
        if self.branching < 2 or self.leaf_capacity < 2 * self.branching:
            raise ConfigError(
                "loop.retrieval needs branching of at least 2 and leaf_capacity of at least twice that, got "
                f"{self.branching} and {self.leaf_capacity}"
            )
        if not 0.0 <= self.min_similarity < 1.0:
            raise ConfigError(f"loop.retrieval.min_similarity must be in [0, 1), got {self.min_similarity}")
        if self.most < 10:
            raise ConfigError(f"loop.retrieval.most must be at least 10, got {self.most}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Verification:
    """What makes a candidate a match.

    Attributes:
        sure_distance: differing bits of 256 between a landmark's descriptor and its corner in the old image, as long
            as nothing is known about the pose.
        sure_share: of ``min_matches`` that must be found so.
        max_distance: differing bits, near the landmark's projection.
        samples: most poses tried from three points.
        inlier_px: largest distance of a corner from the landmark's projection.
        search_px: how far from its projection a landmark is looked for again, once there is a pose.
        min_matches: landmarks that must agree with the pose.
        max_tilt_deg: angle between the directions of gravity as the two keyframes know it and the pose says.
        max_yaw_deg: largest turn between the two views, about gravity.
        max_distance_m: largest distance between the two views.
        max_drift: largest correction of the present place, as a share of the way walked since the old keyframe.
        max_drift_m: what is allowed beside that share.
    """

    sure_distance: int = 50
    sure_share: float = 0.7
    max_distance: int = 80
    samples: int = 100
    inlier_px: float = 3.0
    search_px: float = 12.0
    min_matches: int = 30
    max_tilt_deg: float = 1.5
    max_yaw_deg: float = 30.0
    max_distance_m: float = 20.0
    max_drift: float = 0.1
    max_drift_m: float = 2.0

    def __post_init__(self) -> None:
        check_positive(
            "loop.verification",
            sure_distance=self.sure_distance,
            max_distance=self.max_distance,
            samples=self.samples,
            inlier_px=self.inlier_px,
            search_px=self.search_px,
            max_tilt_deg=self.max_tilt_deg,
            max_yaw_deg=self.max_yaw_deg,
            max_distance_m=self.max_distance_m,
            max_drift=self.max_drift,
            max_drift_m=self.max_drift_m,
        )
        if not 0.0 <= self.sure_share <= 1.0:
            raise ConfigError(f"loop.verification.sure_share must be in [0, 1], got {self.sure_share}")
        if self.min_matches < 6:
            raise ConfigError(f"loop.verification.min_matches must be at least 6, got {self.min_matches}")


@dataclass(frozen=True, slots=True, kw_only=True)
class GraphOptions:
    """How far the steps of the odometry and the matches are believed.

    Attributes:
        neighbours: keyframes before a keyframe to which the odometry ties it.
        step_sigma_m: of a step of one keyframe, an axis.
        step_sigma_share: of its length, added to that.
        step_sigma_yaw_deg: of a step.
        match_sigma_m: of a match, an axis, beside what its points tell.
        match_sigma_yaw_deg: of a match, likewise.
        huber: multiple of these from which a match counts linearly instead of squared.
        interrupted: factor on the sigmas of a step during which the odometry started again.
        iterations: most Gauss–Newton steps at a time.
        solve_above: a match further off than this multiple of its sigmas is taken into account at once; others
            wait for the next such one, or for the end.
    """

    neighbours: int = 4
    step_sigma_m: float = 0.01
    step_sigma_share: float = 0.05
    step_sigma_yaw_deg: float = 0.2
    match_sigma_m: float = 0.05
    match_sigma_yaw_deg: float = 0.5
    huber: float = 5.0
    interrupted: float = 20.0
    iterations: int = 5
    solve_above: float = 1.0

    def __post_init__(self) -> None:
        check_positive(
            "loop.graph",
            solve_above=self.solve_above,
            neighbours=self.neighbours,
            step_sigma_m=self.step_sigma_m,
            step_sigma_yaw_deg=self.step_sigma_yaw_deg,
            match_sigma_m=self.match_sigma_m,
            match_sigma_yaw_deg=self.match_sigma_yaw_deg,
            huber=self.huber,
            interrupted=self.interrupted,
            iterations=self.iterations,
        )
        if self.step_sigma_share < 0.0:
            raise ConfigError(f"loop.graph.step_sigma_share must not be negative, got {self.step_sigma_share}")
