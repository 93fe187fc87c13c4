"""What the parts did: points followed, the time it took, and a few frames."""

from typing import TYPE_CHECKING

import numpy as np

from vioframe.evaluation.plots.canvas import ESTIMATE, add_caption, new_figure, with_breaks
from vioframe.evaluation.plots.drawing import Drawing, add_legend, shade
from vioframe.evaluation.rows import milliseconds_per_frame

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PART_COLOURS = ("#8fa3b8", "#3f7fbf", "#58a55c", "#d9a441", "#b5596f", "#7d6bb0", "#c9c9c9")


def draw_tracks(drawing: Drawing) -> "Figure | None":
    """Number of points followed over time."""
    run = drawing.run
    if len(run.track_stamps_ns) == 0:
        return None
    figure = new_figure((7.4, 3.4))
    axes = figure.subplots()
    time_s, counts = with_breaks(drawing.time_s(run.track_stamps_ns), run.track_counts.astype(float))
    axes.fill_between(time_s, 0, counts, color=ESTIMATE, alpha=0.15, linewidth=0)
    axes.plot(time_s, counts, color=ESTIMATE, linewidth=1.1)
    median = float(np.median(run.track_counts))
    axes.axhline(median, color="#5a5a5a", linewidth=0.9, linestyle=(0, (4, 3)), label=f"median {median:.0f}")
    axes.set_ylim(0, 1.12 * max(float(run.track_counts.max()), 1.0))
    axes.set_xlabel("time (s)")
    axes.set_ylabel("tracks")
    axes.set_title(f"{run.sequence}: points followed")
    shade(axes, drawing)
    add_legend(figure, axes, drawing)
    return figure


def draw_time(drawing: Drawing) -> "Figure | None":
    """Milliseconds of a window by part."""
    table = milliseconds_per_frame(drawing.run)
    if table is None:
        return None
    total = table.pop("total")
    figure = new_figure((7.4, 3.4))
    axes = figure.subplots()
    names = list(table)
    values = np.array([table[name] for name in names])
    axes.barh(names, values, color=[_PART_COLOURS[k % len(_PART_COLOURS)] for k in range(len(names))], height=0.66)
    for place, value in enumerate(values):
        share = f" ({100 * value / total:.0f} %)" if total > 0 else ""
        axes.text(value + 0.012 * values.max(), place, f"{value:.2f} ms{share}", va="center", fontsize=9)
    axes.set_xlim(0, 1.28 * max(float(values.max()), 1e-9))
    axes.invert_yaxis()
    axes.grid(axis="y", visible=False)
    axes.set_xlabel("ms per frame, wall")
    axes.set_title(f"{drawing.run.sequence}: {total:.1f} ms per frame")
    return figure


def draw_frames(drawing: Drawing) -> "Figure | None":
    """A few images with the points that were followed in them."""
    samples = drawing.run.sample_frames
    if not samples:
        return None
    across = min(len(samples), 2)
    down = -(-len(samples) // across)
    height, width = samples[0].image.shape[:2]
    figure = new_figure((10.0, 10.0 / across * down * height / width + 0.22 * down + 0.25))
    panels = np.atleast_1d(figure.subplots(down, across)).ravel()
    for axes in panels:
        axes.set_axis_off()
    for axes, sample in zip(panels, samples, strict=False):
        shape = sample.image.shape
        axes.imshow(sample.image, cmap="gray", vmin=0, vmax=255, interpolation="antialiased")
        if len(sample.ids):
            age = np.argsort(np.argsort(sample.ids))
            axes.scatter(*sample.pixels.T, c=age, cmap="plasma", s=16, edgecolors="black", linewidths=0.5)
        axes.set_xlim(-0.5, shape[1] - 0.5)
        axes.set_ylim(shape[0] - 0.5, -0.5)
        time_s = float(drawing.time_s(np.array([sample.stamp_ns], dtype=np.int64))[0])
        axes.set_title(f"{time_s:.2f} s: {len(sample.ids)} tracks", fontsize=9.5, fontweight="normal")
    add_caption(figure, "colour: age of a point among those in the same frame, from dark (oldest) to bright (newest)")
    return figure
