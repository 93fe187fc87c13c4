"""Multi-state constraint Kalman filter: tightly coupled visual-inertial odometry in numpy."""
