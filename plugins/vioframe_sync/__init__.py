"""Synchronizers: pair each image with the inertial samples since the one before."""

from vioframe_sync.interpolate import InterpolateSynchronizer
from vioframe_sync.nearest import NearestSynchronizer

__all__ = ["InterpolateSynchronizer", "NearestSynchronizer"]
