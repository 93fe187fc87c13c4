"""What a study is to run: the group ``study`` of the configuration."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from vioframe.errors import ConfigError

Value = float | str
"""Of the option that a study varies, or the name of a condition."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """One run of a study: which variant, at which value or under which condition, on what, drawn by which seed.

    Attributes:
        variant: name.
        value: of the option, or name of the condition.
        seed: of what is random.
        recording: name; empty where the study does not name recordings.
    """

    variant: str
    value: Value
    seed: int
    recording: str = ""

    def __str__(self) -> str:
        value = self.value if isinstance(self.value, str) else f"{self.value:g}"
        recording = f", {self.recording}" if self.recording else ""
        return f"{self.variant} at {value}{recording}, seed {self.seed}"

    @property
    def run(self) -> tuple[str, int]:
        """What the cells of different variants and values share: recording and seed."""
        return self.recording, self.seed


class Study:
    """Values of one option, or conditions with names, × variants × recordings × seeds.

    Args:
        name: of the study, for files and records.
        title: one line, heading of page and figure.
        key: dotted key of the option that is varied, such as ``faults.time_offset_s``; None with conditions.
        conditions: lists of overrides by name, instead of the values of one option; empty for none.
        values: of that option; or names of those conditions that are run, None for all.
        reference: the value or condition that all others are compared with.
        axis: what is varied, with its unit, as it stands below the curves; None takes the key.
        factor: values times this are shown.
        base: overrides of all variants, such as ``dataset=simulated_car``; what the command line says comes after.
        more: further overrides of all variants: the command line cannot name options that only they have.
        variants: overrides by the name of the variant; these come last.
        chosen: names of the variants that are run; None for all.
        recordings: each cell is run on each; empty for what the overrides choose.
        recording_key: dotted key of the option that is set to the recording.
        seeds: each cell is run with each.
        seed_keys: keys that are set to the seed where the config of a cell has them.
        training_seed_keys: the same, before nets without weights are trained; none: trained once for all seeds.
        metrics: names in ``metrics.json`` that are drawn, the first of which decides.
        tolerance: relative loss against the reference up to which a value counts as tolerated.
        least_completion: 0…1; a run that tracks less of its recording counts as failed, and worse than all others.
        baseline: variant that the others are compared with, pair by pair; None for none.
        workers: cells that run at the same time, each in a process of its own.
        again: run cells that are there already once more.
        cells: folder of the cells that are there.

    Raises:
        ConfigError: an option that cannot work.
    """

    def __init__(
        self,
        *,
        name: str,
        title: str,
        key: str | None,
        conditions: Mapping[str, Sequence[str]],
        values: Sequence[Value] | None,
        reference: Value,
        axis: str | None,
        factor: float,
        base: Sequence[str],
        more: Sequence[str],
        variants: Mapping[str, Sequence[str]],
        chosen: Sequence[str] | None,
        recordings: Sequence[str],
        recording_key: str,
        seeds: Sequence[int],
        seed_keys: Sequence[str],
        training_seed_keys: Sequence[str],
        metrics: Sequence[str],
        tolerance: float,
        least_completion: float,
        baseline: str | None,
        workers: int,
        again: bool,
        cells: str,
    ) -> None:
        self.name, self.title = name, title
        self.conditions = {str(name): _texts(texts) for name, texts in _named("conditions", conditions).items()}
        self.key = "" if key is None else str(key)
        if bool(self.key) == bool(self.conditions):
            raise ConfigError(
                f"study.key={key}: a study varies either the option study.key or study.conditions, "
                f"of which there are {len(self.conditions)}"
            )
        self.reference: Value
        self._all: list[Value]
        if self.conditions:
            run = self._known_conditions("values", list(self.conditions) if values is None else values)
            self.reference = self._known_conditions("reference", [reference])[0]
            self._all = [name for name in self.conditions if name in (*run, self.reference)]
        else:
            self.reference = _numbers("reference", [reference])[0]
            self._all = [*sorted({*_numbers("values", values), self.reference})]
        # conf/study/custom.yaml calls the axis by the key, which conditions have none of.
        self.axis = self.varied if axis is None else str(axis)
        self.factor = _numbers("factor", [factor])[0]
        self.base = [str(text) for text in base]
        self.more = [str(text) for text in more]
        self.variants = {str(name): _texts(texts) for name, texts in _named("variants", variants).items()}
        names = list(self.variants) if chosen is None else [str(name) for name in chosen]
        unknown = [name for name in names if name not in self.variants]
        if unknown or not names:
            raise ConfigError(
                f"study.chosen={names} must name variants: {', '.join(self.variants)}; define more with "
                "+study.variants.NAME=['fuser=...']"
            )
        self.chosen = list(dict.fromkeys(names))
        self.baseline = None if baseline is None else str(baseline)
        if self.baseline is not None and self.baseline not in self.variants:
            raise ConfigError(f"study.baseline={baseline} must name a variant: {', '.join(self.variants)}")
        self.recordings = list(dict.fromkeys(str(recording) for recording in recordings))
        self.recording_key = str(recording_key)
        if not seeds or not all(isinstance(seed, int) and seed >= 0 for seed in seeds):
            raise ConfigError(f"study.seeds={list(seeds)} must be a list of whole numbers from 0 on")
        self.seeds = list(dict.fromkeys(seeds))
        self.seed_keys = [str(key) for key in seed_keys]
        self.training_seed_keys = [str(key) for key in training_seed_keys]
        if not metrics:
            raise ConfigError("study.metrics is empty: name what is to be drawn, such as [t_rel_percent]")
        self.metrics = [str(name) for name in metrics]
        if not tolerance > 0.0:
            raise ConfigError(f"study.tolerance={tolerance} must be positive")
        self.tolerance = float(tolerance)
        if not 0.0 <= least_completion <= 1.0:
            raise ConfigError(f"study.least_completion={least_completion} must lie in [0, 1]")
        self.least_completion = float(least_completion)
        if not (isinstance(workers, int) and workers >= 1):
            raise ConfigError(f"study.workers={workers} must be 1 or more")
        self.workers = workers
        self.again = bool(again)
        self.cells_folder = str(cells)

    @property
    def varied(self) -> str:
        """What is varied: the key of the option, or ``condition``."""
        return self.key or "condition"

    def all_values(self) -> list[Value]:
        """The values in order, the reference among them; conditions as they are defined."""
        return list(self._all)

    def cells(self) -> list[Cell]:
        """Every cell, seed by seed, so that a study that is stopped has whole curves."""
        return [
            Cell(variant=variant, value=value, seed=seed, recording=recording)
            for seed in self.seeds
            for recording in self.recordings or [""]
            for variant in self.chosen
            for value in self.all_values()
        ]

    def shown(self, value: Value) -> str:
        """A value as it is shown, without its unit."""
        return value if isinstance(value, str) else f"{value * self.factor:g}"

    def _known_conditions(self, option: str, names: Sequence[Value]) -> list[Value]:
        chosen = [str(name) for name in names] if isinstance(names, list | tuple) else []
        unknown = [name for name in chosen if name not in self.conditions]
        if unknown or not chosen:
            raise ConfigError(
                f"study.{option}={names} must name conditions: {', '.join(self.conditions)}; define more with "
                "+study.conditions.NAME=['dataset....']"
            )
        return [*dict.fromkeys(chosen)]


def _numbers(name: str, values: Sequence[Value] | None) -> list[float]:
    if not isinstance(values, list | tuple) or not values:
        raise ConfigError(f"study.{name}={values} must hold finite numbers")
    numbers = [
        float(value)
        for value in values
        if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    ]
    if len(numbers) < len(values):
        raise ConfigError(f"study.{name}={values} must hold finite numbers")
    return numbers


def _texts(texts: Sequence[str]) -> list[str]:
    return [str(text) for text in texts]


def _named(option: str, lists: Mapping[str, Sequence[str]]) -> Mapping[str, Sequence[str]]:
    good = isinstance(lists, Mapping) and all(isinstance(texts, list | tuple) for texts in lists.values())
    if not good or not (lists or option == "conditions"):
        raise ConfigError(f"study.{option}={lists} must give each of them a list of overrides, such as [fuser=ekf]")
    return lists
