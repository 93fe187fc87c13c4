"""The chart of a sweep over a number: each metric over it, a line for each value of the other choice."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

from vioframe.sweep.jobs import JobResult
from vioframe.sweep.summary import Column, Summary, is_seed, override_key

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOURS = ("#1f6fb4", "#e0812f", "#1b7f4b", "#8a4fbf", "#c8323c", "#6b5b3e", "#d16ba5", "#5a5a5a")
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
# Fewer numbers than this make no line, unless lines can be compared.
_FEWEST_ALONE = 3
# Numbers, or values, that spread further are drawn over a logarithm.
_WIDE = 20.0
_WIDE_VALUES = 50.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Curves:
    """A sweep over one number.

    Attributes:
        key: of the number, such as ``"vo.stack"``.
        lines: by label, jobs by number, in order; several for one number where there are seeds.
    """

    key: str
    lines: dict[str, dict[float, list[JobResult]]]


def find_curves(summary: Summary) -> Curves | None:
    """Tell whether, seeds aside, a sweep varies one number and at most one other choice, which is none."""
    keys = [key for key in summary.varied if not is_seed(key)]
    numeric = [key for key in keys if all(_number(job, key) is not None for job in summary.jobs)]
    others = [key for key in keys if key not in numeric]
    if len(numeric) != 1 or len(others) > 1:
        return None
    lines: dict[str, dict[float, list[JobResult]]] = {}
    for job in summary.jobs:
        value = _number(job, numeric[0])
        label = next((text for text in job.overrides if others and override_key(text) == others[0]), "")
        if value is None or (others and not label):
            return None
        lines.setdefault(label, {}).setdefault(value, []).append(job)
    numbers = {number for line in lines.values() for number in line}
    if len(numbers) < (2 if others else _FEWEST_ALONE) or len(lines) > len(COLOURS):
        return None
    return Curves(key=numeric[0], lines={label: dict(sorted(line.items())) for label, line in lines.items()})


def _number(job: JobResult, key: str) -> float | None:
    for text in job.overrides:
        if override_key(text) == key:
            try:
                return float(text.partition("=")[2].strip("'\""))
            except ValueError:
                return None
    return None


def draw_curves(summary: Summary, columns: Sequence[Column], curves: Curves, path: Path) -> None:
    """Draw a panel a metric: medians over seeds as lines, their range as a band, seeds as dots."""
    import matplotlib as mpl

    from vioframe.evaluation.plots.canvas import STYLE, add_caption, new_figure

    # What is the same for every job needs no picture, only a word.
    values = {column.key: set(_values(summary.jobs, column)) for column in columns}
    same = [column for column in columns if len(values[column.key]) == 1 and len(columns) > 1]
    told = [f"{column.title}: {column.show(summary.values(column)[0])} everywhere" for column in same]
    columns = [column for column in columns if column not in same] or columns[:1]
    across = min(len(columns), 2 if len(columns) == 4 else 3)
    down = -(-len(columns) // across)
    with mpl.rc_context(STYLE):
        figure = new_figure((3.5 * across + 0.3, 2.9 * down + 0.8))
        panels = figure.subplots(down, across, squeeze=False).flatten()
        for axes, column in zip(panels, columns, strict=False):
            draw_panel(axes, column, curves)
        for axes in panels[len(columns) :]:
            axes.set_visible(False)
        # Below every column of panels, the last of which may be shorter.
        for axes in panels[max(len(columns) - across, 0) : len(columns)]:
            axes.set_xlabel(curves.key)
        handles, labels = panels[0].get_legend_handles_labels()
        if labels:
            figure.legend(handles, labels, loc="outside upper center", ncols=min(len(labels), 4))
        told += ["lines: median over seeds, bands: range, dots: seeds"] if summary.groups else []
        missing = [f"#{job.number}" for job in summary.jobs if job.status != "finished"]
        told += [f"not finished: {' '.join(missing[:12])}{' …' if len(missing) > 12 else ''}"] if missing else []
        if told:
            add_caption(figure, " · ".join(told))
        figure.savefig(path)


def draw_panel(axes: "Axes", column: Column, curves: Curves) -> None:
    """Draw one metric: a line each; no point where a job that finished has no value."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

    numbers = sorted({number for line in curves.lines.values() for number in line})
    drawn: list[float] = []
    for place, (label, line) in enumerate(curves.lines.items()):
        colour, marker = COLOURS[place % len(COLOURS)], _MARKERS[place % len(_MARKERS)]
        known = {number: sorted(_values(jobs, column)) for number, jobs in line.items() if _is_known(jobs, column)}
        drawn += [value for each in known.values() for value in each]
        x = list(known)
        middle = [median(each) for each in known.values()]
        # A label also where there is nothing to draw, so that no line is missing from the legend.
        axes.plot(x, middle, color=colour, marker=marker, markersize=5, linewidth=1.5, label=label or None)
        if any(len(each) > 1 for each in known.values()):
            low, high = [each[0] for each in known.values()], [each[-1] for each in known.values()]
            axes.fill_between(x, low, high, color=colour, alpha=0.15, linewidth=0.0)
            for number, each in known.items():
                axes.plot([number] * len(each), each, ".", color=colour, markersize=3.5, alpha=0.7)
    better = "lower" if column.lower_is_better else "higher"
    axes.set_title(column.title)
    axes.text(1.0, 1.015, f"{better} is better", transform=axes.transAxes, ha="right", fontsize=7.5, color="#7a7a7a")
    if not drawn:
        axes.text(0.5, 0.5, "undefined", transform=axes.transAxes, ha="center", color="#7a7a7a")
    elif min(drawn) > 0.0 and max(drawn) > _WIDE_VALUES * min(drawn):
        axes.set_yscale("log")
    if numbers[0] > 0.0 and numbers[-1] > _WIDE * numbers[0]:
        axes.set_xscale("log")
    if len(numbers) <= 8:
        axes.xaxis.set_major_locator(FixedLocator(numbers))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def _is_known(jobs: Sequence[JobResult], column: Column) -> bool:
    """Whether all that finished have a value: a seed without one must not drop out of the median unseen."""
    finished = [job for job in jobs if job.status == "finished"]
    return bool(finished) and all(column.key in job.metrics for job in finished)


def _values(jobs: Sequence[JobResult], column: Column) -> list[float]:
    return [
        job.metrics[column.key] * column.factor
        for job in jobs
        if job.status == "finished" and column.key in job.metrics
    ]
