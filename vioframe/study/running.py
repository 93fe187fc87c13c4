"""Running the cells of a study: compose each variant, train what it needs, then cell after cell."""

import copy
import logging
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from vioframe.composing import Composed, Composer
from vioframe.errors import ConfigError, VioframeError
from vioframe.study.cells import CellResult, CellStore, cell_key, failed, run_cell
from vioframe.study.plan import Cell, Study, Value
from vioframe.study.weights import lend, weights_of

log = logging.getLogger(__name__)


class StudyRun:
    """The cells of a study and how they are run.

    Attributes:
        told: what went wrong while it was prepared, and has been said.

    Args:
        study: what is to be run.
        given: overrides of the command line, which come after ``study.base`` and before those of a variant.
        composer: open.
        shown: whether to show progress bars of trainings.
    """

    def __init__(self, study: Study, given: Sequence[str], composer: Composer, *, shown: bool) -> None:
        self._study = study
        self._given = list(given)
        self._composer = composer
        self._shown = shown
        self._store = CellStore(Path(study.cells_folder).expanduser())
        self._composed: dict[tuple[str, Value], Composed] = {}
        self._weights: dict[tuple[str, int | None], dict[str, str]] = {}
        self.told: set[str] = set()
        self._broken: dict[tuple[str, int | None], VioframeError] = {}

    def prepare(self) -> None:
        """Compose every variant, and see that its nets have weights; a variant that cannot is told in its cells.

        Raises:
            KeyboardInterrupt: the user stopped a training; it can go on.
        """
        seeds: list[int | None] = list(self._study.seeds) if self._study.training_seed_keys else [None]
        for variant in self._study.chosen:
            try:
                composed = self._compose(variant)
                self._check(composed.config, variant)
            except VioframeError as error:
                for seed in seeds:
                    self._break(variant, seed, error)
                continue
            self._composed[variant, ""] = composed
            for seed in seeds:
                config = copy.deepcopy(composed.config)
                if seed is not None:
                    set_where_known(config, self._study.training_seed_keys, seed)
                try:
                    self._weights[variant, seed] = weights_of(
                        Composed(config=config, choices=composed.choices), shown=self._shown
                    )
                except VioframeError as error:
                    self._break(variant, seed, error)

    def results(self) -> Iterator[tuple[Cell, CellResult]]:
        """Every cell as it ends, those that are there first."""
        waiting: list[tuple[Cell, Composed, str]] = []
        for cell in self._study.cells():
            trained = cell.variant, cell.seed if self._study.training_seed_keys else None
            if trained in self._broken:
                yield cell, failed(self._broken[trained])
                continue
            try:
                composed = self._compose_cell(cell)
                config = composed.config
                lend(config, self._weights[trained])
                key = cell_key(config)
            except VioframeError as error:
                yield cell, failed(error)
                continue
            found = None if self._study.again else self._store.find(key)
            if found is not None:
                yield cell, found
            else:
                waiting.append((cell, composed, key))
        for cell, result in self._run(waiting):
            self._store.keep(
                result,
                {
                    "study": self._study.name,
                    "variant": cell.variant,
                    self._study.varied: cell.value,
                    "recording": cell.recording,
                    "seed": cell.seed,
                },
            )
            yield cell, result

    def _run(self, waiting: list[tuple[Cell, Composed, str]]) -> Iterator[tuple[Cell, CellResult]]:
        if self._study.workers == 1 or len(waiting) < 2:
            for cell, composed, key in waiting:
                yield cell, run_cell(composed.config, composed.choices, key)
            return
        # Fresh processes: a fork would copy the threads of libraries that do not expect it.
        pool = ProcessPoolExecutor(min(self._study.workers, len(waiting)), mp_context=get_context("spawn"))
        try:
            started = {
                pool.submit(run_cell, composed.config, composed.choices, key): cell for cell, composed, key in waiting
            }
            for future in as_completed(started):
                error = future.exception()
                yield started[future], future.result() if error is None else failed(error)
        finally:
            pool.shutdown(wait=True, cancel_futures=True)

    def _compose(self, variant: str, condition: Sequence[str] = ()) -> Composed:
        study = self._study
        # Of two that set the same, the later counts.
        return self._composer.compose([*study.base, *self._given, *study.variants[variant], *condition, *study.more])

    def _compose_cell(self, cell: Cell) -> Composed:
        """Its own copy, without the weights."""
        study, place = self._study, (cell.variant, cell.value if self._study.conditions else "")
        if place not in self._composed:
            self._composed[place] = self._compose(cell.variant, study.conditions.get(str(cell.value), ()))
        known = self._composed[place]
        config = copy.deepcopy(known.config)
        if not isinstance(cell.value, str):
            before = OmegaConf.select(config, study.key)
            whole = isinstance(before, int) and not isinstance(before, bool) and cell.value.is_integer()
            OmegaConf.update(config, study.key, int(cell.value) if whole else cell.value)
        if cell.recording:
            OmegaConf.update(config, study.recording_key, cell.recording)
        set_where_known(config, study.seed_keys, cell.seed)
        return Composed(config=config, choices=known.choices)

    def _break(self, variant: str, seed: int | None, error: VioframeError) -> None:
        self._broken[variant, seed] = error
        sentence = failed(error).error
        if sentence not in self.told:
            log.error("%s: %s", variant, sentence)
            self.told.add(sentence)

    def _check(self, config: DictConfig, variant: str) -> None:
        study = self._study
        try:
            if study.recordings:
                group, _, option = study.recording_key.rpartition(".")
                node = OmegaConf.select(config, group) if group else config
                if not (isinstance(node, DictConfig) and option in node):
                    raise ConfigError(f"study.recording_key={study.recording_key} is no option of variant {variant}")
            value = OmegaConf.select(config, study.key) if study.key else None
        except OmegaConfBaseException as error:
            raise ConfigError(f"variant {variant}: {str(error).strip().splitlines()[0]}") from error
        if study.key and not isinstance(value, int | float):
            raise ConfigError(
                f"study.key={study.key} must be an option with a number, but with variant {variant} it is {value}"
            )


def set_where_known(config: DictConfig, keys: Sequence[str], value: int) -> None:
    """Set those keys that the config has, in place."""
    for key in keys:
        if OmegaConf.select(config, key) is not None:
            OmegaConf.update(config, key, value)
