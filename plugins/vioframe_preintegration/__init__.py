"""Inertial integrators: on-manifold preintegration, strapdown navigation, and the printed form of EE-LCVIO."""

from vioframe_preintegration.paper import PaperIntegrator
from vioframe_preintegration.preintegration import Preintegration
from vioframe_preintegration.strapdown import Strapdown

__all__ = ["PaperIntegrator", "Preintegration", "Strapdown"]
