"""Where runs are kept: tracking URIs, whether they answer, and the local SQLite store."""

import logging
import os
import sqlite3
import tempfile
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from vioframe.errors import ConfigError

SERVER_SCHEMES = ("http", "https")
DATABASE_PORTS = {"postgresql": 5432, "mysql": 3306, "mssql": 1433}
ARTIFACT_FOLDER = "mlartifacts"
LOCK_TIMEOUT_S = 120.0
# Makes MLflow's pages open on runs and charts, not on chat traces.
_KIND = {"mlflow.experimentKind": "custom_model_development"}


def import_mlflow(timeout_s: float = 5.0) -> Any:
    """Import MLflow (about 2 s) so that it neither phones home, nor chatters, nor hangs.

    What the user's environment already sets is left alone.

    Args:
        timeout_s: how long one request to a server may take.
    """
    # Without these MLflow reports usage to its makers, prints addresses, and retries a dead server for minutes.
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    os.environ.setdefault("DO_NOT_TRACK", "true")
    os.environ.setdefault("MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT", "true")
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "1")
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", str(max(10, round(timeout_s))))
    quiet = "MLFLOW_LOGGING_LEVEL" not in os.environ
    # Comes along with pandas and tells its number of threads on import.
    logging.getLogger("numexpr").setLevel(logging.WARNING)
    # Warns of every retry, before the failure that is told here.
    logging.getLogger("urllib3.connectionpool").setLevel(logging.ERROR)
    import mlflow
    import mlflow.tracking

    if quiet:
        # Its loggers print tracebacks of errors that are caught and told here, and alembic every migration.
        for name in ("mlflow", "alembic"):
            logging.getLogger(name).setLevel(logging.CRITICAL)
    return mlflow


def client_errors() -> tuple[type[BaseException], ...]:
    """Name what an MLflow client may raise when its store fails; call after ``import_mlflow``."""
    from mlflow.exceptions import MlflowException
    from sqlalchemy.exc import SQLAlchemyError

    # OSError covers requests' exceptions, full disks and lost mounts.
    return (MlflowException, SQLAlchemyError, OSError)


def hide_password(uri: str) -> str:
    """Return the URI without the user and password it may carry, for messages and logs."""
    try:
        parts = urlsplit(uri)
        if "@" not in parts.netloc:
            return uri
        return parts._replace(netloc="***@" + parts.netloc.rpartition("@")[2]).geturl()
    except ValueError:
        return uri


def check_uri(key: str, uri: str) -> str:
    """Refuse a tracking URI of an unknown kind, and make a relative SQLite path absolute.

    Raises:
        ConfigError: with the config key, the value and the kinds that work.
    """
    scheme = uri.partition("://")[0].partition("+")[0] if "://" in uri else ""
    if scheme == "sqlite":
        path = sqlite_path(uri)
        if path is None:
            raise ConfigError(
                f"{key}={uri} names no file, so its runs would be lost: "
                "write sqlite:///relative/path.db or sqlite:////absolute/path.db"
            )
        if "%" in path.as_posix() or "?" in uri:
            # SQLAlchemy 2.0 and 2.1 disagree on whether %20 is a space there.
            raise ConfigError(f"{key}={uri} has a % or ? in its path, which a URI cannot carry: choose another path")
        return f"sqlite:///{path}"
    if scheme in SERVER_SCHEMES or scheme in DATABASE_PORTS:
        try:
            parts = urlsplit(uri)
            named = bool(parts.hostname) and (parts.port is None or parts.port > 0)
        except ValueError:
            named = False
        if not named:
            raise ConfigError(f"{key}={hide_password(uri)} names no valid host and port: write http://host:5000")
        return uri
    raise ConfigError(
        f"{key}={hide_password(uri)} is not a tracking URI: write sqlite:///path/mlflow.db for a local file, "
        "http://host:port for a server, or postgresql://, mysql://, mssql:// for a database"
    )


def sqlite_path(uri: str) -> Path | None:
    """Return the absolute path of a SQLite URI; ``None`` for another kind, or one that names no file."""
    prefix = "sqlite:///"
    if not uri.startswith(prefix):
        return None
    name = uri.removeprefix(prefix).partition("?")[0]
    return Path(name).absolute() if name and name != ":memory:" else None


def why_unreachable(uri: str, timeout_s: float) -> str | None:
    """Ask a server whether it is there, in at most ``timeout_s``.

    Returns:
        ``None`` when it answers (or the URI is a local file), else the reason in a few words.
    """
    parts = urlsplit(uri)
    if parts.hostname is None:
        return None
    answer: list[str | None] = []
    # In a thread, because looking up a name may block for longer than any socket timeout.
    asking = threading.Thread(target=lambda: answer.append(_ask(uri, timeout_s)), daemon=True)
    asking.start()
    asking.join(timeout_s)
    return answer[0] if answer else f"no answer within {timeout_s:g} s"


def _ask(uri: str, timeout_s: float) -> str | None:
    import socket

    parts = urlsplit(uri)
    host = parts.hostname or ""
    try:
        if parts.scheme not in SERVER_SCHEMES:
            port = parts.port or DATABASE_PORTS[parts.scheme.partition("+")[0]]
            with socket.create_connection((host, port), timeout=timeout_s):
                return None
        place = f"[{host}]" if ":" in host else host
        place += f":{parts.port}" if parts.port else ""
        health = f"{parts.scheme}://{place}{parts.path.rstrip('/')}/health"
        with urllib.request.urlopen(health, timeout=timeout_s):
            return None
    except urllib.error.HTTPError as error:
        # A gateway may hide /health or want credentials there; only a broken server counts as absent.
        return f"it answers with HTTP status {error.code}" if error.code >= 500 else None
    except urllib.error.URLError as error:
        return str(getattr(error.reason, "strerror", None) or error.reason)
    except (OSError, ValueError) as error:
        return str(getattr(error, "strerror", None) or error)
    except Exception as error:  # noqa: BLE001
        # http.client raises its own tree for what is no HTTP at all; a thread must always bring an answer.
        return f"it does not speak HTTP ({type(error).__name__})"


