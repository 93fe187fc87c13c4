"""Shi-Tomasi corners followed by pyramidal Lucas–Kanade."""

from vioframe_klt.frontend import KltFrontend

__all__ = ["KltFrontend"]
