"""Learned odometry: two-stream TSVO with three backbones, and DeepVO. Importing this package imports no torch."""

from vioframe_tsvo.deepvo import DeepVo
from vioframe_tsvo.tsvo import Backbone, Tsvo

__all__ = ["Backbone", "DeepVo", "Tsvo"]
