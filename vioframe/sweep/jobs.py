"""What a job leaves in its folder, and what that says of it."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

_JOB_FILE = "job.json"
_STATUS_FILE = "status.json"
_METRICS_FILE = "metrics.json"


@dataclass(frozen=True, slots=True, kw_only=True)
class JobResult:
    """One job of a sweep.

    Attributes:
        number: its place in the sweep; -1 where unknown.
        overrides: all of the command line's choices for it, ``key=value``.
        status: ``finished``; ``failed``, ``interrupted`` or what else its task wrote; ``unfinished`` (it died without a
            word); ``not started``.
        error: one sentence, for all but ``finished``.
        metrics: what ``metrics_of`` finds in its ``metrics.json``; a failed job may have some.
        folder: where its files are; ``None`` if it never started.
        recordings: names of those it ran on.
    """

    number: int
    overrides: tuple[str, ...]
    status: str
    error: str = ""
    metrics: dict[str, float] = field(default_factory=dict)
    folder: Path | None = None
    recordings: tuple[str, ...] = ()


def write_job(folder: Path, number: int, overrides: list[str]) -> None:
    """Leave word that a job has started.

    Args:
        folder: of the job.
        number: its place in the sweep.
        overrides: all of the command line's choices for it, ``key=value``.
    """
    started = datetime.now(UTC).isoformat(timespec="seconds")
    _write_json(folder / _JOB_FILE, {"job": number, "overrides": overrides, "started": started})


def write_status(folder: Path, status: str, error: str = "") -> None:
    """Leave word of how a job ended; the first word stands.

    Args:
        folder: of the job.
        status: ``finished``, ``failed`` or ``interrupted``.
        error: one sentence.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / _STATUS_FILE).exists():
        _write_json(folder / _STATUS_FILE, {"status": status, "error": error})


def collect(sweep_dir: Path, planned: Sequence[Sequence[str]] = ()) -> list[JobResult]:
    """Read what the jobs of a sweep left in their folders.

    Args:
        sweep_dir: Hydra's ``hydra.sweep.dir``.
        planned: overrides of every job that was to run, in order; those without a folder are ``not started``.
    """
    found = {}
    for path in sorted(sweep_dir.rglob(_JOB_FILE)):
        job = _read_job(path)
        found[(job.number, str(path))] = job
    jobs = [found[key] for key in sorted(found)]
    numbers = {job.number for job in jobs}
    jobs += [
        JobResult(
            number=number, overrides=tuple(overrides), status="not started", error="the sweep broke off before this job"
        )
        for number, overrides in enumerate(planned)
        if number not in numbers
    ]
    return sorted(jobs, key=lambda job: job.number)


def _read_job(path: Path) -> JobResult:
    # Numbers of a document need the tracker's module, which --help does not.
    from vioframe.tracking.records import metrics_of

    folder = path.parent
    entry = _read_json(path) or {}
    overrides = entry.get("overrides")
    number = entry.get("job")
    document = _read_json(folder / _METRICS_FILE)
    status, error = _read_status(folder, document)
    return JobResult(
        number=number if isinstance(number, int) else -1,
        overrides=tuple(str(text) for text in overrides) if isinstance(overrides, list) else (),
        status=status,
        error=error,
        metrics=metrics_of(document) if document else {},
        folder=folder,
        recordings=_recordings_of(document),
    )


def _recordings_of(document: dict[str, object] | None) -> tuple[str, ...]:
    rows = (document or {}).get("sequences")
    return tuple(str(row["sequence"]) for row in rows if "sequence" in row) if isinstance(rows, list) else ()


def _read_status(folder: Path, document: dict[str, object] | None) -> tuple[str, str]:
    """Return a job's status and error; one that left neither word nor ``metrics.json`` has not finished."""
    word = _read_json(folder / _STATUS_FILE) or {}
    status, error = str(word.get("status") or ""), str(word.get("error") or "")
    if status and status != "finished":
        return status, error or "no reason given"
    if document is None:
        if (folder / _METRICS_FILE).exists():
            return "failed", f"its {_METRICS_FILE} cannot be read"
        if status == "finished":
            # A task that measures nothing, such as one that checks a recording.
            return status, ""
        return (
            "unfinished",
            f"it ended without a word and left no {_METRICS_FILE} (interrupted, killed, out of memory?)",
        )
    sequences = document.get("sequences")
    for row in sequences if isinstance(sequences, list) else []:
        if isinstance(row, dict) and row.get("status", "finished") != "finished":
            return "failed", str(row.get("error") or f"{row.get('sequence')}: {row['status']}")
    return "finished", ""


def _read_json(path: Path) -> dict[str, object] | None:
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return document if isinstance(document, dict) else None


def failed_jobs(sweep_dir: Path | str) -> list[JobResult]:
    """Return the jobs of a sweep that did not finish, those that died without a word among them."""
    return [job for job in collect(Path(sweep_dir)) if job.status != "finished"]


def _write_json(path: Path, entry: dict[str, object]) -> None:
    path.write_text(json.dumps(entry, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
