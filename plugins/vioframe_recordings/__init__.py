"""Recordings on disk: EuRoC and TUM-VI (ASL folders), KITTI odometry, KITTI raw."""

from vioframe_recordings.euroc import EurocDataset
from vioframe_recordings.kitti import KittiDataset
from vioframe_recordings.kitti_raw import KittiRawDataset
from vioframe_recordings.tumvi import TumviDataset

__all__ = ["EurocDataset", "KittiDataset", "KittiRawDataset", "TumviDataset"]
