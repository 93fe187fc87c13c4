"""Studies: values of one fault × variants of the system × seeds, as curves with bands.

A cell is one such combination, run by the code of ``task=experiment`` and kept as one JSON file under the hash of
all that has a bearing on it; a cell that is there is never run again. ``plan`` says what is to be run, ``cells`` runs
and keeps it, ``weights`` trains the nets it takes, once; ``summary`` compares, ``figure``, ``page`` and ``table`` show.
"""

from vioframe.study.plan import Study

__all__ = ["Study"]
