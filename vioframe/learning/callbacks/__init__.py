"""What watches a training: its numbers and pictures, a stop when it diverges, the best weights, a point to resume from.

Each keeps its state in the resume file as plain containers, so that the file can be read as data (``weights_only``).
Their order matters: see ``training.py``.
"""

from vioframe.learning.callbacks.bar import Bar
from vioframe.learning.callbacks.curve import CURVE_FILE, Curve
from vioframe.learning.callbacks.divergence import StopDivergence
from vioframe.learning.callbacks.drawing import BestPicture, CurvePicture, FlowPicture
from vioframe.learning.callbacks.keeping import RESUME_FILE, BestWeights, ResumePoint
from vioframe.learning.rows import Row

__all__ = [
    "CURVE_FILE",
    "RESUME_FILE",
    "Bar",
    "BestPicture",
    "BestWeights",
    "Curve",
    "CurvePicture",
    "FlowPicture",
    "ResumePoint",
    "Row",
    "StopDivergence",
]
