"""Inertial propagation corrected by metric relative poses."""

from vioframe.metric_fusion import RelativePoseFuser


class EkfFuser(RelativePoseFuser):
    """Loosely coupled error-state Kalman filter that takes odometry as it comes; see the README.

    Args:
        visual: trust in the relative poses (metres).
        inertial: trust in the inertial increments.
        standstill: measuring no motion at rest.
        start: what is assumed of the first state.

    Raises:
        ConfigError: an option outside its range.
    """
