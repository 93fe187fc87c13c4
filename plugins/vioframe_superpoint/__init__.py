"""SuperPoint with three encoders: detector, descriptors, front end. Importing this package imports no torch."""

from vioframe_superpoint.extractor import SuperPointExtractor
from vioframe_superpoint.frontend import SuperPointFrontend
from vioframe_superpoint.options import Encoder

__all__ = ["Encoder", "SuperPointExtractor", "SuperPointFrontend"]
