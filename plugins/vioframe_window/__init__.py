"""Tightly coupled fixed-lag smoother on gtsam, with loop closure."""

from vioframe_window.fuser import WindowFuser
from vioframe_window.options import LandmarkOptions, WindowOptions

__all__ = ["LandmarkOptions", "WindowFuser", "WindowOptions"]
