"""Options that are more than one number, checked; importing this imports no torch."""

from dataclasses import dataclass

from vioframe.checks import check_positive
from vioframe.errors import ConfigError

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
