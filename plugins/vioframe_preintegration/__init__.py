"""Inertial integrators: on-manifold preintegration, strapdown, and the printed form of EE-LCVIO."""