def create_store(uri: str, experiment: str = "vioframe", *, timeout_s: float = 5.0) -> str:
    """Create the store and the experiment unless they exist; safe against other processes that do the same.

    A fresh SQLite store takes about 2 s (schema migrations), an existing one 0.9 s.

    Args:
        uri: tracking URI, as ``check_uri`` returns it.
        experiment: name of the MLflow experiment.
        timeout_s: how long one request to a server may take.

    Returns:
        The experiment's id.

    Raises:
        ConfigError: the file cannot be written, is no MLflow store, or the server refuses.
    """
    path = sqlite_path(uri)
    import_mlflow(timeout_s)
    if path is None:
        return _find_experiment(uri, experiment, None)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if _is_absent(path):
            with _locked(path.with_name(f".{path.name}.lock")):
                if _is_absent(path):
                    _create_schema(path)
        _check_sqlite(path)
        return _find_experiment(uri, experiment, path.parent)
    except OSError as error:
        raise ConfigError(
            f"tracker.uri={uri} cannot be written ({error.strerror or error}): "
            "choose another path, or tracker=none to record nothing"
        ) from error


def _is_absent(path: Path) -> bool:
    return not path.exists() or path.stat().st_size == 0


def _create_schema(path: Path) -> None:
    """Create a fresh store in memory and move it to its place whole.

    MLflow's hundred migrations each wait for the disk (5 s where it is busy), and a run that is stopped
    among them would leave a file that MLflow refuses for good.
    """
    from mlflow.tracking import MlflowClient

    memory = "/dev/shm"
    partial = path.with_name(f".{path.name}.partial")
    with tempfile.TemporaryDirectory(dir=memory if os.access(memory, os.W_OK) else None) as folder:
        fresh = Path(folder) / "fresh.db"
        try:
            MlflowClient(tracking_uri=f"sqlite:///{fresh}").get_experiment_by_name("Default")
        except client_errors() as error:
            raise ConfigError(
                f"tracker.uri=sqlite:///{path} cannot be created ({one_sentence(error)}): "
                "choose a server, or tracker=none to record nothing"
            ) from error
        partial.unlink(missing_ok=True)
        try:
            with closing(sqlite3.connect(fresh)) as source, closing(sqlite3.connect(partial)) as target:
                source.backup(target)
        except sqlite3.Error as error:
            raise OSError(str(error)) from error
    partial.replace(path)


def _find_experiment(uri: str, experiment: str, folder: Path | None) -> str:
    """Open the store, which creates its schema where it has none, and find or create the experiment."""
    from mlflow.tracking import MlflowClient

    try:
        client = MlflowClient(tracking_uri=uri)
        found = client.get_experiment_by_name(experiment)
        if found is None:
            place = urlsplit(uri)
            if folder is None and place.scheme not in SERVER_SCHEMES:
                folder = Path.cwd()
            location = None if folder is None else (folder / ARTIFACT_FOLDER).as_uri()
            try:
                return str(client.create_experiment(experiment, artifact_location=location, tags=_KIND))
            except client_errors():
                # Another process may have created it in between; if not, the first error tells why.
                found = client.get_experiment_by_name(experiment)
                if found is None:
                    raise
    except client_errors() as error:
        raise ConfigError(
            f"tracker.uri={hide_password(uri)} refuses to serve as an MLflow store: {one_sentence(error)}"
        ) from error
    if found.lifecycle_stage != "active":
        raise ConfigError(
            f"tracker.experiment={experiment} was deleted in {hide_password(uri)}: restore it with "
            f"'mlflow experiments restore --experiment-id {found.experiment_id}', or choose another name"
        )
    return str(found.experiment_id)


def one_sentence(error: BaseException) -> str:
    """Return the first line of an error's message, at most 300 characters."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return (lines[0] if lines else type(error).__name__)[:300]


def _check_sqlite(path: Path) -> None:
    """Refuse a file that is no SQLite database, or one that belongs to another program."""
    with path.open("r+b"):
        pass
    try:
        with closing(sqlite3.connect(path, timeout=20.0)) as connection:
            tables = {row[0] for row in connection.execute("SELECT name FROM sqlite_master WHERE type='table'")}
            if "experiments" in tables:
                connection.execute("SELECT count(*) FROM experiments").fetchone()
    except sqlite3.DatabaseError as error:
        raise ConfigError(
            f"tracker.uri=sqlite:///{path} is damaged or no SQLite database ({error}): "
            "move the file away, and a new store is created"
        ) from error
    # MLflow would add its tables to whatever it finds.
    if tables and "experiments" not in tables and "alembic_version" not in tables:
        raise ConfigError(
            f"tracker.uri=sqlite:///{path} is the database of another program "
            f"(it has the table {min(tables)}): choose another path"
        )


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Hold an exclusive lock on a file between processes of this machine.

    Raises:
        OSError: the file cannot be created, or another process holds it for two minutes.
    """
    try:
        import fcntl
    except ImportError:
        # Windows has no flock; MLflow's own start-up check is all there is.
        yield
        return
    with path.open("a") as file:
        deadline = time.monotonic() + LOCK_TIMEOUT_S
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.05)
        try:
            yield
        finally:
            fcntl.flock(file, fcntl.LOCK_UN)
