"""Tensors only: encoder of image pairs, encoder of inertial samples, core, loss."""
