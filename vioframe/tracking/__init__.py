"""Recording of runs: MLflow, or nothing at all.

``MlflowTracker`` keeps parameters, metrics and files of one run; under a multirun it nests the run below
the sweep's (see ``vioframe.sweep``). Nothing here imports MLflow before a run is started.
"""

from vioframe.tracking.records import flatten_parameters, metrics_of
from vioframe.tracking.store import create_store
from vioframe.tracking.tracker import (
    PARENT_RUN_VARIABLE,
    PARENT_URI_VARIABLE,
    RUN_NAME_VARIABLE,
    MlflowTracker,
    NullTracker,
    Status,
    Tracker,
)

__all__ = [
    "PARENT_RUN_VARIABLE",
    "PARENT_URI_VARIABLE",
    "RUN_NAME_VARIABLE",
    "MlflowTracker",
    "NullTracker",
    "Status",
    "Tracker",
    "create_store",
    "flatten_parameters",
    "metrics_of",
]
