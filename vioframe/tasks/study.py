"""``task=study``: what a fault costs, as curves over its size; chosen by ``study=time_offset`` and the like."""

import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from vioframe.build import build
from vioframe.composing import Composer
from vioframe.errors import ConfigError
from vioframe.evaluation.table import print_places
from vioframe.study import Study
from vioframe.study.cells import CellResult
from vioframe.study.page import write_study
from vioframe.study.plan import Cell
from vioframe.study.running import StudyRun
from vioframe.study.summary import StudySummary
from vioframe.study.table import print_study
from vioframe.tasks.interruption import INTERRUPTED, terminate_like_interrupt
from vioframe.tasks.progress import share_progress
from vioframe.tracking import PARENT_RUN_VARIABLE, PARENT_URI_VARIABLE, RUN_NAME_VARIABLE, MlflowTracker, Tracker

log = logging.getLogger(__name__)


def run(config: DictConfig) -> int:
    """Run the cells of the study that are not there yet, and show all; return the exit status.

    A cell that fails is told, and the others are run; the status is then 1, and 130 after Ctrl-C.
    """
    hydra_config = HydraConfig.get()
    if not config.get("study"):
        raise ConfigError("task=study needs a study: choose one, such as study=time_offset")
    study = build(config, "study", Study, str(hydra_config.runtime.choices.get("study", "")))
    tracker = build(config, "tracker", Tracker, str(hydra_config.runtime.choices.get("tracker", "")))
    folder = Path(hydra_config.runtime.output_dir)
    shown = bool(config.progress) and hydra_config.mode != RunMode.MULTIRUN
    given = [text for text in map(str, hydra_config.overrides.task) if not _is_of_study(text)]
    page_config = OmegaConf.to_yaml(OmegaConf.create({"study": config.study, "command_line": given}), resolve=True)
    results: dict[Cell, CellResult] = {}
    with terminate_like_interrupt(), tracker:
        tracker.start(
            {"study": OmegaConf.to_container(config.study, resolve=True), "command_line": given},
            {"vioframe.kind": "study"},
            name=f"study {study.name}",
        )
        interrupted = False
        with Composer() as composer, _parent(tracker):
            work = StudyRun(study, given, composer, shown=shown)
            # The bar comes after the trainings, which have their own.
            try:
                work.prepare()
                with share_progress(f"study {study.name}", len(study.cells()), shown=shown) as advance:
                    for cell, result in work.results():
                        results[cell] = result
                        if result.status != "finished" and result.error not in work.told:
                            log.error("%s: %s", cell, result.error)
                        _record(config, tracker, study, cell, result)
                        advance(len(results))
            except KeyboardInterrupt:
                interrupted = True
                log.warning("interrupted; the same command goes on with the cells that are missing")
        if results:
            _tell(StudySummary(study, results), folder, page_config, tracker)
        failures = sum(result.status != "finished" for result in results.values())
        if interrupted:
            tracker.finish("killed", "interrupted by the user")
            return INTERRUPTED
        if failures:
            tracker.finish("failed", f"{failures} of {len(results)} cells failed")
    return 1 if failures else 0


def _tell(summary: StudySummary, folder: Path, page_config: str, tracker: Tracker) -> None:
    paths = write_study(summary, folder, page_config)
    print_study(summary)
    print_places(folder, {"compare": tracker.hint})
    tracker.log_metrics(summary.metrics())
    for path in paths:
        tracker.log_file(path)


def _is_of_study(override: str) -> bool:
    """Whether an override speaks of the study itself, not of its cells."""
    key = override.partition("=")[0].lstrip("+~")
    return key.partition(".")[0].partition("@")[0] in ("study", "task") or key.startswith("hydra")


@contextmanager
def _parent(tracker: Tracker) -> Iterator[None]:
    """Let all records that begin meanwhile, of cells and of trainings, stand below this one."""
    names = (PARENT_RUN_VARIABLE, PARENT_URI_VARIABLE, RUN_NAME_VARIABLE)
    before = {name: os.environ.pop(name, None) for name in names}
    if isinstance(tracker, MlflowTracker) and tracker.run_id is not None:
        os.environ.update({PARENT_RUN_VARIABLE: tracker.run_id, PARENT_URI_VARIABLE: tracker.uri})
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value


def _record(config: DictConfig, tracker: Tracker, study: Study, cell: Cell, result: CellResult) -> None:
    """Keep a record of one cell below that of the study."""
    if not isinstance(tracker, MlflowTracker):
        return
    nested = OmegaConf.create({"tracker": OmegaConf.to_container(config.tracker, resolve=True)})
    # A name that the user gave is that of the study.
    nested.tracker.run_name = None
    child = build(nested, "tracker", Tracker)
    child.start(
        {
            "variant": cell.variant,
            study.varied: cell.value,
            "recording": cell.recording or None,
            "seed": cell.seed,
            "cell": result.key,
        },
        {"vioframe.kind": "cell", "vioframe.stored": str(result.stored).lower()},
        name=str(cell),
    )
    child.log_metrics(result.metrics)
    child.finish("finished" if result.status == "finished" else "failed", result.error)
