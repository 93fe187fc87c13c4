"""Recordings on disk: EuRoC and TUM-VI (ASL folders), KITTI odometry, KITTI raw."""
