"""One run's record: the interface, the tracker that keeps nothing, and MLflow."""

import getpass
import logging
import math
import os
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

from vioframe.errors import ConfigError, StateError
from vioframe.tracking.records import clean_name, flatten_parameters
from vioframe.tracking.store import (
    check_uri,
    client_errors,
    create_store,
    hide_password,
    one_sentence,
    sqlite_path,
    why_unreachable,
)

log = logging.getLogger(__name__)

Status = Literal["finished", "failed", "killed"]

# Set by the sweep for the processes that run its jobs: where to record, below which run, and under which name.
PARENT_RUN_VARIABLE = "VIOFRAME_PARENT_RUN"
PARENT_URI_VARIABLE = "VIOFRAME_PARENT_URI"
RUN_NAME_VARIABLE = "VIOFRAME_RUN_NAME"

_MLFLOW_STATUS = {"finished": "FINISHED", "failed": "FAILED", "killed": "KILLED"}
_PARAMETERS_A_BATCH = 100
_METRICS_A_BATCH = 500
_MAX_TAG = 5000


class Tracker(ABC):
    """Keeps what a run was given and what came out.

    ``start`` once, then log, then ``finish`` once. As a context manager it finishes by itself: an exception
    means failed, Ctrl-C killed, else finished. Once started it never raises because its store fails: a run's
    results are files first, and a lost record must not cost them.
    """

    @abstractmethod
    def start(self, parameters: Mapping[str, object], tags: Mapping[str, str] | None = None, name: str = "") -> None:
        """Open the run.

        Args:
            parameters: the resolved config as plain nested containers; stored flat, with dotted keys.
            tags: free labels of the run.
            name: what to call the run where the configuration gives it no name.

        Raises:
            ConfigError: there is nowhere to record to.
            StateError: the run is open already.
        """

    @abstractmethod
    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Record numbers, of one step if they form a series; non-finite ones are left out."""

    @abstractmethod
    def log_file(self, path: Path | str, folder: str = "") -> None:
        """Keep a copy of one file, below ``folder`` in the run's record."""

    @abstractmethod
    def log_folder(self, path: Path | str, folder: str = "") -> None:
        """Keep a copy of a folder's files and subfolders, below ``folder`` in the run's record."""

    @abstractmethod
    def finish(self, status: Status = "finished", message: str = "") -> None:
        """Close the run; a second call, or one without ``start``, does nothing.

        Args:
            status: how the run ended.
            message: one sentence, shown with a run that failed.
        """

    @property
    def hint(self) -> str:
        """How to look at the record: a command or an address; empty when there is none."""
        return ""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if error is None or (isinstance(error, SystemExit) and not error.code):
            self.finish("finished")
        elif isinstance(error, KeyboardInterrupt):
            self.finish("killed", "interrupted")
        else:
            self.finish("failed", one_sentence(error))


