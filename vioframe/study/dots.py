"""Conditions beside each other: every run as a dot, medians as bars, and the ratio to the baseline."""

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vioframe.study.summary import StudySummary
from vioframe.sweep.curves import COLOURS
from vioframe.sweep.summary import Column

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Share of the distance between two conditions that their variants take.
_WIDTH = 0.78
# Values that spread further are drawn over a logarithm.
_WIDE = 10.0


def draw_conditions(summary: StudySummary, path: Path) -> None:
    """Draw a panel a metric, and one of what stands beside the baseline, into a PNG file."""
    import matplotlib as mpl

    from vioframe.evaluation.plots.canvas import STYLE, add_caption, new_figure

    study = summary.study
    panels = len(summary.columns) + bool(summary.compared())
    with mpl.rc_context(STYLE):
        width = max(7.0, 2.0 + len(study.all_values()) * (0.45 + 0.22 * len(study.chosen)))
        figure = new_figure((width, 2.7 * panels + 0.9))
        axes = figure.subplots(panels, 1, squeeze=False)[:, 0]
        for axis, column in zip(axes, summary.columns, strict=False):
            _draw_metric(axis, summary, column)
        if summary.compared():
            _draw_ratios(axes[-1], summary)
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=min(len(labels), 5))
        told = [f"{study.title}: bars: {summary.runs_told()}, dots: runs"]
        if study.least_completion > 0.0:
            told.append(f"×: failed, tracked less than {100.0 * study.least_completion:g} %")
        add_caption(figure, " · ".join(told))
        figure.savefig(path)


def _draw_metric(axes: "Axes", summary: StudySummary, column: Column) -> None:
    study = summary.study
    values = study.all_values()
    step = _WIDTH / len(study.chosen)
    drawn: list[float] = []
    failures: list[tuple[float, str]] = []
    for place, variant in enumerate(study.chosen):
        colour = COLOURS[place % len(COLOURS)]
        offset = (place - 0.5 * (len(study.chosen) - 1)) * step
        axes.plot([], [], "s", color=colour, label=variant)
        for index, value in enumerate(values):
            numbers = np.array([number for number in summary.runs(variant, value, column) if number is not None])
            finite = numbers[np.isfinite(numbers)] * column.factor
            drawn += finite.tolist()
            # A little apart, in the same order everywhere: a run can be followed from bar to bar.
            at = index + offset + step * (np.linspace(-0.22, 0.22, len(numbers)) if len(numbers) > 1 else np.zeros(1))
            axes.plot(at[np.isfinite(numbers)], finite, ".", color=colour, markersize=4, alpha=0.55)
            failures += [(x, colour) for x in at[~np.isfinite(numbers)]]
            spread = summary.spread(variant, value, column)
            if spread is not None and math.isfinite(spread.median):
                ends = index + offset - 0.36 * step, index + offset + 0.36 * step
                axes.plot(ends, [spread.median] * 2, color=colour, linewidth=2.6, solid_capstyle="butt")
    if drawn and min(drawn) > 0.0 and max(drawn) > _WIDE * min(drawn):
        _use_logarithm(axes, (1.0, 2.0, 5.0))
    for x, colour in failures:
        axes.plot(x, 0.965, "x", color=colour, markersize=5, transform=axes.get_xaxis_transform(), clip_on=False)
    if not drawn and not failures:
        axes.text(0.5, 0.5, "undefined", transform=axes.transAxes, ha="center", color="#7a7a7a")
    axes.set_title(column.title)
    better = "lower" if column.lower_is_better else "higher"
    axes.text(1.0, 1.015, f"{better} is better", transform=axes.transAxes, ha="right", fontsize=7.5, color="#7a7a7a")
    _label(axes, [study.shown(value) for value in values])


def _draw_ratios(axes: "Axes", summary: StudySummary) -> None:
    study, column = summary.study, summary.columns[0]
    compared = summary.comparisons(column)
    places = list(dict.fromkeys(where for _, where, _ in compared))
    variants = summary.compared()
    step = _WIDTH / len(study.chosen)
    for variant, where, one in compared:
        rank = study.chosen.index(variant)
        x = places.index(where) + (variants.index(variant) - 0.5 * (len(variants) - 1)) * step
        colour = COLOURS[rank % len(COLOURS)]
        pairs, medians = one.of_pairs, one.of_medians
        if medians is not None:
            axes.plot(x, medians.value, "_", color=colour, markersize=11, markeredgewidth=1.6)
        if pairs is None or pairs.value == 0.0:
            continue
        if pairs.low and pairs.high is not None and math.isfinite(pairs.high):
            axes.plot([x, x], [pairs.low, pairs.high], color=colour, linewidth=1.4)
        axes.plot(x, pairs.value, "o", color=colour, markersize=5)
        if one.p_value is not None and one.p_value < 0.05:
            axes.plot(x, pairs.value, "o", color=colour, markersize=9, fillstyle="none")
    axes.axhline(1.0, color="#7a7a7a", linewidth=1.0)
    _use_logarithm(axes, (1.0, 1.2, 1.5, 2.0, 3.0, 5.0, 7.0, 8.0))
    axes.set_title(f"{column.title.partition(' [')[0]} / {study.baseline}")
    told = "dots: median of the ratios of pairs, 95 %, ringed: p < 0.05; dashes: ratio of medians"
    axes.text(1.0, 1.015, told, transform=axes.transAxes, ha="right", fontsize=7.5, color="#7a7a7a")
    _label(axes, places)


def _use_logarithm(axes: "Axes", ticks: tuple[float, ...]) -> None:
    """Ticks at these multiples of powers of ten, as plain numbers."""
    from matplotlib.ticker import LogLocator, NullLocator

    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=ticks))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_locator(NullLocator())


def _label(axes: "Axes", names: list[str]) -> None:
    axes.set_xticks(range(len(names)), [name.replace("_", "\n") for name in names], fontsize=8.5)
    axes.set_xlim(-0.6, len(names) - 0.4)
    axes.grid(visible=False, axis="x")
