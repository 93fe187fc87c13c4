"""ORB keypoints matched by their binary descriptors, with lasting ids."""

from vioframe_orb.frontend import OrbFrontend

__all__ = ["OrbFrontend"]
