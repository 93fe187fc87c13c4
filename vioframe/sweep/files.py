"""The files of a sweep: all its numbers as CSV and JSON, and the chart."""

import csv
import json
from pathlib import Path

from vioframe.sweep.chart import draw_chart
from vioframe.sweep.summary import Summary, override_key


def write_files(summary: Summary, folder: Path) -> list[Path]:
    """Write ``sweep.csv`` (all metrics), ``sweep_summary.json`` and the chart ``sweep.png``; return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    table, document = folder / "sweep.csv", folder / "sweep_summary.json"
    overrides = list(dict.fromkeys(override_key(text) for job in summary.jobs for text in job.overrides))
    names = sorted({name for job in summary.jobs for name in job.metrics})
    with table.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["job", "folder", "status", "error", *overrides, *names])
        for job in summary.jobs:
            choices = {override_key(text): text.partition("=")[2] for text in job.overrides}
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
