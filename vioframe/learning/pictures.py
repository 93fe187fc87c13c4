"""What the predicted motions of a validation make of the recordings, seen from above."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from vioframe.checks import Array, Mask
from vioframe.data.windows import StoredSequence
from vioframe.evaluation.plots.canvas import ESTIMATE, STYLE, TRUTH, add_caption, new_figure
from vioframe.learning.scoring import chain

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
