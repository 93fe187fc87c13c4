"""Synchronizers: pair each image with the inertial samples since the one before."""

from vioframe_sync.interpolate import InterpolateSynchronizer
from vioframe_sync.nearest import NearestSynchronizer
from vioframe_sync.sequential_cache import SequentialCacheSynchronizer

__all__ = ["InterpolateSynchronizer", "NearestSynchronizer", "SequentialCacheSynchronizer"]
