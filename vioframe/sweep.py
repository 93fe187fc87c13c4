"""Multirun: one parent record above the jobs' records, and one summary of what became of each job.

A job leaves three files in its folder: ``job.json`` (written here when it starts: number and overrides),
``metrics.json`` and ``status.json`` (``{"status": "finished"|"failed"|"interrupted", "error": sentence}``, by
the task). They are all that the summary reads, so that it is the same for jobs of this process, of other
processes and of a cluster, and for jobs that died without a word.
"""

import json
import logging
import os
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.experimental.callback import Callback

if TYPE_CHECKING:
    from hydra.core.utils import JobReturn
    from omegaconf import DictConfig

    from vioframe.sweep_summary import JobResult
    from vioframe.tracking import Tracker

log = logging.getLogger(__name__)

JOB_FILE = "job.json"
STATUS_FILE = "status.json"
METRICS_FILE = "metrics.json"

_VALIDATED_JOBS = 20
"""How many jobs are composed before anything is recorded, to let a misspelt option answer at once."""


@dataclass(slots=True, kw_only=True)
class _Sweep:
    """The sweep of this process, between its start and ``conclude``."""

    folder: Path
    planned: list[list[str]]
    tracker: "Tracker"
    failed: "list[JobResult] | None" = None
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
        arguments = _arguments(config)
        self._swept, planned = _plan(arguments)
        if not _composes(config, planned):
            return
        tracker: Tracker = NullTracker()
        try:
            options = _tracker_options(config)
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
        os.environ[RUN_NAME_VARIABLE] = _label(overrides, self._swept)
        entry = {
            "job": int(config.hydra.job.num),
            "overrides": overrides,
            "started": datetime.now(UTC).isoformat(timespec="seconds"),
        }
        _write_json(Path(config.hydra.runtime.output_dir) / JOB_FILE, entry)

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


def write_status(folder: Path, status: str, error: str = "") -> None:
    """Leave word of how a job ended; the first word stands.

    Args:
        folder: of the job.
        status: ``finished``, ``failed`` or ``interrupted``.
        error: one sentence.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / STATUS_FILE).exists():
        _write_json(folder / STATUS_FILE, {"status": status, "error": error})


def failed_jobs(sweep_dir: Path | str) -> "list[JobResult]":
    """Return the jobs of a sweep that did not finish, those that died without a word among them."""
    from vioframe.sweep_summary import collect

    return [job for job in collect(Path(sweep_dir)) if job.status != "finished"]


def conclude(*, interrupted: bool = False) -> "list[JobResult]":
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
    from vioframe.sweep_summary import collect, markdown_table, print_table, summarise, write_files
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


def _arguments(config: "DictConfig") -> list[str]:
    """Return everything a sweeper goes through: its own parameters, then the command line's overrides."""
    from omegaconf import OmegaConf

    parameters = OmegaConf.select(config, "hydra.sweeper.params") or {}
    return [f"{key}={value}" for key, value in parameters.items()] + [str(t) for t in config.hydra.overrides.task]


def _plan(arguments: list[str]) -> tuple[list[str], list[list[str]]]:
    """Return the swept keys, and every job's overrides where Hydra's basic sweeper can tell them."""
    from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    try:
        parsed = OverridesParser.create().parse_overrides(arguments)
        swept = [entry.get_key_element() for entry in parsed if entry.is_sweep_override()]
    except HydraException:
        # The sweeper is about to say so itself, better.
        return [], []
    try:
        planned = [list(job) for job in BasicSweeper.split_arguments(parsed, None)[0]]
    except HydraException:
        # A range of another sweeper, or a glob over a group, which only the sweeper can expand.
        planned = []
    return swept, planned


def _composes(config: "DictConfig", planned: list[list[str]]) -> bool:
    """Tell whether the first jobs' configs compose; where not, Hydra's sweeper is about to say why."""
    from hydra.core.global_hydra import GlobalHydra
    from hydra.errors import HydraException

    hydra = GlobalHydra.instance().hydra
    if hydra is None:
        return True
    try:
        for overrides in planned[:_VALIDATED_JOBS]:
            hydra.config_loader.load_sweep_config(config, overrides)
    except HydraException:
        return False
    return True


def _tracker_options(config: "DictConfig") -> dict[str, Any] | None:
    """Return the options of ``tracker=mlflow``; ``None`` for another tracker, which knows no parents."""
    import copy

    from hydra.core.hydra_config import HydraConfig
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    from vioframe.errors import ConfigError

    holder = HydraConfig.instance()
    before = holder.cfg
    try:
        # Hydra sets this for jobs only, and ${hydra:...} needs it.
        holder.set_config(copy.deepcopy(config))
        node = OmegaConf.select(config, "tracker")
        if node is None or not OmegaConf.is_dict(node):
            return None
        options = OmegaConf.to_container(node, resolve=True)
    except OmegaConfBaseException as error:
        raise ConfigError(f"tracker: {str(error).splitlines()[0]}") from error
    finally:
        holder.cfg = before
    if not isinstance(options, dict) or options.pop("_target_", "") != "vioframe.tracking.MlflowTracker":
        return None
    return {str(key): value for key, value in options.items()}


def _label(overrides: list[str], swept: list[str]) -> str:
    """Name a job by its swept overrides; by all of them where nothing is known to be swept."""
    return " ".join([text for text in overrides if text.partition("=")[0] in swept] or overrides)


def _write_json(path: Path, entry: dict[str, object]) -> None:
    path.write_text(json.dumps(entry, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
