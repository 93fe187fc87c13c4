"""The protocol of an evaluation of features: what must be equal for two numbers to be comparable."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass

from vioframe.checks import check_not_negative, check_positive
from vioframe.errors import ConfigError

EPSILONS_PX = tuple(range(1, 13))
"""Thresholds of the homography's corner error that are reported, as the paper of CNN-VINS draws them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FeatureProtocol:
    """``protocol=``: how features are found and judged, the same for all methods.

    Attributes:
        name: what it is called in tables.
        width: px of the pictures; every picture is scaled to cover width × height and cut to it around its middle.
        height: px.
        points: most keypoints of a picture, the strongest.
        suppression_px: a keypoint gives way to a stronger one in the square of this half side around it.
        border_px: no keypoints nearer to the edge of either picture.
        correct_px: two keypoints are the same point up to this distance.
        shared_only: choose the points inside the area that both pictures show; else in the whole picture: those outside
            it count in no share, but mislead the matching and the homography.
        max_distance: of a match, for float descriptors, which are unit vectors; None for no limit. Bits have none.
        ransac_px: a match within this distance of a homography agrees with it.
        ransac_iterations: most homographies that are tried.
        ransac_confidence: of having tried one from correct matches alone, at which the trying ends.

    Raises:
        ConfigError: with the key and its value.
    """

    name: str
    width: int
    height: int
    points: int
    suppression_px: int
    border_px: int
    correct_px: float
    shared_only: bool
    max_distance: float | None
    ransac_px: float
    ransac_iterations: int
    ransac_confidence: float

    def __post_init__(self) -> None:
        check_positive(
            "protocol",
            points=self.points,
            correct_px=self.correct_px,
            ransac_px=self.ransac_px,
            ransac_iterations=self.ransac_iterations,
        )
        check_not_negative("protocol", suppression_px=self.suppression_px, border_px=self.border_px)
        for key, value in (("width", self.width), ("height", self.height)):
            if value < 32 + 2 * self.border_px:
                raise ConfigError(
                    f"protocol.{key} must be at least 32 beside twice border_px={self.border_px}, got {value}"
                )
        if not 0.0 < self.ransac_confidence < 1.0:
            raise ConfigError(f"protocol.ransac_confidence must lie between 0 and 1, got {self.ransac_confidence}")
        if self.max_distance is not None:
            check_positive("protocol", max_distance=self.max_distance)

    @property
    def size_px(self) -> tuple[int, int]:
        """(width, height)."""
        return self.width, self.height

    def sentence(self) -> str:
        """The protocol in one line, for small print."""
        where = "the area both pictures show" if self.shared_only else "the whole picture"
        limit = "" if self.max_distance is None else f", at most {self.max_distance:g} apart"
        return (
            f"{self.name}: {self.height}×{self.width} px, {self.points} strongest points of {where}, suppression "
            f"{self.suppression_px} px, border {self.border_px} px, correct within {self.correct_px:g} px; mutual "
            f"nearest neighbours{limit}; homography by RANSAC, {self.ransac_px:g} px"
        )

    def document(self) -> Mapping[str, object]:
        """Plain values for a file."""
        return asdict(self)
