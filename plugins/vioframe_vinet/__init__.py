"""VINet: end-to-end learned visual-inertial odometry. Importing this package imports no torch."""

from vioframe_vinet.frontend import PairEncoder
from vioframe_vinet.fuser import VinetFuser

__all__ = ["PairEncoder", "VinetFuser"]
