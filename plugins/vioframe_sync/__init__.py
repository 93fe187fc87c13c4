"""Synchronizers: pair each image with the inertial samples since the one before."""
