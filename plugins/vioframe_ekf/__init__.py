"""Loosely coupled error-state Kalman filter."""
