"""What every figure starts from: colours, style, an empty figure, and curves that stop at holes."""

from typing import TYPE_CHECKING, Any

import numpy as np

from vioframe.checks import Array, Stamps
from vioframe.conventions import NANOSECONDS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TRUTH, ESTIMATE, FINAL, STARTING, LOST = "#3d3d3d", "#1f6fb4", "#e0812f", "#9a9a9a", "#c8323c"
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


def with_breaks(time_s: Array, values: Array) -> tuple[Array, Array]:
    """Curves that stop at holes: NaN where five usual intervals or more are missing; values (N, ...)."""
    picked = slice(None, None, max(1, -(-len(time_s) // _MAX_POINTS)))
    time_s, values = time_s[picked], values[picked]
    if len(time_s) < 3:
        return time_s, values
    steps = np.diff(time_s)
    holes = np.flatnonzero(steps > 5.0 * np.median(steps)) + 1
    return np.insert(time_s, holes, np.nan), np.insert(values, holes, np.nan, axis=0)


def plot_path(axes: "Axes", stamps_ns: Stamps, position: Array, **style: object) -> None:
    """Plot the first two columns of positions (N, 2 or more) m, with breaks where poses are missing."""
    _, broken = with_breaks((stamps_ns - stamps_ns[0]) / NANOSECONDS, position)
    axes.plot(broken[:, 0], broken[:, 1], **style)  # type: ignore[arg-type]
