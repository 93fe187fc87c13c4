"""Tightly coupled fixed-lag smoother on gtsam, with loop closure."""

from vioframe_window.fuser import WindowFuser
from vioframe_window.loop_closer import BowLoop
from vioframe_window.loop_options import GraphOptions, Retrieval, Verification
from vioframe_window.options import LandmarkOptions, WindowOptions

__all__ = [
    "BowLoop",
    "GraphOptions",
    "LandmarkOptions",
    "Retrieval",
    "Verification",
    "WindowFuser",
    "WindowOptions",
]
