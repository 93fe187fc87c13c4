"""The cells of a study compared: medians over seeds, and what a fault costs against the reference."""

from collections.abc import Mapping
from dataclasses import dataclass
from statistics import median

from vioframe.study.cells import CellResult
from vioframe.study.plan import Cell, Study
from vioframe.sweep.summary import COLUMNS, Column

_MORE = (
    Column(key="anees_pose", title="ANEES", decimals=2),
    Column(key="rpe_trans_m_1s", title="RPE 1 s [m]", decimals=3),
    Column(key="rpe_rot_deg_1s", title="RPE 1 s [°]", decimals=3),
    Column(key="yaw_rmse_deg", title="yaw [°]", decimals=2),
)


def column_of(metric: str) -> Column:
    """How a metric is shown; under its own name where nothing better is known."""
    known = {column.key: column for column in (*COLUMNS, *_MORE)}
    return known.get(metric, Column(key=metric, title=metric, decimals=3))


@dataclass(frozen=True, slots=True, kw_only=True)
class Spread:
    """A metric over seeds."""

    median: float
    low: float
    high: float


def _with_unit(title: str) -> tuple[str, str]:
    """A title without its unit, and the unit, which stands in brackets at the end."""
    name, bracket, rest = title.rpartition("[")
    return (name.strip(), rest.rstrip("]")) if bracket else (title, "")


class StudySummary:
    """What came of a study; cells that were not run are left out.

    Args:
        study: what was to be run.
        results: by cell.
    """

    def __init__(self, study: Study, results: Mapping[Cell, CellResult]) -> None:
        self.study = study
        self.results = dict(results)
        self.columns = [column_of(metric) for metric in study.metrics]

    def failures(self) -> dict[str, list[Cell]]:
        """Cells that failed, by what they said."""
        told: dict[str, list[Cell]] = {}
        for cell, result in self.results.items():
            if result.status != "finished":
                told.setdefault(result.error, []).append(cell)
        return told

    def spread(self, variant: str, value: float, column: Column) -> Spread | None:
        """A metric over the seeds; None where one of those that ran has none, or none ran."""
        found = self._by_seed(variant, value, column)
        known = [number for number in found.values() if number is not None]
        if not known or len(known) < len(found):
            return None
        shown = [number * column.factor for number in known]
        return Spread(median=median(shown), low=min(shown), high=max(shown))

    def loss(self, variant: str, value: float, column: Column) -> float | None:
        """Relative loss against the reference, median over seeds, each compared with itself; below 0 is a gain."""
        reference = self._by_seed(variant, self.study.reference, column)
        losses = []
        for seed, number in self._by_seed(variant, value, column).items():
            beside = reference.get(seed)
            if number is None or not beside:
                return None
            losses.append((number / beside - 1.0) * (1.0 if column.lower_is_better else -1.0))
        return median(losses) if losses else None

    def tolerated(self, variant: str, column: Column) -> tuple[float, float] | None:
        """The widest stretch of values around the reference in which no loss exceeds the tolerance."""
        values = self.study.all_values()
        middle = values.index(self.study.reference)
        if self.spread(variant, self.study.reference, column) is None:
            return None
        ends = []
        for side in (values[middle::-1], values[middle:]):
            end = side[0]
            for value in side[1:]:
                loss = self.loss(variant, value, column)
                if loss is None or loss > self.study.tolerance:
                    break
                end = value
            ends.append(end)
        return ends[0], ends[1]

    def sentences(self) -> list[str]:
        """What the curves of the first metric say, a sentence a variant."""
        column = self.columns[0]
        return [self._sentence(variant, column) for variant in self.study.chosen]

    def _sentence(self, variant: str, column: Column) -> str:
        study = self.study
        name, metric_unit = _with_unit(column.title)
        unit = _with_unit(study.axis)[1]

        def at(value: float) -> str:
            return f"{study.shown(value)} {unit}".rstrip()

        def told(spread: Spread) -> str:
            return f"{spread.median:.{column.decimals}f} {metric_unit}".rstrip()

        start = self.spread(variant, study.reference, column)
        if not any(cell.variant == variant for cell in self.results):
            return f"{variant}: not run."
        if (variant, study.reference) not in {(cell.variant, cell.value) for cell in self.results}:
            return f"{variant}: not run at {at(study.reference)}."
        if start is None:
            return f"{variant}: {name} is undefined at {at(study.reference)}."
        said = [f"{variant}: {name} {told(start)} at {at(study.reference)}"]
        stretch = self.tolerated(variant, column)
        if stretch is not None:
            low, high = stretch
            where = f"from {study.shown(low)} to {at(high)}" if low != high else "nowhere else"
            said.append(f"within {100.0 * study.tolerance:g} % of that {where}")
        run = {cell.value for cell in self.results if cell.variant == variant}
        losses = {value: self.loss(variant, value, column) for value in study.all_values() if value in run}
        known = {value: loss for value, loss in losses.items() if loss is not None}
        worst = max(known, key=lambda value: known[value], default=study.reference)
        spread = self.spread(variant, worst, column)
        if worst != study.reference and spread is not None:
            said.append(f"{told(spread)} at {at(worst)} ({100.0 * known[worst]:+.0f} %)")
        undefined = [value for value, loss in losses.items() if loss is None]
        if undefined:
            said.append(f"undefined at {', '.join(map(at, undefined))}")
        return "; ".join(said) + "."

    def metrics(self) -> dict[str, float]:
        """What the study's own record shows."""
        numbers = {
            "cells": float(len(self.results)),
            "failed_cells": float(sum(result.status != "finished" for result in self.results.values())),
        }
        for variant in self.study.chosen:
            for column in self.columns:
                spread = self.spread(variant, self.study.reference, column)
                if spread is not None:
                    numbers[f"{variant}/{column.key}"] = spread.median / column.factor
        return numbers

    def _by_seed(self, variant: str, value: float, column: Column) -> dict[int, float | None]:
        """The metric by seed, of the cells that finished."""
        return {
            cell.seed: result.metrics.get(column.key)
            for cell, result in self.results.items()
            if (cell.variant, cell.value) == (variant, value) and result.status == "finished"
        }
