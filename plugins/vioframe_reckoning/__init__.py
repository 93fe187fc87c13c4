"""Fusers that use one sensor alone: IMU-only dead reckoning and VO-only."""
