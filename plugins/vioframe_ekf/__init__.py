"""Loosely coupled error-state Kalman filter."""

from vioframe_ekf.fuser import EkfFuser

__all__ = ["EkfFuser"]
