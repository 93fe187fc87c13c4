"""Options that are more than one number, checked; importing this imports no torch."""

from dataclasses import dataclass
from typing import Literal, get_args

from vioframe.checks import check_positive
from vioframe.errors import ConfigError

Refinement = Literal["heat", "gradient", "none"]
REFINEMENTS: tuple[Refinement, ...] = get_args(Refinement)

WIDTHS = {"vgg": 1.0, "mobilenetv2": 1.0, "ghostnet": 1.2}
"""Encoders, and the factor on their channels that the papers have."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Encoder:
    """``encoder=``: the convolutions in front of both heads.

    Attributes:
        name: vgg, mobilenetv2 or ghostnet.
        width: factor on its channels.

    Raises:
        ConfigError: with the key and its value.
    """

    name: str
    width: float

    def __post_init__(self) -> None:
        if self.name not in WIDTHS:
            raise ConfigError(f"encoder.name must be one of {', '.join(WIDTHS)}, got {self.name!r}")
        check_positive("encoder", width=self.width)


def encoder_named(name: str) -> Encoder:
    """An encoder of the width that its paper has.

    Raises:
        ConfigError: no such encoder.
    """
    return Encoder(name=name, width=WIDTHS.get(name, 1.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class Detection:
    """Which pixels become keypoints.

    Attributes:
        keypoints: most an image.
        fewest: the threshold is lowered until there are so many.
        threshold: of the heat, at first.
        lowest_threshold: down to which it is lowered.
        suppression_px: no other point in the square of this half side around one.
        spread: choose strong ones and empty parts of the image first; otherwise the strongest.
        refinement: heat, gradient or none.
        refinement_px: half side of the window in which a point is placed.
        slot: what the user calls the part, for messages.

    Raises:
        ConfigError: with the key and its value.
    """

    keypoints: int
    fewest: int
    threshold: float
    lowest_threshold: float
    suppression_px: int
    spread: bool
    refinement: Refinement
    refinement_px: int
    slot: str

    def __post_init__(self) -> None:
        for name, good, rule in (
            ("keypoints", self.keypoints >= 1, "at least 1"),
            ("fewest", self.fewest >= 0, "not negative"),
            ("threshold", 0.0 < self.threshold < 1.0, "between 0 and 1"),
            ("lowest_threshold", 0.0 < self.lowest_threshold <= self.threshold, "above 0 and at most threshold"),
            ("suppression_px", self.suppression_px >= 0, "not negative"),
            ("refinement", self.refinement in REFINEMENTS, f"one of {', '.join(REFINEMENTS)}"),
            ("refinement_px", 1 <= self.refinement_px <= 20, "from 1 to 20"),
        ):
            if not good:
                raise ConfigError(f"{self.slot}.{name} must be {rule}, got {getattr(self, name)!r}")
