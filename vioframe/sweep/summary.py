"""The jobs of a sweep compared: what varies among them, the best of each metric, medians over seeds."""

import re
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from vioframe.sweep.jobs import JobResult

_SEED = re.compile(r"(^|[._])seeds?$")


@dataclass(frozen=True, slots=True, kw_only=True)
class Column:
    """A metric the summary shows.

    Attributes:
        key: in ``metrics_of``.
        title: heading.
        decimals: shown.
        factor: what values are multiplied with to be shown.
        lower_is_better: which way is better.
        nets: shown only where jobs have nets (True), only where none has (False), or always (None).
    """

    key: str
    title: str
    decimals: int
    factor: float = 1.0
    lower_is_better: bool = True
    nets: bool | None = None

    def winner(self, values: Iterable[float]) -> float | None:
        """Return the best of several values; ``None`` where they are all the same, and nobody wins."""
        different = set(values)
        if len(different) < 2:
            return None
        return min(different) if self.lower_is_better else max(different)

    def show(self, value: float | None) -> str:
        """Write one value; ``undefined`` where there is none."""
        return "undefined" if value is None else f"{value * self.factor:.{self.decimals}f}"


COLUMNS = (
    Column(key="ate_se3_m", title="ATE [m]", decimals=3),
    Column(key="ate_se3_percent", title="ATE [% path]", decimals=2, nets=False),
    Column(key="t_rel_percent", title="t_rel [%]", decimals=2),
    Column(key="r_rel_deg_per_100m", title="r_rel [°/100 m]", decimals=2, nets=True),
    Column(key="completion", title="completion [%]", decimals=1, factor=100.0, lower_is_better=False),
    Column(key="real_time_factor", title="real-time factor", decimals=2, lower_is_better=False, nets=False),
    Column(key="ms_per_frame.total", title="ms/frame", decimals=1, nets=True),
    Column(key="model.gmac", title="GMAC", decimals=2, nets=True),
    Column(key="model.parameters", title="parameters [M]", decimals=2, factor=1e-6, nets=True),
)
"""What the table compares; everything else is in the CSV."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SeedGroup:
    """Jobs that differ in nothing but seeds: how many finished, and each metric's median and range over those."""

    choices: tuple[str, ...]
    jobs: int
    finished: int
    median: dict[str, float]
    smallest: dict[str, float]
    largest: dict[str, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Summary:
    """A sweep: its jobs in order, the keys that vary among them, and the groups over seeds if it has any."""

    jobs: tuple[JobResult, ...]
    varied: tuple[str, ...]
    groups: tuple[SeedGroup, ...]

    def label(self, overrides: Iterable[str]) -> str:
        """Name a job or group by the choices that vary in this sweep."""
        chosen = list(overrides)
        return " ".join(text for text in chosen if override_key(text) in self.varied) or " ".join(chosen) or "default"

    def values(self, column: Column) -> list[float]:
        """Return the values of the jobs that finished and have one."""
        return [job.metrics[column.key] for job in self.jobs if job.status == "finished" and column.key in job.metrics]

    def best(self, column: Column) -> float | None:
        """Return the best value among the jobs that finished."""
        values = self.values(column)
        return (min if column.lower_is_better else max)(values, default=None)

    def columns(self) -> list[Column]:
        """Return the columns of which at least one job has a value; the first always."""
        nets = any("model.parameters" in job.metrics for job in self.jobs)
        return [
            column
            for column in COLUMNS
            if column is COLUMNS[0]
            or (column.nets in (None, nets) and any(column.key in job.metrics for job in self.jobs))
        ]

    def caution(self) -> str:
        """Return a sentence where jobs ran on different recordings without having been asked to; else nothing."""
        ran: dict[tuple[str, ...], list[str]] = {}
        for job in self.jobs:
            if job.recordings:
                ran.setdefault(job.recordings, []).append(f"#{job.number}")
        if len(ran) < 2 or any(key.partition(".")[0] == "dataset" for key in self.varied):
            return ""
        told = "; ".join(f"{', '.join(numbers)} on {', '.join(names)}" for names, numbers in ran.items())
        return (
            f"Parts of these jobs brought data of their own ({told}), so rows on different recordings do not compare: "
            "choose dataset=, or vo= and its backbone=, for all of them"
        )

    def metrics(self) -> dict[str, float]:
        """Return what the sweep's own record shows: counts, and the best of each column."""
        numbers = {
            "jobs": float(len(self.jobs)),
            "failed_jobs": float(sum(job.status != "finished" for job in self.jobs)),
        }
        for column in self.columns():
            value = self.best(column)
            if value is not None:
                numbers[f"best/{column.key}"] = value
        return numbers


def summarise(jobs: Sequence[JobResult]) -> Summary:
    """Compare jobs; where their overrides include seeds, also over the seeds."""
    values: dict[str, set[str]] = {}
    for job in jobs:
        for text in job.overrides:
            values.setdefault(override_key(text), set()).add(text)
    varied = tuple(
        key
        for key, texts in values.items()
        if len(texts) > 1 or not all(any(override_key(text) == key for text in job.overrides) for job in jobs)
    )
    groups: dict[tuple[str, ...], list[JobResult]] = {}
    for job in jobs:
        groups.setdefault(choices_but_seeds(job), []).append(job)
    seeded = any(is_seed(key) for key in varied)
    return Summary(
        jobs=tuple(jobs),
        varied=varied,
        groups=tuple(_group(choices, members) for choices, members in groups.items()) if seeded else (),
    )


def _group(choices: tuple[str, ...], members: Sequence[JobResult]) -> SeedGroup:
    finished = [job.metrics for job in members if job.status == "finished"]
    # A seed where a metric is undefined must not drop out of its median unseen: no median then.
    shared = sorted(set.intersection(*(set(metrics) for metrics in finished))) if finished else []
    columns = {key: [metrics[key] for metrics in finished] for key in shared}
    return SeedGroup(
        choices=choices,
        jobs=len(members),
        finished=len(finished),
        median={key: statistics.median(series) for key, series in columns.items()},
        smallest={key: min(series) for key, series in columns.items()},
        largest={key: max(series) for key, series in columns.items()},
    )


def choices_but_seeds(job: JobResult) -> tuple[str, ...]:
    """Return a job's overrides other than seeds: what the jobs of a ``SeedGroup`` share."""
    return tuple(text for text in job.overrides if not is_seed(override_key(text)))


def is_seed(key: str) -> bool:
    """Tell whether an override of this key is a seed."""
    return _SEED.search(key) is not None


def override_key(override: str) -> str:
    """Return what an override sets: ``dataset.seed`` for ``+dataset.seed=3``."""
    return override.partition("=")[0].lstrip("+~")
