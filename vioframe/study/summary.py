"""The cells of a study compared: medians over runs, what a fault costs, and variants beside each other."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median

from vioframe.evaluation.paired import PairedComparison, compare_pairs
from vioframe.study.cells import CellResult
from vioframe.study.plan import Cell, Study, Value
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
    """A metric over recordings and seeds, as it is shown.

    Attributes:
        median, low, high: infinite where runs that failed reach into them.
        runs: how many there were.
        failed: how many of them failed.
    """

    median: float
    low: float
    high: float
    runs: int = 0
    failed: int = 0

    def text(self, number: float, decimals: int) -> str:
        """One of the three numbers; ``failed`` where it is not finite."""
        return f"{number:.{decimals}f}" if math.isfinite(number) else "failed"


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

    def runs_told(self) -> str:
        """Over what a number of this study is a median."""
        study, parts = self.study, []
        if len(study.recordings) > 1:
            parts.append(f"{len(study.recordings)} recordings")
        parts.append(f"{len(study.seeds)} seeds" if len(study.seeds) > 1 else f"seed {study.seeds[0]}")
        return ("median of " if len(study.seeds) * max(len(study.recordings), 1) > 1 else "") + " × ".join(parts)

    def failures(self) -> dict[str, list[Cell]]:
        """Cells that failed, by what they said."""
        told: dict[str, list[Cell]] = {}
        for cell, result in self.results.items():
            if result.status != "finished":
                told.setdefault(result.error, []).append(cell)
        return told

    def spread(self, variant: str, value: Value, column: Column) -> Spread | None:
        """A metric over the runs; None where one of those that ran has none, or none ran."""
        found = self._by_run(variant, value, column)
        known = [number for number in found.values() if number is not None]
        if not known or len(known) < len(found):
            return None
        shown = [number * column.factor for number in known]
        failed = sum(not math.isfinite(number) for number in shown)
        low, high = min(shown), max(shown)
        return Spread(median=median(shown), low=low, high=high, runs=len(shown), failed=failed)

    def loss(self, variant: str, value: Value, column: Column) -> float | None:
        """Relative loss against the reference, median over runs, each compared with itself; below 0 is a gain."""
        reference = self._by_run(variant, self.study.reference, column)
        losses = []
        for run, number in self._by_run(variant, value, column).items():
            beside = reference.get(run)
            if number is None or not beside:
                return None
            losses.append(_loss(number, beside) * (1.0 if column.lower_is_better else -1.0))
        return median(losses) if losses else None

    def compared(self) -> list[str]:
        """The variants that stand beside the baseline; none where there is no baseline, or it was not run."""
        baseline = self.study.baseline
        if baseline not in self.study.chosen:
            return []
        return [variant for variant in self.study.chosen if variant != baseline]

    def comparison(self, variant: str, values: Sequence[Value], column: Column) -> PairedComparison:
        """A variant beside the baseline, pair by pair: runs of the same recording and seed at the same value.

        Args:
            variant: other than the baseline.
            values: one, or several whose runs are taken together.
            column: the metric.
        """
        baseline, system = (
            {
                (value, *run): number
                for value in values
                for run, number in self._by_run(name, value, column).items()
                if number is not None
            }
            for name in (str(self.study.baseline), variant)
        )
        return compare_pairs(baseline, system, lower_is_better=column.lower_is_better)

    def comparisons(self, column: Column) -> list[tuple[str, str, PairedComparison]]:
        """Every variant beside the baseline: at all values but the reference together, and at each of them.

        Returns:
            variant, where (``all but REFERENCE``, or the value as it is shown), and what the pairs say.
        """
        study, found = self.study, []
        others = [value for value in study.all_values() if value != study.reference]
        for variant in self.compared():
            if len(others) > 1:
                where = f"all but {study.shown(study.reference)}"
                found.append((variant, where, self.comparison(variant, others, column)))
            for value in study.all_values():
                found.append((variant, study.shown(value), self.comparison(variant, [value], column)))
        return found

    def tolerated(self, variant: str, column: Column) -> tuple[Value, Value] | None:
        """The widest stretch of values around the reference in which no loss exceeds the tolerance; not of names."""
        values = self.study.all_values()
        middle = values.index(self.study.reference)
        if self.study.conditions or self.spread(variant, self.study.reference, column) is None:
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
        """What the first metric says, a sentence a variant, and what stands beside the baseline."""
        column = self.columns[0]
        said = [self._sentence(variant, column) for variant in self.study.chosen]
        told: dict[str, list[str]] = {}
        for variant, where, compared in self.comparisons(column):
            if where.startswith("all but ") or where == self.study.shown(self.study.reference):
                told.setdefault(variant, []).append(f"at {where} {compared.sentence()}")
        name = _with_unit(column.title)[0]
        for variant, parts in told.items():
            said.append(f"{name} of {variant} / {self.study.baseline}: {'; '.join(parts)}.")
        return said

    def _sentence(self, variant: str, column: Column) -> str:
        study = self.study
        name, metric_unit = _with_unit(column.title)
        unit = _with_unit(study.axis)[1]

        def at(value: Value) -> str:
            return f"{study.shown(value)} {unit}".rstrip()

        def told(spread: Spread) -> str:
            if not math.isfinite(spread.median):
                return f"{spread.failed} of {spread.runs} runs failed"
            return f"{spread.median:.{column.decimals}f} {metric_unit}".rstrip()

        start = self.spread(variant, study.reference, column)
        if not any(cell.variant == variant for cell in self.results):
            return f"{variant}: not run."
        if (variant, study.reference) not in {(cell.variant, cell.value) for cell in self.results}:
            return f"{variant}: not run at {at(study.reference)}."
        if start is None:
            return f"{variant}: {name} is undefined at {at(study.reference)}."
        said = [f"{variant}: {name} {told(start)} at {at(study.reference)}"]
        run = {cell.value for cell in self.results if cell.variant == variant}
        losses = {value: self.loss(variant, value, column) for value in study.all_values() if value in run}
        known = {value: loss for value, loss in losses.items() if loss is not None}
        stretch = self.tolerated(variant, column)
        if stretch is not None:
            low, high = stretch
            where = f"from {study.shown(low)} to {at(high)}" if low != high else "nowhere else"
            said.append(f"within {100.0 * study.tolerance:g} % of that {where}")
        elif study.conditions:
            good = [at(value) for value, loss in known.items() if loss <= study.tolerance and value != study.reference]
            said.append(f"within {100.0 * study.tolerance:g} % of that {'at ' if good else ''}{_listed(good)}")
        worst = max(known, key=lambda value: known[value], default=study.reference)
        spread = self.spread(variant, worst, column)
        if worst != study.reference and spread is not None:
            change = f" ({100.0 * known[worst]:+.0f} %)" if math.isfinite(known[worst]) else ""
            said.append(f"{told(spread)} at {at(worst)}{change}")
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
                if spread is not None and math.isfinite(spread.median):
                    numbers[f"{variant}/{column.key}"] = spread.median / column.factor
        for variant, where, compared in self.comparisons(self.columns[0]):
            place = f"{variant}/{self.columns[0].key}.beside_{self.study.baseline}"
            for name, ratio in (("ratio_of_medians", compared.of_medians), ("median_ratio", compared.of_pairs)):
                if ratio is not None:
                    numbers[f"{place}/{where}/{name}"] = ratio.value
            if compared.p_value is not None:
                numbers[f"{place}/{where}/p"] = compared.p_value
        return numbers

    def _by_run(self, variant: str, value: Value, column: Column) -> dict[tuple[str, int], float | None]:
        """The metric by recording and seed; infinitely bad where a run failed.

        Where variants are compared, an error is such a failure too: left out, it would spare its variant the recording.
        """
        return {
            cell.run: self._number(result, column)
            for cell, result in self.results.items()
            if (cell.variant, cell.value) == (variant, value)
            and (result.status == "finished" or self.study.baseline is not None)
        }

    def runs(self, variant: str, value: Value, column: Column) -> list[float | None]:
        """The metric of every run: None where it has none, infinitely bad where the run failed."""
        return list(self._by_run(variant, value, column).values())

    def metrics_of(self, result: CellResult) -> dict[str, float]:
        """Those of a run; of one that tracked too little, how much it did."""
        if not self._too_short(result):
            return result.metrics
        return {name: number for name, number in result.metrics.items() if name == "completion"}

    def _number(self, result: CellResult, column: Column) -> float | None:
        if column.key != "completion" and (result.status != "finished" or self._too_short(result)):
            return math.inf if column.lower_is_better else -math.inf
        return result.metrics.get(column.key)

    def _too_short(self, result: CellResult) -> bool:
        return result.status == "finished" and result.metrics.get("completion", 1.0) < self.study.least_completion


def _loss(number: float, beside: float) -> float:
    """Relative to ``beside``; of two of which one failed, the other is infinitely far away, and two alike are alike."""
    if math.isinf(beside) or math.isinf(number):
        return 0.0 if number == beside else math.copysign(math.inf, number - beside)
    return number / beside - 1.0


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names) or "nowhere else"
