"""Visual odometry without learning: two-view, local map, stereo."""

from vioframe_geometric.local_map import LocalMapVO
from vioframe_geometric.stereo import StereoVO
from vioframe_geometric.two_view import TwoViewVO

__all__ = ["LocalMapVO", "StereoVO", "TwoViewVO"]