class NullTracker(Tracker):
    """Records nothing: ``tracker=none``."""

    def start(self, parameters: Mapping[str, object], tags: Mapping[str, str] | None = None, name: str = "") -> None:
        """Do nothing."""

    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Do nothing."""

    def log_file(self, path: Path | str, folder: str = "") -> None:
        """Do nothing."""

    def log_folder(self, path: Path | str, folder: str = "") -> None:
        """Do nothing."""

    def finish(self, status: Status = "finished", message: str = "") -> None:
        """Do nothing."""


class MlflowTracker(Tracker):
    """Records a run in MLflow: a local SQLite file, a server or a database.

    When ``VIOFRAME_PARENT_RUN`` is set the run is nested below that one, in the store that
    ``VIOFRAME_PARENT_URI`` names: the sweep sets both, so that its jobs cannot scatter over several stores.

    Args:
        uri: ``sqlite:///path.db``, ``http(s)://host:port`` or a database URI. Files recorded to a local store
            lie in ``mlartifacts`` beside it.
        local_uri: where to record instead, if a server does not answer and ``on_unreachable`` allows it.
        experiment: name of the MLflow experiment; created if missing.
        run_name: name of the run; ``None``: the name given at ``start``.
        on_unreachable: ``"fail"`` or ``"local"``: what to do when a server does not answer.
        timeout_s: how long a server may take to answer.

    Raises:
        ConfigError: an option that cannot work; nothing is contacted yet.
    """

    def __init__(
        self,
        *,
        uri: str,
        local_uri: str,
        experiment: str,
        run_name: str | None,
        on_unreachable: Literal["fail", "local"],
        timeout_s: float,
    ) -> None:
        if on_unreachable not in ("fail", "local"):
            raise ConfigError(f"tracker.on_unreachable={on_unreachable} must be fail or local")
        if not (math.isfinite(timeout_s) and timeout_s > 0):
            raise ConfigError(f"tracker.timeout_s={timeout_s} must be a positive number of seconds")
        if not experiment.strip():
            raise ConfigError("tracker.experiment is empty: give the experiment a name, such as vioframe")
        self._uri = check_uri("tracker.uri", uri)
        self._local_uri = check_uri("tracker.local_uri", local_uri)
        if on_unreachable == "local" and sqlite_path(self._local_uri) is None:
            raise ConfigError(f"tracker.local_uri={hide_password(local_uri)} must be a sqlite:/// path")
        self._experiment = experiment
        self._run_name = run_name
        self._on_unreachable = on_unreachable
        self._timeout_s = float(timeout_s)
        self._client: Any = None
        self._run_id: str | None = None
        self._experiment_id = ""
        self._lost = False

    @property
    def uri(self) -> str:
        """Where the run is recorded; after ``start`` this is the local store if the server did not answer."""
        return self._uri

    @property
    def run_id(self) -> str | None:
        """MLflow's id of the open (or finished) run; ``None`` before ``start``."""
        return self._run_id

    @property
    def hint(self) -> str:
        """The command that shows a local store, or the server's address."""
        path = sqlite_path(self._uri)
        if path is None:
            return hide_password(self._uri)
        if path == Path.cwd() / "mlflow.db":
            return "mlflow ui"
        return f"mlflow ui --backend-store-uri '{self._uri}'"

    def start(self, parameters: Mapping[str, object], tags: Mapping[str, str] | None = None, name: str = "") -> None:
        """Find the store, create it if it is a local one, and open the run in it (2 to 4 s)."""
        if self._run_id is not None:
            raise StateError("MlflowTracker.start was called twice: one tracker records one run")
        parent = os.environ.get(PARENT_RUN_VARIABLE)
        if parent and os.environ.get(PARENT_URI_VARIABLE):
            self._uri = check_uri(PARENT_URI_VARIABLE, os.environ[PARENT_URI_VARIABLE])
        self._experiment_id = self._open_store()
        from mlflow.entities import Param
        from mlflow.tracking import MlflowClient

        labels = {"mlflow.source.name": "vioframe", "mlflow.source.type": "LOCAL", "mlflow.user": _user_name()}
        if parent:
            labels["mlflow.parentRunId"] = parent
        labels |= {clean_name(key): str(value)[:_MAX_TAG] for key, value in (tags or {}).items()}
        try:
            self._client = MlflowClient(tracking_uri=self._uri)
            run = self._client.create_run(
                self._experiment_id,
                tags=labels,
                run_name=self._run_name or os.environ.get(RUN_NAME_VARIABLE) or name or None,
            )
        except client_errors() as error:
            raise ConfigError(
                f"tracker.uri={hide_password(self._uri)} refuses to open a run: {one_sentence(error)}"
            ) from error
        self._run_id = run.info.run_id
        entries = [Param(key, value) for key, value in flatten_parameters(parameters).items()]
        for first in range(0, len(entries), _PARAMETERS_A_BATCH):
            batch = entries[first : first + _PARAMETERS_A_BATCH]
            self._attempt("parameters", partial(self._client.log_batch, self._run_id, params=batch))

    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Record finite numbers in as few requests as MLflow allows: one costs 10 to 140 ms."""
        if not self._is_recording():
            return
        from mlflow.entities import Metric

        now_ms = int(time.time() * 1000)
        entries = [
            Metric(clean_name(key), float(value), now_ms, step or 0)
            for key, value in metrics.items()
            if math.isfinite(value)
        ]
        for first in range(0, len(entries), _METRICS_A_BATCH):
            batch = entries[first : first + _METRICS_A_BATCH]
            self._attempt("metrics", partial(self._client.log_batch, self._run_id, metrics=batch))

    def log_file(self, path: Path | str, folder: str = "") -> None:
        """Copy one file into the run's record."""
        if self._is_recording():
            self._attempt(str(path), partial(self._client.log_artifact, self._run_id, os.fspath(path), folder or None))

    def log_folder(self, path: Path | str, folder: str = "") -> None:
        """Copy a folder's content into the run's record."""
        if self._is_recording():
            self._attempt(str(path), partial(self._client.log_artifacts, self._run_id, os.fspath(path), folder or None))

    def finish(self, status: Status = "finished", message: str = "") -> None:
        """Set the run's end and status in MLflow."""
        if not self._is_recording():
            return
        if message:
            note = partial(self._client.set_tag, self._run_id, "mlflow.note.content", message[:_MAX_TAG])
            self._attempt("the message", note)
        self._attempt("the end", partial(self._client.set_terminated, self._run_id, _MLFLOW_STATUS[status]))
        self._client = None

    def close_children(self) -> int:
        """Mark nested runs that are still open as killed: their processes died without a word.

        Call it on a parent when all its jobs are over. Returns how many there were.
        """
        if not self._is_recording():
            return 0
        open_runs: list[str] = []
        query = f"tags.`mlflow.parentRunId` = '{self._run_id}' and attributes.status = 'RUNNING'"

        def find() -> None:
            found = self._client.search_runs([self._experiment_id], filter_string=query, max_results=1000)
            open_runs.extend(run.info.run_id for run in found)

        self._attempt("a search", find)
        for run_id in open_runs:
            self._attempt("the end of a job", partial(self._client.set_terminated, run_id, "KILLED"))
        return len(open_runs)

    def _is_recording(self) -> bool:
        return self._client is not None and self._run_id is not None and not self._lost

    def _open_store(self) -> str:
        """Return the experiment's id, in the local store if the server does not answer and that is allowed."""
        shown = hide_password(self._uri)
        reason = why_unreachable(self._uri, self._timeout_s)
        if reason is None:
            try:
                return create_store(self._uri, self._experiment, timeout_s=self._timeout_s)
            except ConfigError as error:
                if sqlite_path(self._uri) is not None or self._on_unreachable == "fail":
                    raise
                log.warning("%s; recording to %s", error, self._local_uri)
        elif self._on_unreachable == "fail":
            raise ConfigError(
                f"tracker.uri={shown} cannot be reached ({reason}): start that server, record locally with "
                "tracker.on_unreachable=local, or record nothing with tracker=none"
            )
        else:
            log.warning("tracker.uri=%s cannot be reached (%s); recording to %s", shown, reason, self._local_uri)
        self._uri = self._local_uri
        return create_store(self._uri, self._experiment, timeout_s=self._timeout_s)

    def _attempt(self, what: str, action: Callable[[], object]) -> None:
        """Run one request; a refusal costs this entry only, a dead store ends the recording with one warning."""
        if self._lost:
            return
        try:
            action()
        except client_errors() as error:
            # MLflow's BAD_REQUEST will not do: it says that of a broken database too.
            refused = getattr(error, "error_code", "") == "INVALID_PARAMETER_VALUE"
            missing = isinstance(error, FileNotFoundError | NotADirectoryError)
            self._lost = not (refused or missing)
            # An HTTP client's message is a paragraph; asking again gives the reason in two words.
            reason = why_unreachable(self._uri, self._timeout_s) if self._lost else None
            log.warning(
                "MLflow at %s did not take %s (%s)%s",
                hide_password(self._uri),
                what,
                reason or one_sentence(error),
                ": nothing more is recorded there; the results are in the output folder" if self._lost else "",
            )


def _user_name() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError, ImportError):
        # A container may run under a number that no account has.
        return "unknown"
