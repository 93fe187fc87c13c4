"""Loosely coupled filter with scale, vision-frame drift and delayed measurements."""

from vioframe_msf.fuser import DriftOptions, ExtrinsicsOptions, MsfFuser, ScaleOptions

__all__ = ["DriftOptions", "ExtrinsicsOptions", "MsfFuser", "ScaleOptions"]
