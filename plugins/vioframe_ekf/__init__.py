"""Loosely coupled error-state Kalman filters: one as it is stated, and one that is trained."""

from vioframe_ekf.ekf_vio import EkfVioFuser, ImuTrust, LearningOptions
from vioframe_ekf.fuser import EkfFuser

__all__ = ["EkfFuser", "EkfVioFuser", "ImuTrust", "LearningOptions"]
