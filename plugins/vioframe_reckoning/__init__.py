"""Fusers that use one sensor only: what each is worth alone, and the baseline for every fusion."""

from vioframe_reckoning.imu_only import ImuOnlyFuser
from vioframe_reckoning.vo_only import VoOnlyFuser

__all__ = ["ImuOnlyFuser", "VoOnlyFuser"]
