"""What the fuser claims to know: errors and biases within their 3σ bounds."""

from typing import TYPE_CHECKING

import numpy as np

from vioframe.checks import Array
from vioframe.evaluation.metrics import StateErrors
from vioframe.evaluation.plots.canvas import ESTIMATE, add_caption, new_figure, with_breaks
from vioframe.evaluation.plots.drawing import Drawing, add_legend, shade

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def draw_errors(drawing: Drawing) -> "Figure | None":
    """Position and orientation error over time, with the 3σ bounds that the fuser claims."""
    errors = drawing.errors
    if errors is None or len(errors.stamps_ns) == 0:
        return None
    figure = new_figure((11.0, 6.4))
    panels = figure.subplots(3, 2, sharex=True)
    sigma = np.sqrt(np.maximum(np.diagonal(errors.covariance, axis1=1, axis2=2), 0.0))
    columns = (
        (errors.position, sigma[:, 3:], 1.0, "xyz", "m", 0.01),
        (errors.theta, sigma[:, :3], np.rad2deg(1.0), ("about x", "about y", "about z"), "°", 0.1),
    )
    for column, (values, deviation, factor, names, unit, smallest) in enumerate(columns):
        for axis in range(3):
            axes = panels[axis, column]
            _error_panel(axes, drawing, errors, values[:, axis] * factor, 3.0 * deviation[:, axis] * factor, smallest)
            axes.set_ylabel(f"{names[axis]} ({unit})")
    panels[0, 0].set_title(f"{drawing.run.sequence}: position error (world)")
    panels[0, 1].set_title("Orientation error (body)")
    for axes in panels[2]:
        axes.set_xlabel("time (s)")
    figure.align_ylabels()
    add_legend(figure, panels[0, 0], drawing)
    add_caption(figure, f"aligned: {drawing.protocol.nees_alignment} · {drawing.protocol.describe()}")
    return figure


def _error_panel(
    axes: "Axes", drawing: Drawing, errors: StateErrors, values: Array, bound: Array, smallest: float
) -> None:
    time_s, broken = with_breaks(drawing.time_s(errors.stamps_ns), np.stack([values, bound], axis=1))
    axes.axhline(0.0, color="#9a9a9a", linewidth=0.8)
    largest = max(float(np.abs(values).max()), 1e-12)
    limit = 1.25 * largest
    known = np.isfinite(bound)
    if known.any():
        axes.fill_between(
            time_s, -broken[:, 1], broken[:, 1], color=ESTIMATE, alpha=0.16, linewidth=0, label="3σ of the fuser"
        )
        # Bounds that dwarf the error would hide it.
        limit = max(limit, min(1.1 * float(bound[known].max()), 5.0 * largest))
        inside = float((np.abs(values[known]) <= bound[known]).mean())
        # A fuser that knows its start only would else look as if it knew the rest.
        few = "" if known.all() else f" where there are bounds: {known.sum()} of {len(known)} states"
        axes.text(
            0.01, 0.95, f"{100 * inside:.1f} % inside{few}", transform=axes.transAxes, ha="left", va="top",
            fontsize=8, color="#5a5a5a",
        )  # fmt: skip
    axes.plot(time_s, broken[:, 0], color=ESTIMATE, linewidth=1.1, label="truth − estimate")
    limit = max(limit, smallest)
    axes.set_ylim(-limit, limit)
    shade(axes, drawing)


def draw_biases(drawing: Drawing) -> "Figure | None":
    """Estimated biases over time, with 3σ."""
    states = drawing.states
    if len(states) == 0 or (not states.bias.any() and not np.nan_to_num(states.bias_sigma).any()):
        return None
    figure = new_figure((11.0, 5.6))
    panels = figure.subplots(3, 2, sharex=True, sharey="col")
    for column, (part, factor, unit) in enumerate(((slice(0, 3), np.rad2deg(1.0), "°/s"), (slice(3, 6), 1.0, "m/s²"))):
        both = np.concatenate([states.bias[:, part], 3.0 * states.bias_sigma[:, part]], axis=1) * factor
        time_s, broken = with_breaks(drawing.time_s(states.stamps_ns), both)
        for axis in range(3):
            axes = panels[axis, column]
            value, bound = broken[:, axis], broken[:, 3 + axis]
            if np.isfinite(bound).any():
                axes.fill_between(
                    time_s,
                    value - bound,
                    value + bound,
                    color=ESTIMATE,
                    alpha=0.16,
                    linewidth=0,
                    label="± 3σ of the fuser",
                )
            axes.plot(time_s, value, color=ESTIMATE, linewidth=1.2, label="estimate")
            axes.axhline(0.0, color="#9a9a9a", linewidth=0.8)
            axes.set_ylabel(f"{'xyz'[axis]} ({unit})")
            shade(axes, drawing)
        panels[0, column].set_ylim(*_bias_limits(both))
        panels[2, column].set_xlabel("time (s)")
    figure.align_ylabels()
    panels[0, 0].set_title(f"{drawing.run.sequence}: gyro bias")
    panels[0, 1].set_title("Accelerometer bias")
    add_legend(figure, panels[0, 0], drawing)
    add_caption(figure, drawing.protocol.describe())
    return figure


def _bias_limits(values_and_bounds: Array) -> tuple[float, float]:
    """Limits that show all values, and of the bounds (values_and_bounds[:, 3:]) what is there after the start."""
    values, bounds = values_and_bounds[:, :3], np.nan_to_num(values_and_bounds[:, 3:])
    settled = bounds[len(bounds) // 3 :]
    width = float(np.median(settled, axis=0).max()) if len(settled) else 0.0
    low, high = float(values.min()) - 1.3 * width, float(values.max()) + 1.3 * width
    margin = 0.05 * (high - low) + 1e-6
    return low - margin, high + margin
