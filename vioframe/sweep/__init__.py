"""Multirun: one parent record above the jobs' records, and one summary of what became of each job.

A job leaves three files in its folder: ``job.json`` (the callback's, when it starts: number and overrides),
``metrics.json`` and ``status.json`` (``{"status": "finished"|"failed"|"interrupted", "error": sentence}``, by
the task). They are all that the summary reads, so that it is the same for jobs of this process, of other
processes and of a cluster, and for jobs that died without a word.

``callback`` starts and concludes a sweep, ``plan`` tells what it will run, ``jobs`` reads what came of it,
``summary`` compares, ``table``, ``files`` and ``chart`` show. The last four are imported when a sweep ends:
``python -m vioframe --help`` passes through here.
"""

from vioframe.sweep.callback import SweepCallback, conclude
from vioframe.sweep.jobs import failed_jobs, write_status

__all__ = ["SweepCallback", "conclude", "failed_jobs", "write_status"]
