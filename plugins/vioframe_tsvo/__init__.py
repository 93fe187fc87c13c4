"""Learned odometry: two-stream TSVO with three backbones, and DeepVO. Importing this package imports no torch."""
