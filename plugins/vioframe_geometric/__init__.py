"""Visual odometry from geometry: two-view, local map, stereo."""
