"""Shows a run in the Rerun viewer, live or from a file."""

from vioframe_rerun.viewer import RerunViewer

__all__ = ["RerunViewer"]
