"""The figures of the report: one function each, matplotlib's object interface, no global state.

matplotlib takes a second to import, so it is imported inside the functions.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vioframe.checks import Array, Stamps
from vioframe.conventions import NANOSECONDS
from vioframe.errors import MetricError
from vioframe.evaluation.align import ALIGNMENTS, Alignment, MatchedPoses, Motion, align, align_first
from vioframe.evaluation.metrics import StateErrors, initial_alignment, state_errors
from vioframe.evaluation.protocol import EvaluationOptions, Protocol
from vioframe.evaluation.rows import FARTHEST_M, make_protocol, match, milliseconds_per_frame
from vioframe.evaluation.run import SequenceRun
from vioframe.evaluation.states import StateColumns

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TRUTH, ESTIMATE, FINAL, LOST = "#3d3d3d", "#1f6fb4", "#e0812f", "#c8323c"
PART_COLOURS = ("#8fa3b8", "#3f7fbf", "#58a55c", "#d9a441", "#b5596f", "#7d6bb0", "#c9c9c9")
STYLE: dict[Any, Any] = {
    "font.size": 9.5,
    "axes.titlesize": 11,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#7a7a7a",
    "axes.grid": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.7,
    "legend.frameon": False,
    "legend.fontsize": 9,
    "axes.axisbelow": True,
    "figure.dpi": 100,
    "savefig.dpi": 110,
}
# More points than pixels only cost time.
_MAX_POINTS = 4000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Drawing:
    """What all figures of one sequence share.

    Attributes:
        run: the record.
        columns: all states. states: those after the start.
        protocol: of the causal output.
        matched: states with their truth, or None without truth.
        shown: the alignment of the path, and how it is called.
        upright: the alignment of curves over time: leaves roll and pitch, which the fuser knows, as they are.
        errors: after the alignment of the NEES, or None without truth.
        start_ns: zero of the time axis.
    """

    run: SequenceRun
    columns: StateColumns
    states: StateColumns
    protocol: Protocol
    matched: MatchedPoses | None
    shown: Motion
    shown_name: str
    upright: Motion
    upright_name: str
    errors: StateErrors | None
    start_ns: int

    def time_s(self, stamps_ns: Stamps) -> Array:
        """Seconds since the first state."""
        elapsed: Array = (stamps_ns - self.start_ns) / NANOSECONDS
        return elapsed

    def caption(self, alignment: str) -> str:
        """How curves and truth were laid over each other."""
        return f"{alignment} alignment · {self.protocol.describe()}"


def prepare(run: SequenceRun, options: EvaluationOptions) -> Drawing:
    """Align and match once for all figures of a run."""
    columns = StateColumns.from_states(run.states)
    states = columns.started()
    protocol = make_protocol(run, options, "causal", states.stamps_ns)
    firsts = [int(stamps[0]) for stamps in (columns.stamps_ns, run.track_stamps_ns) if len(stamps)] or [
        0 if run.ground_truth is None else int(run.ground_truth.stamps_ns[0])
    ]
    matched, errors = None, None
    shown, shown_name = upright, upright_name = Motion.identity(), "no"
    try:
        matched = match(states.trajectory(), run.ground_truth, options)
        shown, shown_name = first_alignment(matched, ("se3", "yaw"))
        upright, upright_name = first_alignment(matched, ("yaw",))
        errors = state_errors(matched, states, initial_alignment(matched, states, run.init))
    except MetricError:
        # The reason is in the row, next to each metric that it takes away; figures draw what there is.
        pass
    return Drawing(
        run=run,
        columns=columns,
        states=states,
        protocol=protocol,
        matched=matched,
        shown=shown,
        shown_name=shown_name,
        upright=upright,
        upright_name=upright_name,
        errors=errors,
        start_ns=min(firsts),
    )


def first_alignment(matched: MatchedPoses, choices: tuple[Alignment, ...]) -> tuple[Motion, str]:
    """The first of the choices that the poses determine."""
    for choice in choices:
        try:
            return align(matched, choice), ALIGNMENTS[choice]
        except MetricError:
            continue
    return align_first(matched.T_estimate[0], matched.T_truth[0]), "first-pose"


def draw_run(run: SequenceRun, options: EvaluationOptions, folder: Path) -> dict[str, Path]:
    """Draw every figure that the run has data for.

    Args:
        run: finished or not.
        options: of the metrics.
        folder: made if missing; gets one PNG a figure.

    Returns:
        Paths by figure title, in the order of the report.
    """
    import matplotlib

    drawing = prepare(run, options)
    folder.mkdir(parents=True, exist_ok=True)
    paths: dict[str, Path] = {}
    with matplotlib.rc_context(STYLE):
        for title, name, draw in FIGURES:
            figure = draw(drawing)
            if figure is not None:
                paths[title] = folder / f"{name}.png"
                figure.savefig(paths[title])
    return paths


def new_figure(size_inches: tuple[float, float]) -> "Figure":
    """An empty figure that needs no display and belongs to no global state."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size_inches, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def add_caption(figure: "Figure", text: str) -> None:
    """Small print below: the protocol."""
    figure.supxlabel(text, fontsize=8, color="#7a7a7a", x=0.99, ha="right")


