"""The motion: the path from above, position and orientation over time."""

from typing import TYPE_CHECKING

import numpy as np

from vioframe.checks import Array
from vioframe.errors import MetricError
from vioframe.evaluation.align import Motion
from vioframe.evaluation.plots.canvas import (
    ESTIMATE,
    FINAL,
    LOST,
    TRUTH,
    add_caption,
    new_figure,
    plot_path,
    with_breaks,
)
from vioframe.evaluation.plots.drawing import Drawing, add_legend, first_alignment, shade, shown_truth
from vioframe.evaluation.rows import FARTHEST_M, match

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def draw_top_view(drawing: Drawing) -> "Figure | None":
    """The path from above, beside the truth, with equal axes."""
    if len(drawing.states) == 0:
        return None
    position = drawing.shown.apply(drawing.states.T_world_body)[:, :3, 3]
    if np.abs(position).max() > FARTHEST_M:
        return None
    truth = shown_truth(drawing)
    figure = new_figure((8.2, 6.8))
    axes = figure.subplots()
    if truth is not None and len(truth[0]):
        plot_path(axes, truth[0], truth[1][:, :3, 3], color=TRUTH, linewidth=3.2, alpha=0.45, label="ground truth")
    smoothed = drawing.run.smoothed
    if smoothed is not None:
        final = _shown_final(drawing).apply(smoothed.T_world_body)[:, :3, 3]
        plot_path(axes, smoothed.stamps_ns, final, color=FINAL, linewidth=1.2, label="estimate, final")
    plot_path(axes, drawing.states.stamps_ns, position, color=ESTIMATE, linewidth=1.5, label="estimate, causal")
    lost = drawing.states.status == "lost"
    if lost.any():
        axes.plot(*position[lost, :2].T, ".", color=LOST, markersize=4, label="lost")
    axes.plot(*position[0, :2], "o", color=ESTIMATE, markeredgecolor="white", markersize=9, label="start")
    axes.plot(*position[-1, :2], "s", color=ESTIMATE, markeredgecolor="white", markersize=9, label="end")
    axes.set_aspect("equal", adjustable="datalim")
    # A body that stands still must not have its noise blown up to the size of the figure.
    low, high = position[:, :2].min(axis=0), position[:, :2].max(axis=0)
    if (high - low).max() < 0.2:
        centre = 0.5 * (low + high)
        axes.update_datalim(np.stack([centre - 0.15, centre + 0.15]))
        axes.autoscale_view()
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")
    axes.set_title(f"{drawing.run.sequence}: path from above")
    add_legend(figure, axes, drawing, status=False)
    add_caption(figure, drawing.caption(drawing.shown_name))
    return figure


def _shown_final(drawing: Drawing) -> Motion:
    """The alignment of the final trajectory, which has its own: its world may have turned since."""
    smoothed, truth = drawing.run.smoothed, drawing.run.ground_truth
    if smoothed is None or truth is None:
        return drawing.shown
    try:
        return first_alignment(match(smoothed, truth, drawing.protocol.options), ("se3", "yaw"))[0]
    except MetricError:
        return drawing.shown


def draw_pose(drawing: Drawing) -> "Figure | None":
    """Position and orientation over time."""
    if len(drawing.states) == 0:
        return None
    figure = new_figure((11.0, 6.4))
    panels = figure.subplots(3, 2, sharex=True)
    curves = [(drawing.states.stamps_ns, drawing.upright.apply(drawing.states.T_world_body), "estimate, causal")]
    truth = shown_truth(drawing)
    if truth is not None and len(truth[0]):
        curves.insert(0, (*truth, "ground truth"))
    styles = {
        "ground truth": {"color": TRUTH, "linewidth": 2.8, "alpha": 0.45},
        "estimate, causal": {"color": ESTIMATE, "linewidth": 1.2},
    }
    reference = None
    for stamps_ns, poses, label in curves:
        time_s, position = with_breaks(drawing.time_s(stamps_ns), poses[:, :3, 3])
        angles = _roll_pitch_yaw_deg(poses[:, :3, :3])
        if reference is not None:
            known_s, known = reference
            start_s = drawing.time_s(stamps_ns)[0]
            angles = nearest_turn_deg(angles, np.array([np.interp(start_s, known_s, column) for column in known.T]))
        else:
            reference = (drawing.time_s(stamps_ns), angles)
        _, angles = with_breaks(drawing.time_s(stamps_ns), angles)
        for axis in range(3):
            panels[axis, 0].plot(time_s, position[:, axis], label=label, **styles[label])
            panels[axis, 1].plot(time_s, angles[:, axis], **styles[label])
    for axis in range(3):
        panels[axis, 0].set_ylabel(f"{'xyz'[axis]} (m)")
        panels[axis, 1].set_ylabel(f"{('roll', 'pitch', 'yaw')[axis]} (°)")
        for column, smallest in ((0, 0.1), (1, 1.0)):
            _widen(panels[axis, column], smallest)
            shade(panels[axis, column], drawing)
    panels[0, 0].set_title(f"{drawing.run.sequence}: position")
    panels[0, 1].set_title("Orientation")
    for axes in panels[2]:
        axes.set_xlabel("time (s)")
    figure.align_ylabels()
    add_legend(figure, panels[0, 0], drawing)
    add_caption(figure, drawing.caption(drawing.upright_name))
    return figure


def _widen(axes: "Axes", smallest: float) -> None:
    """Keep noise of a body at rest from filling the panel."""
    low, high = axes.get_ylim()
    if high - low < smallest:
        centre = 0.5 * (low + high)
        axes.set_ylim(centre - 0.5 * smallest, centre + 0.5 * smallest)


def nearest_turn_deg(angles: Array, at_start: Array) -> Array:
    """Angles (N, 3) moved by whole turns so that the first is within half a turn of ``at_start`` (3,), all in °.

    Unwrapping starts anywhere: a body near ±180° would else be drawn a turn away from the truth.
    """
    moved: Array = angles - 360.0 * np.round((angles[0] - at_start) / 360.0)
    return moved


def _roll_pitch_yaw_deg(R: Array) -> Array:
    """Angles (N, 3) of ``R = Rz(yaw) Ry(pitch) Rx(roll)``; yaw and roll without jumps."""
    roll = np.unwrap(np.arctan2(R[:, 2, 1], R[:, 2, 2]))
    pitch = np.arcsin(np.clip(-R[:, 2, 0], -1.0, 1.0))
    yaw = np.unwrap(np.arctan2(R[:, 1, 0], R[:, 0, 0]))
    angles: Array = np.rad2deg(np.stack([roll, pitch, yaw], axis=1))
    return angles
