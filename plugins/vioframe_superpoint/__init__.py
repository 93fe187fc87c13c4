"""SuperPoint with three encoders: detector, descriptors, front end. Importing this package imports no torch."""

from vioframe_superpoint.options import Encoder

__all__ = ["Encoder"]
