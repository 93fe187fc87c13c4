"""Pictures of a training: trajectories of the validation, a pair of images with its flow, and the curve."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vioframe.checks import Array, Mask
from vioframe.data.windows import StoredSequence
from vioframe.evaluation.plots.canvas import ESTIMATE, FINAL, STYLE, TRUTH, add_caption, new_figure
from vioframe.learning.flow_colours import colour_wheel, flow_colours, wheel_radius
from vioframe.learning.scoring import Score, chain

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_TRAINING, _VALIDATION = FINAL, ESTIMATE
# Values that spread further than this are drawn over a logarithm.
_WIDE = 20.0

# More recordings than this would make a figure that nobody reads.
_MOST = 6


def draw_trajectories(path: Path, trajectories: Sequence[tuple[StoredSequence, Array, Mask]], caption: str) -> None:
    """Write a figure of the first recordings: truth, and each unbroken chain of predictions from its true start.

    Args:
        path: a PNG file.
        trajectories: recording, its predicted motions (F - 1, 4, 4), and where there are any.
        caption: small print.
    """
    import matplotlib as mpl

    shown = trajectories[:_MOST]
    columns = min(len(shown), 3)
    rows = -(-len(shown) // columns)
    with mpl.rc_context(STYLE):
        # The caption needs six inches.
        figure = new_figure((max(4.2 * columns, 6.4), 3.8 * rows))
        for number, (sequence, motions, answered) in enumerate(shown):
            axes = figure.add_subplot(rows, columns, number + 1)
            known = sequence.T_world_cam[sequence.known, :3, 3]
            axes.plot(known[:, 0], known[:, 1], color=TRUTH, linewidth=1.2, label="truth")
            pairs = np.flatnonzero(answered & sequence.known[:-1] & sequence.known[1:])
            for index, run in enumerate(np.split(pairs, np.flatnonzero(np.diff(pairs) != 1) + 1)):
                if len(run):
                    predicted = chain(motions[run], sequence.T_world_cam[run[0]])[:, :3, 3]
                    label = "predicted" if index == 0 else None
                    axes.plot(predicted[:, 0], predicted[:, 1], color=ESTIMATE, linewidth=1.2, label=label)
            axes.set_aspect("equal", adjustable="datalim")
            axes.set_title(sequence.name)
            axes.set_xlabel("x [m]")
            axes.set_ylabel("y [m]")
            axes.legend()
        add_caption(figure, caption)
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path)


def draw_flow(path: Path, pair: Array, flow: Array, caption: str) -> None:
    """Write a figure of a pair of images and its flow: direction as colour, length as its strength.

    Args:
        path: a PNG file.
        pair: (2, H, W, 1 or 3) in [0, 1], the earlier image first.
        flow: (H, W, 2) px, x then y, on the grid of the earlier image.
        caption: small print.
    """
    import matplotlib as mpl

    height, width = flow.shape[:2]
    radius_px = wheel_radius(flow)
    panel = min(max(2.6 * width / height, 2.6), 5.2)
    # Images that are taller than wide need no more room than square ones.
    side = panel * height / width
    with mpl.rc_context({**STYLE, "axes.grid": False}):
        figure = new_figure((2 * panel + min(side, 2.6) + 0.6, min(side, 5.2) + 0.9))
        panels = figure.subplots(1, 3, width_ratios=[panel, panel, min(side, 2.6)])
        image = pair[0] if pair.shape[-1] == 3 else pair[0][..., 0]
        shown = {"first image": np.clip(image, 0.0, 1.0), "flow to the second": flow_colours(flow, radius_px)}
        for axes, (title, picture) in zip(panels, shown.items(), strict=False):
            axes.imshow(picture, cmap="gray", vmin=0.0, vmax=1.0, interpolation="nearest")
            axes.set_title(title)
            axes.set_axis_off()
        legend = panels[2]
        reach = (-radius_px, radius_px)
        # Rows grow downwards, as y does in an image.
        legend.imshow(colour_wheel(200), extent=(*reach, *reach[::-1]), interpolation="nearest")
        legend.set_title("px", loc="center")
        legend.set_xticks([-radius_px, 0.0, radius_px])
        legend.set_yticks([-radius_px, 0.0, radius_px])
        legend.tick_params(labelsize=8, length=2)
        legend.spines[:].set_visible(False)
        longest = float(np.linalg.norm(flow, axis=-1).max())
        add_caption(figure, f"{caption} · longest flow {longest:.1f} px")
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path)


def draw_curve(path: Path, rows: Sequence[Mapping[str, float]], reference: Score, beside: str) -> None:
    """Write a figure of a training's curve: loss, t_rel, r_rel and learning rate over the epochs.

    Args:
        path: a PNG file.
        rows: an epoch each, as in ``curve.csv``.
        reference: score to compare with, on the validation recordings.
        beside: what it is of.
    """
    import matplotlib as mpl

    ranked = [row for row in rows if "validation/relative_to_reference" in row]
    best = min(ranked, key=lambda row: row["validation/relative_to_reference"], default=None)
    with mpl.rc_context(STYLE):
        figure = new_figure((9.0, 5.6))
        (loss, t_rel), (rate, r_rel) = figure.subplots(2, 2, sharex=True)
        _draw_series(loss, rows, "train/loss", _TRAINING, "training")
        _draw_series(loss, rows, "validation/loss", _VALIDATION, "validation")
        loss.set_title("loss")
        loss.legend()
        for axes, name, level, title in (
            (t_rel, "t_rel_percent", reference.t_rel_percent, "t_rel [%]"),
            (r_rel, "r_rel_deg_per_100m", reference.r_rel_deg_per_100m, "r_rel [°/100 m]"),
        ):
            _draw_series(axes, rows, f"validation/{name}", _VALIDATION, "validation")
            axes.axhline(level, color=TRUTH, linewidth=1.0, linestyle="--", label=beside)
            if best is not None:
                told = f"best weights: {best[f'validation/{name}']:.3g}"
                axes.plot(best["epoch"], best[f"validation/{name}"], "o", color=FINAL, markersize=5, label=told)
            axes.set_title(title)
            axes.legend()
        _draw_series(rate, rows, "learning_rate", TRUTH, "")
        rate.set_title("learning rate")
        rate.ticklabel_format(axis="y", scilimits=(-2, 2))
        for axes in (loss, t_rel, rate, r_rel):
            _scale(axes)
        for axes in (rate, r_rel):
            axes.set_xlabel("epoch")
            axes.xaxis.get_major_locator().set_params(integer=True)
        add_caption(figure, "t_rel and r_rel: camera 0 of the validation recordings, causal, no alignment")
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path)


def _draw_series(axes: "Axes", rows: Sequence[Mapping[str, float]], name: str, colour: str, label: str) -> None:
    found = [(row["epoch"], row[name]) for row in rows if name in row and np.isfinite(row[name])]
    if found:
        # A single epoch makes no line.
        style = {"marker": "o", "markersize": 3} if len(found) < 15 else {}
        axes.plot(*zip(*found, strict=True), color=colour, linewidth=1.4, label=label, **style)  # type: ignore[arg-type]


def _scale(axes: "Axes") -> None:
    """Choose a scale on which a large beginning does not hide what follows."""
    from matplotlib.ticker import AsinhLocator, NullLocator

    values = np.concatenate([np.asarray(line.get_ydata(), dtype=float) for line in axes.get_lines()] or [np.zeros(0)])
    sizes = np.abs(values[values != 0.0])
    if len(sizes) == 0 or sizes.max() < _WIDE * np.median(sizes):
        return
    if values.min() > 0.0:
        axes.set_yscale("log")
    else:
        width = float(np.median(sizes))
        axes.set_yscale("asinh", linear_width=width)
        axes.yaxis.set_major_locator(AsinhLocator(width, numticks=5))
        axes.yaxis.set_minor_locator(NullLocator())
