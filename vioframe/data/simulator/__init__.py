"""The built-in simulated recording: exact motion, IMU and rendered images."""
