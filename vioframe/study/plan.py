"""What a study is to run: the group ``study`` of the configuration."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from vioframe.errors import ConfigError


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """One run of a study: which variant, at which value, drawn by which seed."""

    variant: str
    value: float
    seed: int

    def __str__(self) -> str:
        return f"{self.variant} at {self.value:g}, seed {self.seed}"


class Study:
    """Values of one option × variants × seeds.

    Args:
        name: of the study, for files and records.
        title: one line, heading of page and figure.
        key: dotted key of the option that is varied, such as ``faults.time_offset_s``.
        values: of that option.
        reference: the value that all others are compared with.
        axis: what the option is, with its unit, as it stands below the curves.
        factor: values times this are shown.
        base: overrides of all variants, such as ``dataset=simulated_car``; what the command line says comes after.
        more: further overrides of all variants: the command line cannot name options that only they have.
        variants: overrides by the name of the variant; these come last.
        chosen: names of the variants that are run; None for all.
        seeds: each cell is run with each.
        seed_keys: keys that are set to the seed where the config of a cell has them.
        training_seed_keys: the same, before nets without weights are trained; none: trained once for all seeds.
        metrics: names in ``metrics.json`` that are drawn, the first of which decides.
        tolerance: relative loss against the reference up to which a value counts as tolerated.
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
        key: str,
        values: Sequence[float],
        reference: float,
        axis: str,
        factor: float,
        base: Sequence[str],
        more: Sequence[str],
        variants: Mapping[str, Sequence[str]],
        chosen: Sequence[str] | None,
        seeds: Sequence[int],
        seed_keys: Sequence[str],
        training_seed_keys: Sequence[str],
        metrics: Sequence[str],
        tolerance: float,
        workers: int,
        again: bool,
        cells: str,
    ) -> None:
        self.name, self.title, self.axis = name, title, axis
        self.key = key
        self.values = _numbers("values", values)
        self.reference = _numbers("reference", [reference])[0]
        self.factor = _numbers("factor", [factor])[0]
        self.base = [str(text) for text in base]
        self.more = [str(text) for text in more]
        self.variants = {name: [str(text) for text in texts] for name, texts in _named(variants).items()}
        names = list(self.variants) if chosen is None else [str(name) for name in chosen]
        unknown = [name for name in names if name not in self.variants]
        if unknown or not names:
            raise ConfigError(
                f"study.chosen={names} must name variants: {', '.join(self.variants)}; define more with "
                "+study.variants.NAME=['fuser=...']"
            )
        self.chosen = list(dict.fromkeys(names))
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
        if not (isinstance(workers, int) and workers >= 1):
            raise ConfigError(f"study.workers={workers} must be 1 or more")
        self.workers = workers
        self.again = bool(again)
        self.cells_folder = str(cells)

    def all_values(self) -> list[float]:
        """The values in order, the reference among them."""
        return sorted({*self.values, self.reference})

    def cells(self) -> list[Cell]:
        """Every cell, seed by seed, so that a study that is stopped has whole curves."""
        return [
            Cell(variant=variant, value=value, seed=seed)
            for seed in self.seeds
            for variant in self.chosen
            for value in self.all_values()
        ]

    def shown(self, value: float) -> str:
        """A value as it is shown, without its unit."""
        return f"{value * self.factor:g}"


def _numbers(name: str, values: Sequence[float]) -> list[float]:
    good = isinstance(values, list | tuple) and all(
        isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value) for value in values
    )
    if not good or not values:
        raise ConfigError(f"study.{name}={values} must hold finite numbers")
    return [float(value) for value in values]


def _named(variants: Mapping[str, Sequence[str]]) -> Mapping[str, Sequence[str]]:
    good = isinstance(variants, Mapping) and all(isinstance(texts, list | tuple) for texts in variants.values())
    if not good or not variants:
        raise ConfigError(f"study.variants={variants} must give each variant a list of overrides, such as [fuser=ekf]")
    return variants
