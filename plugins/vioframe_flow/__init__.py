"""Dense optical flow: TV-L1 unrolled into a network (TVNet), and OpenCV's DIS."""

from vioframe_flow.dis import DisFrontend
from vioframe_flow.tvnet import TvnetFrontend

__all__ = ["DisFrontend", "TvnetFrontend"]
