"""The curves of a study: a panel a metric, a line a variant, the range over seeds as a band."""

from pathlib import Path

from vioframe.study.summary import StudySummary
from vioframe.sweep.curves import Curves, draw_curves
from vioframe.sweep.jobs import JobResult
from vioframe.sweep.summary import Summary, summarise


def draw_study(summary: StudySummary, path: Path) -> None:
    """Draw medians over seeds as lines and their range as bands into a PNG file."""
    study = summary.study
    jobs: list[JobResult] = []
    lines: dict[str, dict[float, list[JobResult]]] = {}
    for number, (cell, result) in enumerate(summary.results.items()):
        job = JobResult(
            number=number,
            overrides=(f"variant={cell.variant}", f"value={cell.value:g}", f"seed={cell.seed}"),
            status=result.status,
            error=result.error,
            metrics=result.metrics,
        )
        jobs.append(job)
        lines.setdefault(cell.variant, {}).setdefault(cell.value * study.factor, []).append(job)
    ordered = {name: dict(sorted(lines[name].items())) for name in study.chosen if name in lines}
    shown: Summary = summarise(jobs)
    draw_curves(shown, summary.columns, Curves(key=study.axis, lines=ordered), path)