def _thin(count: int) -> slice:
    return slice(None, None, max(1, -(-count // _MAX_POINTS)))


def with_breaks(time_s: Array, values: Array) -> tuple[Array, Array]:
    """Curves that stop at holes: NaN where five usual intervals or more are missing; values (N, ...)."""
    picked = _thin(len(time_s))
    time_s, values = time_s[picked], values[picked]
    if len(time_s) < 3:
        return time_s, values
    steps = np.diff(time_s)
    holes = np.flatnonzero(steps > 5.0 * np.median(steps)) + 1
    return np.insert(time_s, holes, np.nan), np.insert(values, holes, np.nan, axis=0)


def _shade(axes: "Axes", drawing: Drawing) -> None:
    """Grey while starting, red while lost."""
    time_s = drawing.time_s(drawing.columns.stamps_ns)
    for status, colour in (("starting", "#9a9a9a"), ("lost", LOST)):
        flagged = np.concatenate([[False], drawing.columns.status == status, [False]])
        edges = np.flatnonzero(np.diff(flagged.astype(np.int8)))
        for begin, end in zip(edges[::2], edges[1::2], strict=True):
            axes.axvspan(time_s[begin], time_s[min(end, len(time_s) - 1)], color=colour, alpha=0.13, linewidth=0)


def _status_legend(drawing: Drawing) -> list[object]:
    from matplotlib.patches import Patch

    entries: list[object] = []
    for status, colour in (("starting", "#9a9a9a"), ("lost", LOST)):
        if (drawing.columns.status == status).any():
            entries.append(Patch(color=colour, alpha=0.25, linewidth=0, label=status))
    return entries


def _legend(figure: "Figure", axes: "Axes", drawing: Drawing, *, status: bool = True) -> None:
    handles: list[object] = list(axes.get_legend_handles_labels()[0])
    if status:
        handles += _status_legend(drawing)
    if handles:
        figure.legend(handles=handles, loc="outside upper right", ncols=len(handles))


def _shown_truth(drawing: Drawing) -> tuple[Stamps, Array] | None:
    """The truth over the span of the recording."""
    truth = drawing.run.ground_truth
    if truth is None:
        return None
    stamps = drawing.columns.stamps_ns if len(drawing.columns) else truth.stamps_ns
    margin = NANOSECONDS
    inside = (truth.stamps_ns >= stamps[0] - margin) & (truth.stamps_ns <= stamps[-1] + margin)
    return truth.stamps_ns[inside], truth.T_world_body[inside]


def draw_top_view(drawing: Drawing) -> "Figure | None":
    """The path from above, beside the truth, with equal axes."""
    if len(drawing.states) == 0:
        return None
    position = drawing.shown.apply(drawing.states.T_world_body)[:, :3, 3]
    if np.abs(position).max() > FARTHEST_M:
        return None
    truth = _shown_truth(drawing)
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
    _legend(figure, axes, drawing, status=False)
    add_caption(figure, drawing.caption(drawing.shown_name))
    return figure


def plot_path(axes: "Axes", stamps_ns: Stamps, position: Array, **style: object) -> None:
    """Plot the first two columns of positions (N, 2 or more) m, with breaks where poses are missing."""
    _, broken = with_breaks((stamps_ns - stamps_ns[0]) / NANOSECONDS, position)
    axes.plot(broken[:, 0], broken[:, 1], **style)  # type: ignore[arg-type]


def _shown_final(drawing: Drawing) -> Motion:
    """The final trajectory is laid over the truth by itself: its world may have turned since."""
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
    truth = _shown_truth(drawing)
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
            # Unwrapping starts anywhere: bring the curve to within half a turn of the truth where it begins.
            known_s, known = reference
            at_start = np.interp(drawing.time_s(stamps_ns)[0], known_s, known[:, 2])
            angles[:, 2] -= 360.0 * np.round((angles[0, 2] - at_start) / 360.0)
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
            _shade(panels[axis, column], drawing)
    panels[0, 0].set_title(f"{drawing.run.sequence}: position")
    panels[0, 1].set_title("Orientation")
    for axes in panels[2]:
        axes.set_xlabel("time (s)")
    figure.align_ylabels()
    _legend(figure, panels[0, 0], drawing)
    add_caption(figure, drawing.caption(drawing.upright_name))
    return figure


def _widen(axes: "Axes", smallest: float) -> None:
    """Keep noise of a body at rest from filling the panel."""
    low, high = axes.get_ylim()
    if high - low < smallest:
        centre = 0.5 * (low + high)
        axes.set_ylim(centre - 0.5 * smallest, centre + 0.5 * smallest)


def _roll_pitch_yaw_deg(R: Array) -> Array:
    """Angles (N, 3) of ``R = Rz(yaw) Ry(pitch) Rx(roll)``; yaw and roll without jumps."""
    roll = np.unwrap(np.arctan2(R[:, 2, 1], R[:, 2, 2]))
    pitch = np.arcsin(np.clip(-R[:, 2, 0], -1.0, 1.0))
    yaw = np.unwrap(np.arctan2(R[:, 1, 0], R[:, 0, 0]))
    angles: Array = np.rad2deg(np.stack([roll, pitch, yaw], axis=1))
    return angles


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
    _legend(figure, panels[0, 0], drawing)
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
        axes.text(
            0.01, 0.95, f"{100 * inside:.1f} % inside", transform=axes.transAxes, ha="left", va="top",
            fontsize=8, color="#5a5a5a",
        )  # fmt: skip
    axes.plot(time_s, broken[:, 0], color=ESTIMATE, linewidth=1.1, label="truth − estimate")
    limit = max(limit, smallest)
    axes.set_ylim(-limit, limit)
    _shade(axes, drawing)


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
            _shade(axes, drawing)
        panels[0, column].set_ylim(*_bias_limits(both))
        panels[2, column].set_xlabel("time (s)")
    figure.align_ylabels()
    panels[0, 0].set_title(f"{drawing.run.sequence}: gyro bias")
    panels[0, 1].set_title("Accelerometer bias")
    _legend(figure, panels[0, 0], drawing)
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
    _shade(axes, drawing)
    _legend(figure, axes, drawing)
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
    axes.barh(names, values, color=[PART_COLOURS[k % len(PART_COLOURS)] for k in range(len(names))], height=0.66)
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


Draw = Callable[[Drawing], "Figure | None"]
FIGURES: Sequence[tuple[str, str, Draw]] = (
    ("Path from above", "top_view", draw_top_view),
    ("Position and orientation", "pose", draw_pose),
    ("Errors with 3σ bounds", "errors", draw_errors),
    ("Biases", "biases", draw_biases),
    ("Tracks", "tracks", draw_tracks),
    ("Time by part", "time", draw_time),
    ("Frames", "frames", draw_frames),
)
"""Title, file name and function of each figure, in the order of the report."""
