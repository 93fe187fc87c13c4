"""The chart of a sweep."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vioframe.sweep.curves import draw_curves, find_curves
from vioframe.sweep.jobs import JobResult
from vioframe.sweep.summary import Column, SeedGroup, Summary, choices_but_seeds

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_Row = tuple[str, list[JobResult], SeedGroup | None]
"""Label; the jobs behind the bar; their group, where the bar is a median over seeds."""


def draw_chart(summary: Summary, path: Path) -> bool:
    """Draw the compared metrics: over the number that a sweep varies, if that is all it varies beside one other choice.

    Otherwise as bars, a row a job (or, with seeds, a row a group and a dot a seed).

    Returns:
        whether there was anything to draw.
    """
    columns = [column for column in summary.columns() if any(column.key in job.metrics for job in summary.jobs)]
    # The percentage repeats the shape of the error in metres unless the paths differ.
    columns = [column for column in columns if column.key != "ate_se3_percent"]
    if not columns:
        return False
    curves = find_curves(summary)
    if curves is not None:
        draw_curves(summary, columns, curves, path)
        return True
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows: list[_Row]
    if summary.groups:
        rows = [
            (
                summary.label(group.choices),
                [job for job in summary.jobs if choices_but_seeds(job) == group.choices],
                group,
            )
            for group in summary.groups
        ]
    else:
        rows = [(f"#{job.number}  {summary.label(job.overrides)}", [job], None) for job in summary.jobs]
    labels = [label if len(label) <= 60 else label[:59] + "…" for label, _, _ in rows]
    label_width = 0.075 * max(map(len, labels)) + 0.3
    figure = Figure(figsize=(label_width + 2.6 * len(columns), 1.1 + 0.34 * len(rows)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, len(columns), sharey=True, squeeze=False)[0]
    for axis, column in zip(axes, columns, strict=True):
        _draw_column(axis, column, rows)
        axis.set_yticks(range(len(rows)), labels, fontsize=8)
    axes[0].set_ylim(len(rows) - 0.5, -0.5)
    if summary.groups:
        figure.suptitle("bars: median over seeds, dots: seeds", fontsize=9)
    figure.savefig(path, dpi=110)
    return True


def _draw_column(axis: "Axes", column: Column, rows: Sequence[_Row]) -> None:
    """Draw one metric: a bar with its value for each row, the winner's in green."""
    from matplotlib.ticker import MaxNLocator

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
    axis.tick_params(axis="x", labelsize=8)
    axis.spines[["top", "right"]].set_visible(False)
    if spread:
        axis.set_xscale("log")
    axis.margins(x=0.25)
    if not spread:
        axis.set_xlim(left=0.0)
        axis.xaxis.set_major_locator(MaxNLocator(4))


def _row_value(jobs: Sequence[JobResult], group: SeedGroup | None, column: Column) -> float | None:
    if group is not None:
        return group.median.get(column.key)
    return jobs[0].metrics.get(column.key) if jobs[0].status == "finished" else None
