"""ROS 1 and ROS 2 bags as recordings, without ROS."""

from vioframe_bags.dataset import BagDataset

__all__ = ["BagDataset"]
