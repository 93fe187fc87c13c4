"""OpenCV's keypoints: SIFT as a front end, and Shi-Tomasi, FAST, ORB and SIFT as features to compare with."""

from vioframe_opencv.corners import FastExtractor, ShiTomasiExtractor
from vioframe_opencv.frontend import SiftFrontend
from vioframe_opencv.orb import OrbExtractor
from vioframe_opencv.sift import SiftExtractor

__all__ = ["FastExtractor", "OrbExtractor", "ShiTomasiExtractor", "SiftExtractor", "SiftFrontend"]
