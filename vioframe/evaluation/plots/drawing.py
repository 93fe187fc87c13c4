"""One sequence as all its figures see it: aligned once, with what they have in common."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vioframe.checks import Array, Stamps
from vioframe.conventions import NANOSECONDS
from vioframe.errors import MetricError
from vioframe.evaluation.align import ALIGNMENTS, Alignment, MatchedPoses, Motion, align, align_first
from vioframe.evaluation.metrics import StateErrors, initial_alignment, state_errors
from vioframe.evaluation.plots.canvas import LOST, STARTING
from vioframe.evaluation.protocol import EvaluationOptions, Protocol
from vioframe.evaluation.rows import make_protocol, match
from vioframe.evaluation.run import SequenceRun
from vioframe.evaluation.states import StateColumns

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_STATUS_COLOURS = (("starting", STARTING), ("lost", LOST))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Drawing:
    """What all figures of one sequence share.

    Attributes:
        run: the record.
        columns: all states.
        states: those after the start.
        protocol: of the causal output.
        matched: states with their truth, or None without truth.
        shown: the alignment of the path, estimate into truth.
        shown_name: how a caption calls it.
        upright: the alignment of curves over time: leaves roll and pitch, which the fuser knows, as they are.
        upright_name: how a caption calls it.
        errors: after the alignment of the NEES, or None without truth.
        start_ns: zero of the time axis: the first state or image, IMU clock.
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
        """Seconds (N,) since ``start_ns``, of stamps on the IMU clock."""
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


def shade(axes: "Axes", drawing: Drawing) -> None:
    """Shade a time axis: grey while starting, red while lost."""
    time_s = drawing.time_s(drawing.columns.stamps_ns)
    for status, colour in _STATUS_COLOURS:
        flagged = np.concatenate([[False], drawing.columns.status == status, [False]])
        edges = np.flatnonzero(np.diff(flagged.astype(np.int8)))
        for begin, end in zip(edges[::2], edges[1::2], strict=True):
            axes.axvspan(time_s[begin], time_s[min(end, len(time_s) - 1)], color=colour, alpha=0.13, linewidth=0)


def add_legend(figure: "Figure", axes: "Axes", drawing: Drawing, *, status: bool = True) -> None:
    """Name the curves of ``axes`` above the figure, and with ``status`` the shades that occur."""
    handles: list[object] = list(axes.get_legend_handles_labels()[0])
    if status:
        handles += _statusadd_legend(drawing)
    if handles:
        figure.legend(handles=handles, loc="outside upper right", ncols=len(handles))


def _statusadd_legend(drawing: Drawing) -> list[object]:
    from matplotlib.patches import Patch

    entries: list[object] = []
    for status, colour in _STATUS_COLOURS:
        if (drawing.columns.status == status).any():
            entries.append(Patch(color=colour, alpha=0.25, linewidth=0, label=status))
    return entries


def shown_truth(drawing: Drawing) -> tuple[Stamps, Array] | None:
    """The truth over the span of the recording."""
    truth = drawing.run.ground_truth
    if truth is None:
        return None
    stamps = drawing.columns.stamps_ns if len(drawing.columns) else truth.stamps_ns
    margin = NANOSECONDS
    inside = (truth.stamps_ns >= stamps[0] - margin) & (truth.stamps_ns <= stamps[-1] + margin)
    return truth.stamps_ns[inside], truth.T_world_body[inside]
