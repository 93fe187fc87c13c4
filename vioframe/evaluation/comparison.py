"""Trajectory files beside each other, for ``task=evaluate``."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vioframe.checks import Array
from vioframe.conventions import NANOSECONDS
from vioframe.errors import MetricError
from vioframe.evaluation.align import ALIGNMENTS, Alignment, MatchedPoses, Motion, align
from vioframe.evaluation.metrics import position_errors
from vioframe.evaluation.plots.canvas import STYLE, TRUTH, add_caption, new_figure, plot_path, with_breaks
from vioframe.evaluation.protocol import EvaluationOptions, describe_association
from vioframe.types import Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLOURS = ("#1f6fb4", "#e0812f", "#3a8f4d", "#8a5ab5", "#c8443c", "#2aa3a3", "#b58a2a", "#d16ba5")


def draw_comparison(
    matched: Mapping[str, MatchedPoses],
    truth: Trajectory,
    options: EvaluationOptions,
    alignment: Alignment,
    folder: Path,
) -> dict[str, Path]:
    """Draw all estimates in one figure from above, and their position errors over time in another.

    Args:
        matched: poses of each estimate with their truth, by name; an estimate whose alignment is not defined
            is left out.
        truth: the whole of it.
        options: of the association.
        alignment: of each estimate, by itself.
        folder: gets ``top_view.png`` and ``errors.png``.

    Returns:
        Paths by title; nothing where no estimate could be aligned.
    """
    import matplotlib

    motions: dict[str, Motion] = {}
    for name, poses in matched.items():
        try:
            motions[name] = align(poses, alignment)
        except MetricError:
            # The row says why.
            continue
    if not motions:
        return {}
    folder.mkdir(parents=True, exist_ok=True)
    caption = f"{ALIGNMENTS[alignment]} alignment · {describe_association(options)}"
    paths = {"Path from above": folder / "top_view.png", "Position error over time": folder / "errors.png"}
    shown = {name: matched[name] for name in motions}
    with matplotlib.rc_context(STYLE):
        plane = (0, 1) if alignment == "yaw" else _widest_plane(truth)
        _draw_paths(shown, motions, truth, plane, caption).savefig(paths["Path from above"])
        _draw_errors(shown, motions, truth, caption).savefig(paths["Position error over time"])
    return paths


def _widest_plane(truth: Trajectory) -> tuple[int, int]:
    """The two axes along which the truth spreads: x and z in a camera's world, x and y where z is up."""
    narrowest = int(np.argmin(np.ptp(truth.T_world_body[:, :3, 3], axis=0)))
    first, second = (axis for axis in range(3) if axis != narrowest)
    return first, second


def _draw_paths(
    matched: Mapping[str, MatchedPoses],
    motions: Mapping[str, Motion],
    truth: Trajectory,
    plane: tuple[int, int],
    caption: str,
) -> "Figure":
    figure = new_figure((8.2, 6.8))
    axes = figure.subplots()
    flat = list(plane)
    true_path = truth.T_world_body[:, :3, 3][:, flat]
    plot_path(axes, truth.stamps_ns, true_path, color=TRUTH, linewidth=3.2, alpha=0.45, label="ground truth")
    for (name, poses), colour in zip(matched.items(), _repeat(len(matched)), strict=True):
        position = motions[name].apply(poses.T_estimate)[:, :3, 3][:, flat]
        plot_path(axes, poses.stamps_ns, position, color=colour, linewidth=1.4, label=name)
        axes.plot(*position[0], "o", color=colour, markeredgecolor="white", markersize=8)
        axes.plot(*position[-1], "s", color=colour, markeredgecolor="white", markersize=8)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel(f"{'xyz'[plane[0]]} (m)")
    axes.set_ylabel(f"{'xyz'[plane[1]]} (m)")
    axes.set_title("Paths (circle: start, square: end)")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper right", ncols=min(len(matched) + 1, 4))
    add_caption(figure, caption)
    return figure


def _draw_errors(
    matched: Mapping[str, MatchedPoses], motions: Mapping[str, Motion], truth: Trajectory, caption: str
) -> "Figure":
    figure = new_figure((10.0, 4.0))
    axes = figure.subplots()
    for (name, poses), colour in zip(matched.items(), _repeat(len(matched)), strict=True):
        distance: Array = np.linalg.norm(position_errors(poses, motions[name]), axis=1)
        time_s, broken = with_breaks((poses.stamps_ns - truth.stamps_ns[0]) / NANOSECONDS, distance)
        axes.plot(time_s, broken, color=colour, linewidth=1.2, label=name)
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("time since the start of the ground truth (s)")
    axes.set_ylabel("position error (m)")
    axes.set_title("Position error")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper right", ncols=min(len(matched), 4))
    add_caption(figure, caption)
    return figure


def _repeat(count: int) -> list[str]:
    return [_COLOURS[k % len(_COLOURS)] for k in range(count)]
