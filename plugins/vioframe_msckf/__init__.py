"""Multi-state constraint Kalman filter: tightly coupled visual-inertial odometry in numpy."""

from vioframe_msckf.fuser import MsckfFuser
from vioframe_msckf.options import PointOptions

__all__ = ["MsckfFuser", "PointOptions"]
