"""CNN-LSTM fusion of odometry and inertial samples, and a learned correction for a filter; see the README."""

from vioframe_lstm.fuser import LstmFuser
from vioframe_lstm.options import PoseOptions, ResidualOptions

__all__ = ["LstmFuser", "PoseOptions", "ResidualOptions"]
