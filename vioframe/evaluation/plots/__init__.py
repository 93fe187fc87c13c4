"""The figures of the report: one function each, matplotlib's object interface, no global state.

matplotlib takes a second to import, so it is imported inside the functions.
"""

from vioframe.evaluation.plots.sequence import draw_run

__all__ = ["draw_run"]
