"""Loosely coupled multi-sensor filter: scale, vision-frame drift, delayed measurements."""
