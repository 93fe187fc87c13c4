"""All figures of one sequence."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vioframe.evaluation.plots.bounds import draw_biases, draw_errors
from vioframe.evaluation.plots.canvas import STYLE
from vioframe.evaluation.plots.drawing import Drawing, prepare
from vioframe.evaluation.plots.motion import draw_pose, draw_top_view
from vioframe.evaluation.plots.parts import draw_frames, draw_time, draw_tracks
from vioframe.evaluation.protocol import EvaluationOptions
from vioframe.evaluation.run import SequenceRun

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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
