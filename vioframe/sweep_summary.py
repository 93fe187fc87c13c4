"""What came of a sweep: jobs read from their folders, compared in a table, a CSV, a JSON and a chart."""

import csv
import json
import re
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from vioframe.sweep import JOB_FILE, METRICS_FILE, STATUS_FILE
from vioframe.tracking.records import metrics_of

if TYPE_CHECKING:
    from rich.console import Console

_SEED = re.compile(r"(^|[._])seeds?$")


@dataclass(frozen=True, slots=True, kw_only=True)
class Column:
    """A metric the summary shows: its key in ``metrics_of``, heading, decimals, factor, and which way is better."""

    key: str
    title: str
    decimals: int
    factor: float = 1.0
    lower_is_better: bool = True

    def winner(self, values: Iterable[float]) -> float | None:
        """Return the best of several values; ``None`` where they are all the same, and nobody wins."""
        different = set(values)
        if len(different) < 2:
            return None
        return min(different) if self.lower_is_better else max(different)

    def show(self, value: float | None) -> str:
        """Write one value; ``undefined`` where there is none."""
        return "undefined" if value is None else f"{value * self.factor:.{self.decimals}f}"


COLUMNS = (
    Column(key="ate_se3_m", title="ATE [m]", decimals=3),
    Column(key="ate_se3_percent", title="ATE [% path]", decimals=2),
    Column(key="t_rel_percent", title="t_rel [%]", decimals=2),
    Column(key="completion", title="completion [%]", decimals=1, factor=100.0, lower_is_better=False),
    Column(key="real_time_factor", title="real-time factor", decimals=2, lower_is_better=False),
)
"""What the table compares; everything else is in the CSV."""


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
    """

    number: int
    overrides: tuple[str, ...]
    status: str
    error: str = ""
    metrics: dict[str, float] = field(default_factory=dict)
    folder: Path | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class SeedGroup:
    """Jobs that differ in nothing but seeds: how many finished, and each metric's median and range over those."""

    choices: tuple[str, ...]
    jobs: int
    finished: int
    median: dict[str, float]
    smallest: dict[str, float]
    largest: dict[str, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Summary:
    """A sweep: its jobs in order, the keys that vary among them, and the groups over seeds if it has any."""

    jobs: tuple[JobResult, ...]
    varied: tuple[str, ...]
    groups: tuple[SeedGroup, ...]

    def label(self, overrides: Iterable[str]) -> str:
        """Name a job or group by the choices that vary in this sweep."""
        chosen = list(overrides)
        return " ".join(text for text in chosen if _key(text) in self.varied) or " ".join(chosen) or "default"

    def values(self, column: Column) -> list[float]:
        """Return the values of the jobs that finished and have one."""
        return [job.metrics[column.key] for job in self.jobs if job.status == "finished" and column.key in job.metrics]

    def best(self, column: Column) -> float | None:
        """Return the best value among the jobs that finished."""
        values = self.values(column)
        return (min if column.lower_is_better else max)(values, default=None)

    def columns(self) -> list[Column]:
        """Return the columns of which at least one job has a value; the first always."""
        return [
            column for column in COLUMNS if column is COLUMNS[0] or any(column.key in job.metrics for job in self.jobs)
        ]

    def metrics(self) -> dict[str, float]:
        """Return what the sweep's own record shows: counts, and the best of each column."""
        numbers = {
            "jobs": float(len(self.jobs)),
            "failed_jobs": float(sum(job.status != "finished" for job in self.jobs)),
        }
        for column in self.columns():
            value = self.best(column)
            if value is not None:
                numbers[f"best/{column.key}"] = value
        return numbers


def collect(sweep_dir: Path, planned: Sequence[Sequence[str]] = ()) -> list[JobResult]:
    """Read what the jobs of a sweep left in their folders.

    Args:
        sweep_dir: Hydra's ``hydra.sweep.dir``.
        planned: overrides of every job that was to run, in order; those without a folder are ``not started``.
    """
    found = {}
    for path in sorted(sweep_dir.rglob(JOB_FILE)):
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
    folder = path.parent
    entry = _read_json(path) or {}
    overrides = entry.get("overrides")
    number = entry.get("job")
    document = _read_json(folder / METRICS_FILE)
    status, error = _read_status(folder, document)
    return JobResult(
        number=number if isinstance(number, int) else -1,
        overrides=tuple(str(text) for text in overrides) if isinstance(overrides, list) else (),
        status=status,
        error=error,
        metrics=metrics_of(document) if document else {},
        folder=folder,
    )


def _read_status(folder: Path, document: dict[str, object] | None) -> tuple[str, str]:
    """Return a job's status and error; one that left neither word nor ``metrics.json`` has not finished."""
    word = _read_json(folder / STATUS_FILE) or {}
    status, error = str(word.get("status") or ""), str(word.get("error") or "")
    if status and status != "finished":
        return status, error or "no reason given"
    if document is None:
        if (folder / METRICS_FILE).exists():
            return "failed", f"its {METRICS_FILE} cannot be read"
        if status == "finished":
            # A task that measures nothing, such as one that checks a recording.
            return status, ""
        return "unfinished", f"it ended without a word and left no {METRICS_FILE} (interrupted, killed, out of memory?)"
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


def summarise(jobs: Sequence[JobResult]) -> Summary:
    """Compare jobs; where their overrides include seeds, also over the seeds."""
    values: dict[str, set[str]] = {}
    for job in jobs:
        for text in job.overrides:
            values.setdefault(_key(text), set()).add(text)
    varied = tuple(
        key
        for key, texts in values.items()
        if len(texts) > 1 or not all(any(_key(text) == key for text in job.overrides) for job in jobs)
    )
    groups: dict[tuple[str, ...], list[JobResult]] = {}
    for job in jobs:
        choices = tuple(text for text in job.overrides if not _SEED.search(_key(text)))
        groups.setdefault(choices, []).append(job)
    seeded = any(_SEED.search(key) for key in varied)
    return Summary(
        jobs=tuple(jobs),
        varied=varied,
        groups=tuple(_group(choices, members) for choices, members in groups.items()) if seeded else (),
    )


def _group(choices: tuple[str, ...], members: Sequence[JobResult]) -> SeedGroup:
    finished = [job.metrics for job in members if job.status == "finished"]
    # A seed where a metric is undefined must not drop out of its median unseen: no median then.
    shared = sorted(set.intersection(*(set(metrics) for metrics in finished))) if finished else []
    columns = {key: [metrics[key] for metrics in finished] for key in shared}
    return SeedGroup(
        choices=choices,
        jobs=len(members),
        finished=len(finished),
        median={key: statistics.median(series) for key, series in columns.items()},
        smallest={key: min(series) for key, series in columns.items()},
        largest={key: max(series) for key, series in columns.items()},
    )


def _key(override: str) -> str:
    return override.partition("=")[0].lstrip("+~")


def print_table(summary: Summary, console: "Console | None" = None) -> None:
    """Print one row for each job, the best of each column in bold green, and the groups over seeds below."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    if console is None:
        console = Console()
        if not console.is_terminal:
            # A log file has no width; 80 columns would fold every row.
            console = Console(width=140)
    columns = summary.columns()
    finished = sum(job.status == "finished" for job in summary.jobs)
    table = Table(title=f"Sweep: {finished} of {len(summary.jobs)} jobs finished", title_justify="left")
    table.add_column("#", justify="right")
    table.add_column("choices", overflow="fold")
    for column in columns:
        table.add_column(Text(column.title), justify="right")
    table.add_column("status", overflow="fold")
    best = {column.key: column.winner(summary.values(column)) for column in columns}
    for job in summary.jobs:
        good = job.status == "finished"
        cells = [Text(str(job.number)), Text(summary.label(job.overrides))]
        for column in columns:
            value = job.metrics.get(column.key)
            if value is None:
                cells.append(Text("undefined" if good else "–", style="dim"))
            else:
                winner = good and value == best[column.key]
                cells.append(Text(column.show(value), style="bold green" if winner else "" if good else "dim"))
        cells.append(Text("finished") if good else Text(f"{job.status}: {job.error}", style="red"))
        table.add_row(*cells)
    console.print(table)
    if summary.groups:
        console.print(_seed_table(summary, columns))


def _seed_table(summary: Summary, columns: Sequence[Column]) -> object:
    from rich.table import Table
    from rich.text import Text

    table = Table(title="Median over seeds (smallest to largest)", title_justify="left")
    table.add_column("choices", overflow="fold")
    for column in columns:
        table.add_column(Text(column.title), justify="right")
    table.add_column("seeds finished", justify="right")
    for group in summary.groups:
        complete = group.finished == group.jobs
        cells = [Text(summary.label(group.choices))]
        for column in columns:
            medians = [
                other.median[column.key]
                for other in summary.groups
                if other.finished == other.jobs and column.key in other.median
            ]
            value = group.median.get(column.key)
            winner = complete and value is not None and value == column.winner(medians)
            cells.append(Text(_spread(group, column), style="bold green" if winner else ""))
        cells.append(Text(f"{group.finished} of {group.jobs}", style="" if complete else "red"))
        table.add_row(*cells)
    return table


def _spread(group: SeedGroup, column: Column) -> str:
    if column.key not in group.median:
        return "undefined" if group.finished else "–"
    low, high = column.show(group.smallest[column.key]), column.show(group.largest[column.key])
    return f"{column.show(group.median[column.key])} ({low} to {high})"


def markdown_table(summary: Summary) -> str:
    """Write the table as Markdown, which MLflow shows as the description of the sweep's run."""
    columns = summary.columns()
    lines = [_markdown_row(["#", "choices", *(column.title for column in columns), "status"])]
    lines.append("|" + "---|" * (len(columns) + 3))
    best = {column.key: column.winner(summary.values(column)) for column in columns}
    for job in summary.jobs:
        good = job.status == "finished"
        cells = [str(job.number), summary.label(job.overrides)]
        for column in columns:
            value = job.metrics.get(column.key)
            text = column.show(value) if good or value is not None else "–"
            cells.append(f"**{text}**" if good and value is not None and value == best[column.key] else text)
        cells.append("finished" if good else f"**{job.status}**: {job.error}")
        lines.append(_markdown_row(cells))
    if summary.groups:
        lines += ["", _markdown_row(["median over seeds", *(column.title for column in columns), "seeds finished"])]
        lines.append("|" + "---|" * (len(columns) + 2))
        for group in summary.groups:
            spreads = [_spread(group, column) for column in columns]
            counted = f"{group.finished} of {group.jobs}"
            lines.append(_markdown_row([summary.label(group.choices), *spreads, counted]))
    return "\n".join(lines)


def _markdown_row(cells: Iterable[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in cells) + " |"


def write_files(summary: Summary, folder: Path) -> list[Path]:
    """Write ``sweep.csv`` (all metrics), ``sweep_summary.json`` and the chart ``sweep.png``; return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    table, document = folder / "sweep.csv", folder / "sweep_summary.json"
    overrides = list(dict.fromkeys(_key(text) for job in summary.jobs for text in job.overrides))
    names = sorted({name for job in summary.jobs for name in job.metrics})
    with table.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["job", "folder", "status", "error", *overrides, *names])
        for job in summary.jobs:
            choices = {_key(text): text.partition("=")[2] for text in job.overrides}
            writer.writerow(
                [
                    job.number,
                    _relative(job.folder, folder),
                    job.status,
                    job.error,
                    *(choices.get(key, "") for key in overrides),
                    *(repr(job.metrics[name]) if name in job.metrics else "" for name in names),
                ]
            )
    content = {
        "jobs": [
            {
                "job": job.number,
                "folder": _relative(job.folder, folder),
                "overrides": list(job.overrides),
                "status": job.status,
                "error": job.error,
                "metrics": job.metrics,
            }
            for job in summary.jobs
        ],
        "groups_over_seeds": [
            {
                "overrides": list(group.choices),
                "jobs": group.jobs,
                "finished": group.finished,
                "median": group.median,
                "smallest": group.smallest,
                "largest": group.largest,
            }
            for group in summary.groups
        ],
        "best": {column.key: summary.best(column) for column in summary.columns()},
    }
    document.write_text(json.dumps(content, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
    chart = folder / "sweep.png"
    return [table, document, chart] if draw_chart(summary, chart) else [table, document]


def _relative(path: Path | None, folder: Path) -> str:
    return "" if path is None else path.relative_to(folder).as_posix()


def draw_chart(summary: Summary, path: Path) -> bool:
    """Draw bars of the compared metrics, a row a job (or, with seeds, a row a group and a dot a seed).

    Returns:
        whether there was anything to draw.
    """
    columns = [column for column in summary.columns() if any(column.key in job.metrics for job in summary.jobs)]
    # The percentage repeats the shape of the error in metres unless the paths differ.
    columns = [column for column in columns if column.key != "ate_se3_percent"]
    if not columns:
        return False
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    rows: list[tuple[str, list[JobResult], SeedGroup | None]]
    if summary.groups:
        rows = [
            (summary.label(group.choices), [job for job in summary.jobs if _belongs(job, group)], group)
            for group in summary.groups
        ]
    else:
        rows = [(f"#{job.number}  {summary.label(job.overrides)}", [job], None) for job in summary.jobs]
    labels = [label if len(label) <= 60 else label[:59] + "…" for label, _, _ in rows]
    label_width = 0.075 * max(map(len, labels)) + 0.3
    figure = Figure(figsize=(label_width + 2.6 * len(columns), 1.1 + 0.34 * len(rows)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, len(columns), sharey=True, squeeze=False)[0]
    places = list(range(len(rows)))
    for axis, column in zip(axes, columns, strict=True):
        drawn = [value for _, jobs, group in rows if (value := _row_value(jobs, group, column)) is not None]
        best = column.winner(drawn)
        spread = bool(drawn) and min(drawn) > 0 and max(drawn) > 50 * min(drawn)
        for place, (_, jobs, group) in enumerate(rows):
            value = _row_value(jobs, group, column)
            if value is None:
                failed = all(job.status != "finished" for job in jobs)
                axis.text(
                    0.02,
                    place,
                    jobs[0].status if failed else "undefined",
                    transform=axis.get_yaxis_transform(),
                    va="center",
                    fontsize=8,
                    color="#b3261e" if failed else "0.5",
                )
                continue
            axis.barh(place, value * column.factor, height=0.62, color="#1b7f4b" if value == best else "#8fb4d9")
            axis.annotate(
                column.show(value),
                (value * column.factor, place),
                xytext=(3, 0),
                textcoords="offset points",
                va="center",
                fontsize=8,
            )
            if group is not None:
                dots = [job.metrics[column.key] * column.factor for job in jobs if column.key in job.metrics]
                axis.plot(dots, [place - 0.2] * len(dots), "o", color="0.25", markersize=2.5)
        axis.set_title(f"{column.title}\n{'lower' if column.lower_is_better else 'higher'} is better", fontsize=9)
        axis.set_yticks(places, labels, fontsize=8)
        axis.tick_params(axis="x", labelsize=8)
        axis.spines[["top", "right"]].set_visible(False)
        if spread:
            axis.set_xscale("log")
        axis.margins(x=0.25)
        if not spread:
            axis.set_xlim(left=0.0)
            axis.xaxis.set_major_locator(MaxNLocator(4))
    axes[0].set_ylim(len(rows) - 0.5, -0.5)
    if summary.groups:
        figure.suptitle("bars: median over seeds, dots: seeds", fontsize=9)
    figure.savefig(path, dpi=110)
    return True


def _belongs(job: JobResult, group: SeedGroup) -> bool:
    return tuple(text for text in job.overrides if not _SEED.search(_key(text))) == group.choices


def _row_value(jobs: Sequence[JobResult], group: SeedGroup | None, column: Column) -> float | None:
    if group is not None:
        return group.median.get(column.key)
    return jobs[0].metrics.get(column.key) if jobs[0].status == "finished" else None
