"""What happens when a sweep and its jobs start and end."""

import logging
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.experimental.callback import Callback

from vioframe.sweep.jobs import JobResult, collect, write_job, write_status
from vioframe.sweep.plan import composes, label_job, plan_jobs, read_arguments, tracker_options

if TYPE_CHECKING:
    from hydra.core.utils import JobReturn
    from omegaconf import DictConfig

    from vioframe.tracking import Tracker

log = logging.getLogger(__name__)


@dataclass(slots=True, kw_only=True)
class _Sweep:
    """The sweep of this process, between its start and ``conclude``."""

    folder: Path
    planned: list[list[str]]
    tracker: "Tracker"
    failed: list[JobResult] | None = None
    environment: dict[str, str] = field(default_factory=dict)


_sweep: _Sweep | None = None


class SweepCallback(Callback):
    """Hydra's door to a sweep: ``hydra.callbacks.sweep._target_: vioframe.sweep.SweepCallback``.

    Its plain fields travel with it to the processes that run the jobs; the open tracker stays behind.
    """

    def __init__(self) -> None:
        self._swept: list[str] = []
        self._environment: dict[str, str] = {}

    def on_multirun_start(self, config: "DictConfig", **kwargs: Any) -> None:
        """Create the store and the parent run before any worker starts.

        Raises:
            SystemExit: there is nowhere to record to; the reason is logged (Hydra would turn any other
                exception of a callback into a warning).
        """
        global _sweep
        from vioframe.errors import ConfigError
        from vioframe.tracking import PARENT_RUN_VARIABLE, PARENT_URI_VARIABLE, MlflowTracker, NullTracker

        # Resolved on the config itself: it keeps the moment that ${now:...} stands for.
        folder = Path(str(config.hydra.sweep.dir)).absolute()
        arguments = read_arguments(config)
        self._swept, planned = plan_jobs(arguments)
        if not composes(config, planned):
            return
        tracker: Tracker = NullTracker()
        try:
            options = tracker_options(config)
            if options is not None:
                tracker = MlflowTracker(**options)
                swept = [text for text in arguments if text.partition("=")[0] in self._swept]
                tracker.start(
                    {"sweep": arguments, "jobs": len(planned) or None, "folder": str(folder)},
                    {"vioframe.kind": "sweep"},
                    name="sweep " + " ".join(swept or arguments),
                )
        except ConfigError as error:
            log.error("%s", error)
            raise SystemExit(1) from error
        if isinstance(tracker, MlflowTracker) and tracker.run_id is not None:
            self._environment = {PARENT_RUN_VARIABLE: tracker.run_id, PARENT_URI_VARIABLE: tracker.uri}
            os.environ.update(self._environment)
        _sweep = _Sweep(folder=folder, planned=planned, tracker=tracker, environment=self._environment)

    def on_job_start(self, config: "DictConfig", **kwargs: Any) -> None:
        """In the job's process: leave word of the job, and tell the tracker its parent and its name."""
        if not _is_multirun(config):
            return
        from vioframe.tracking import RUN_NAME_VARIABLE

        overrides = [str(text) for text in config.hydra.overrides.task]
        # A pool's worker may have been started by an earlier sweep, with that one's environment.
        os.environ.update(self._environment)
        os.environ[RUN_NAME_VARIABLE] = label_job(overrides, self._swept)
        write_job(Path(config.hydra.runtime.output_dir), int(config.hydra.job.num), overrides)

    def on_job_end(self, config: "DictConfig", job_return: "JobReturn", **kwargs: Any) -> None:
        """In the job's process: where the task left no status, leave one."""
        if not _is_multirun(config):
            return
        from hydra.core.utils import JobStatus

        from vioframe.tracking import RUN_NAME_VARIABLE
        from vioframe.tracking.store import one_sentence

        os.environ.pop(RUN_NAME_VARIABLE, None)
        folder = Path(config.hydra.runtime.output_dir)
        if job_return.status == JobStatus.FAILED:
            # The property of that name prints a complaint and raises.
            error = job_return._return_value
            write_status(folder, "failed", f"{type(error).__name__}: {one_sentence(error)}")

    def on_multirun_end(self, config: "DictConfig", **kwargs: Any) -> None:
        """Collect, print, write and record the summary."""
        conclude()


def conclude(*, interrupted: bool = False) -> list[JobResult]:
    """Close the sweep of this process: print its table, write its files, finish its parent record.

    Called when Hydra ends a multirun, and again by ``main``, which catches a multirun that broke off (then
    the jobs that never started are listed too) and wants the exit status. Without a sweep it does nothing.

    Args:
        interrupted: the sweep was stopped by Ctrl-C.

    Returns:
        the jobs that did not finish.
    """
    if _sweep is None:
        return []
    if _sweep.failed is not None:
        return _sweep.failed
    from vioframe.evaluation.table import print_places
    from vioframe.sweep.files import write_files
    from vioframe.sweep.summary import summarise
    from vioframe.sweep.table import markdown_table, print_table
    from vioframe.tracking import MlflowTracker

    jobs = collect(_sweep.folder, _sweep.planned)
    _sweep.failed = [job for job in jobs if job.status != "finished"]
    for name in _sweep.environment:
        os.environ.pop(name, None)
    with _sweep.tracker as tracker:
        if isinstance(tracker, MlflowTracker):
            tracker.close_children()
        if any(job.folder for job in jobs):
            summary = summarise(jobs)
            print_table(summary)
            print_places(_sweep.folder, {"compare": tracker.hint})
            for path in write_files(summary, _sweep.folder):
                tracker.log_file(path)
            tracker.log_metrics(summary.metrics())
            message = markdown_table(summary)
        else:
            message = "no job was started"
        if interrupted:
            tracker.finish("killed", message)
        elif _sweep.failed:
            tracker.finish("failed", message)
        else:
            tracker.finish("finished" if jobs else "failed", message)
    return _sweep.failed


def _is_multirun(config: "DictConfig") -> bool:
    from hydra.types import RunMode

    return bool(config.hydra.mode == RunMode.MULTIRUN)
