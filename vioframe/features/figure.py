"""The results as a figure: for each split repeatability as bars, and homography accuracy over its threshold."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vioframe.evaluation.plots.canvas import STYLE, add_caption, new_figure
from vioframe.features.evaluation import ALL, Summary
from vioframe.features.protocol import EPSILONS_PX, FeatureProtocol
from vioframe.features.table import by_split, title_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_COLOURS = ("#1f6fb4", "#e0812f", "#3a9152", "#c8323c", "#8064a2", "#7a5c44", "#4bacc6", "#9a9a9a")
_MARKS = ("o", "s", "^", "D", "v", "P", "X", "*")


def draw_summaries(summaries: Sequence[Summary], protocol: FeatureProtocol, path: Path) -> None:
    """Draw a row of two panels for each split into a PNG file."""
    import matplotlib as mpl

    splits = by_split(summaries)
    if len(splits) > 1:
        # The table has the pairs of all splits together; here they would only be drawn twice.
        splits.pop(ALL, None)
    methods = list(dict.fromkeys(summary.method for summary in summaries))
    with mpl.rc_context(STYLE):
        figure = new_figure((11.0, 3.4 * len(splits) + 0.4))
        panels = figure.subplots(len(splits), 2, squeeze=False, width_ratios=(1.0, 1.25))
        for (bars, curves), (split, rows) in zip(panels, splits.items(), strict=True):
            _draw_bars(bars, rows, methods)
            bars.set_title(f"{title_of(split, rows)}: repeatability")
            _draw_curves(curves, rows, methods)
            curves.set_title("homography accuracy")
        add_caption(figure, protocol.sentence())
        figure.savefig(path)


def _colour(methods: Sequence[str], method: str) -> str:
    return _COLOURS[methods.index(method) % len(_COLOURS)]


def _draw_bars(axes: "Axes", rows: Sequence[Summary], methods: Sequence[str]) -> None:
    """Means with their standard errors; the first method on top."""
    places = list(range(len(rows)))[::-1]
    values = [row.repeatability for row in rows]
    errors = [row.repeatability_error or 0.0 for row in rows]
    axes.barh(places, values, xerr=errors, height=0.7, color=[_colour(methods, row.method) for row in rows])
    for place, value in zip(places, values, strict=True):
        axes.text(0.01, place, f"{value:.3f}", va="center", color="white", fontsize=8.5, fontweight="bold")
    axes.set_yticks(places, [row.method for row in rows])
    axes.set_xlim(0.0, 1.0)
    axes.grid(visible=False, axis="y")
    axes.set_xlabel(f"share of points found again{', with standard error' if rows[0].pairs > 1 else ''}")


def _draw_curves(axes: "Axes", rows: Sequence[Summary], methods: Sequence[str]) -> None:
    drawn = False
    for row in rows:
        if row.homography_accuracy is None:
            continue
        mark = _MARKS[methods.index(row.method) % len(_MARKS)]
        axes.plot(
            EPSILONS_PX,
            row.homography_accuracy,
            color=_colour(methods, row.method),
            marker=mark,
            markersize=4,
            label=row.method,
        )
        drawn = True
    axes.set_ylim(0.0, 1.02)
    axes.set_xticks(EPSILONS_PX)
    axes.set_xlabel("most mean error of the corners, px")
    axes.set_ylabel("share of pairs")
    if drawn:
        axes.legend(loc="lower right")
    else:
        axes.text(0.5, 0.5, "no method with descriptors", ha="center", transform=axes.transAxes, color="#7a7a7a")
