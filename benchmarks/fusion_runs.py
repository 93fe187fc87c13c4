"""Runs behind ``benchmarks/fusion.py``: composed as the command line composes them, trained once, kept once."""

import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from omegaconf import DictConfig

from vioframe.build import build_dataset, build_pipeline
from vioframe.composing import Composed, Composer
from vioframe.errors import VioframeError
from vioframe.evaluation.rows import Row, evaluate_run
from vioframe.evaluation.run import SequenceRun
from vioframe.pipeline import Pipeline
from vioframe.study.cells import CellResult, CellStore, cell_key, failed, run_cell
from vioframe.study.weights import lend, weights_of
from vioframe.tasks.experiment import build_options
from vioframe.tasks.run_sequence import run_sequence

ROWS = {
    "vo_only": ["fuser=vo_only", "integrator=none"],
    # The odometry stays, unread: its options are those of a table.
    "imu_only": ["fuser=imu_only"],
    "ekf": ["fuser=ekf"],
    "msf": ["fuser=msf"],
    # EE-LCVIO's net as the paper has it, at the trainer's width, and the same net as a correction of the odometry.
    "lstm_paper": [
        "fuser=lstm",
        "fuser.head=pose",
        "fuser.pose.pose=absolute",
        "fuser.pose.refines=false",
        "fuser.pose.activation=relu",
        "fuser.pose.translation_unit=1",
        "fuser.pose.rotation_unit=1",
    ],
    "lstm_pose": ["fuser=lstm", "fuser.head=pose"],
    "lstm": ["fuser=lstm", "fuser.head=residual"],
    "ekf_vio": ["fuser=ekf_vio"],
}
"""Systems by name; the odometry of a table wins over what a fuser would bring."""

FUSED = tuple(name for name in ROWS if name not in ("vo_only", "imu_only"))


@dataclass(frozen=True)
class Options:
    """The command line.

    Attributes:
        root: folder of the recordings.
        rows: systems; None for all that fit.
        sequences: of the recordings; None for all of the table.
        seeds: of odometry, recordings and training.
        cells: where runs are kept.
        more: further overrides of every row.
        again: run what is there once more.
    """

    root: str
    rows: tuple[str, ...] | None
    sequences: tuple[str, ...] | None
    seeds: tuple[int, ...]
    cells: Path
    more: tuple[str, ...]
    again: bool

    def folder(self) -> str:
        """The root, which must be given."""
        if not self.root:
            sys.exit("--root is missing: the folder of the recordings")
        return self.root


class Bench:
    """Composes, trains and runs; a context manager.

    Args:
        options: of the command line.
    """

    def __init__(self, options: Options) -> None:
        self._options = options
        self._store = CellStore(options.cells)
        self._composer = Composer()

    def __enter__(self) -> "Bench":
        self._composer.__enter__()
        return self

    def __exit__(self, *told: object) -> None:
        self._composer.__exit__(None, None, None)

    def compose(self, row: str, overrides: Sequence[str]) -> Composed:
        """The config of a row; ``trainer`` and odometry are chosen before, so that they win over the fuser's."""
        return self._composer.compose(["tracker=none", *overrides, *ROWS[row], *self._options.more])

    def trained(self, row: str, overrides: Sequence[str], training: Sequence[str] = ()) -> Composed:
        """The same with weights, which are trained where they are missing.

        Args:
            row: of :data:`ROWS`.
            overrides: of the run.
            training: further ones that hold for the training alone, such as what it must not see.
        """
        composed = self.compose(row, overrides)
        weights = weights_of(self.compose(row, [*overrides, *training]), shown=True)
        lend(composed.config, weights)
        return composed

    def measure(self, row: str, overrides: Sequence[str], training: Sequence[str] = ()) -> CellResult:
        """Metrics of one run, from what is kept if they are there; a failure is told."""
        try:
            composed = self.trained(row, overrides, training)
            key = cell_key(composed.config)
        except VioframeError as error:
            return _told(row, failed(error))
        found = None if self._options.again else self._store.find(key)
        if found is not None:
            return found
        result = run_cell(composed.config, composed.choices, key)
        self._store.keep(result, {"row": row, "overrides": list(overrides)})
        return _told(row, result)


def _told(row: str, result: CellResult) -> CellResult:
    if result.status != "finished":
        print(f"{row}: {result.error}", file=sys.stderr, flush=True)
    return result


def play(config: DictConfig, choices: dict[str, str], pipeline: Pipeline | None = None) -> tuple[SequenceRun, Row]:
    """Run the first sequence of a config with everything it leaves; whatever stops it is raised."""
    dataset = build_dataset(config, choices.get("dataset", ""))
    with tempfile.TemporaryDirectory() as temporary:
        run, recorder, stop = run_sequence(
            pipeline or build_pipeline(config, choices),
            dataset.open(dataset.sequences[0]),
            folder=Path(temporary),
            init=str(config.init),
            sample_count=0,
            progress=lambda done: None,
        )
        if stop is not None:
            raise stop
        recorder.discard_partial()
    return run, evaluate_run(run, build_options(config))
