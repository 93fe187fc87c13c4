"""Rotations, rigid motions, cameras and triangulation, batched over leading axes, in plain numpy."""
