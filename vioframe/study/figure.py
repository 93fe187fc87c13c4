"""The figure of a study: of values as curves, a panel a metric, a line a variant; of conditions as dots."""

from pathlib import Path

from vioframe.study.dots import draw_conditions
from vioframe.study.summary import StudySummary
from vioframe.sweep.curves import Curves, draw_curves
from vioframe.sweep.jobs import JobResult
from vioframe.sweep.summary import Summary, summarise


def draw_study(summary: StudySummary, path: Path) -> None:
    """Draw medians over runs as lines and their range as bands, or conditions beside each other, into a PNG file."""
    study = summary.study
    if study.conditions:
        draw_conditions(summary, path)
        return
    jobs: list[JobResult] = []
    lines: dict[str, dict[float, list[JobResult]]] = {}
    for number, (cell, result) in enumerate(summary.results.items()):
        value = float(cell.value)
        job = JobResult(
            number=number,
            overrides=(f"variant={cell.variant}", f"value={value:g}", f"seed={cell.seed}"),
            status=result.status,
            error=result.error,
            # What a run that failed measured is no point of a curve.
            metrics=summary.metrics_of(result),
        )
        jobs.append(job)
        lines.setdefault(cell.variant, {}).setdefault(value * study.factor, []).append(job)
    ordered = {name: dict(sorted(lines[name].items())) for name in study.chosen if name in lines}
    shown: Summary = summarise(jobs)
    draw_curves(shown, summary.columns, Curves(key=study.axis, lines=ordered), path)
