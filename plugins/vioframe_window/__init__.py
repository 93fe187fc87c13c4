"""Tightly coupled fixed-lag smoother on gtsam, with loop closure."""
