"""When an image was truly exposed: known to the recording alone, and to what simulates a camera from the truth.

A fault may move the stamp of a frame, and a fuser may re-estimate the delay of the camera; the picture stays that of
one instant. A part that draws its answers from the truth instead of from pixels must ask for that instant, or it would
follow whatever the stamps say and never see such an error.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from vioframe.types import Frame, Packet


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ExposedFrame(Frame):
    """A frame that also knows its instant; estimators see a :class:`Frame`, whose stamp is all they are told.

    Attributes:
        exposed_ns: IMU clock, the true instant.
    """

    exposed_ns: int


def exposure_ns(frame: Frame) -> int:
    """The true instant of a frame on the IMU clock; its stamp where nothing else is known."""
    return frame.exposed_ns if isinstance(frame, ExposedFrame) else frame.stamp_ns


def with_exposures(packets: Iterable[Packet], delay_ns: int) -> Iterator[Packet]:
    """Let every frame know its instant, which for those that do not yet is ``stamp + delay_ns``."""
    for packet in packets:
        if isinstance(packet, Frame) and not isinstance(packet, ExposedFrame):
            yield ExposedFrame(stamp_ns=packet.stamp_ns, images=packet.images, exposed_ns=packet.stamp_ns + delay_ns)
        else:
            yield packet
