"""Alignment, metrics and the report."""

from vioframe.evaluation.protocol import EvaluationOptions
from vioframe.evaluation.run import SampleFrame, SequenceRun

__all__ = ["EvaluationOptions", "SampleFrame", "SequenceRun"]
