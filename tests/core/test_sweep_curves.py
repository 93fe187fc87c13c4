"""Sweeps over a number: when they are drawn as lines, and what is compared where jobs have nets."""

from pathlib import Path

import pytest
from matplotlib.figure import Figure

from vioframe.sweep.chart import draw_chart
from vioframe.sweep.curves import draw_panel, find_curves
from vioframe.sweep.jobs import JobResult
from vioframe.sweep.summary import COLUMNS, summarise

NETS = {
    "ate_se3_m": 2.0,
    "ate_se3_percent": 1.0,
    "t_rel_percent": 3.0,
    "r_rel_deg_per_100m": 1.5,
    "completion": 1.0,
    "real_time_factor": 2.0,
    "ms_per_frame.total": 40.0,
    "model.parameters": 52.9e6,
    "model.gmac": 20.5,
}


def jobs_of(*overrides: tuple[str, ...], metrics: dict[str, float] | None = None) -> list[JobResult]:
    return [
        JobResult(
            number=number,
            overrides=texts,
            status="finished",
            metrics={name: value * (1.0 + 0.1 * number) for name, value in (metrics or {"ate_se3_m": 1.0}).items()},
        )
        for number, texts in enumerate(overrides)
    ]


def grid(first: str, values: str, second: str, others: str, *more: str) -> list[tuple[str, ...]]:
    return [(f"{first}={a}", f"{second}={b}", *more) for a in values.split(",") for b in others.split(",")]


def test_one_number_and_one_other_choice_make_lines() -> None:
    summary = summarise(jobs_of(*grid("backbone", "googlenet,resnet50", "vo.stack", "10,3,5", "dataset=kitti")))
    curves = find_curves(summary)
    assert curves is not None and curves.key == "vo.stack"
    assert {label: list(line) for label, line in curves.lines.items()} == {
        "backbone=googlenet": [3.0, 5.0, 10.0],
        "backbone=resnet50": [3.0, 5.0, 10.0],
    }
    assert [job.number for job in curves.lines["backbone=resnet50"][3.0]] == [4]


def test_seeds_are_neither() -> None:
    overrides = [(*texts, f"trainer.seed={seed}") for texts in grid("vo", "a,b", "x", "1,2") for seed in (0, 1, 2)]
    curves = find_curves(summarise(jobs_of(*overrides)))
    assert curves is not None and curves.key == "x"
    assert all(len(jobs) == 3 for line in curves.lines.values() for jobs in line.values())
    assert find_curves(summarise(jobs_of(*[(f"trainer.seed={seed}",) for seed in range(5)]))) is None


@pytest.mark.parametrize(
    ("overrides", "found"),
    [
        ([("x=1",), ("x=2",), ("x='4'",)], "x"),
        ([("x=1",), ("x=2",)], None),
        (grid("x", "1,2", "y", "3,4"), None),
        (grid("a", "p,q", "b", "r,s"), None),
        ([("x=1", "a=p"), ("x=2", "a=p"), ("x=auto", "a=q")], None),
        ([("x=1", "a=p"), ("x=2", "a=p"), ("x=3",)], None),
        ([(*texts, f"b={b}") for texts in grid("x", "1,2", "a", "p,q") for b in "rs"], None),
        (grid("a", ",".join("abcdefghi"), "x", "1,2"), None),
        ([("dataset=kitti",)], None),
        ([], None),
    ],
)
def test_what_else_varies_makes_bars(overrides: list[tuple[str, ...]], found: str | None) -> None:
    curves = find_curves(summarise(jobs_of(*overrides)))
    assert (None if curves is None else curves.key) == found


@pytest.mark.parametrize("seeds", [1, 3])
def test_lines_are_drawn_with_what_failed_left_out(tmp_path: Path, seeds: int) -> None:
    overrides = [
        (*texts, f"trainer.seed={seed}") for texts in grid("backbone", "a,b", "x", "1,100") for seed in range(seeds)
    ]
    jobs = jobs_of(*overrides, metrics=NETS)
    jobs += [JobResult(number=99, overrides=("backbone=c", "x=1", "trainer.seed=0"), status="failed", error="diverged")]
    assert find_curves(summarise(jobs)) is not None
    assert draw_chart(summarise(jobs), tmp_path / "sweep.png")
    assert (tmp_path / "sweep.png").read_bytes().startswith(b"\x89PNG")


def test_a_seed_without_a_value_takes_the_point_away() -> None:
    overrides = [(f"x={x}", f"seed={seed}") for x in (1, 2, 4) for seed in (0, 1, 2)]
    jobs = [
        JobResult(
            number=number,
            overrides=texts,
            status="failed" if texts == ("x=4", "seed=2") else "finished",
            metrics={} if texts == ("x=2", "seed=0") else {"ate_se3_m": float(number)},
        )
        for number, texts in enumerate(overrides)
    ]
    curves = find_curves(summarise(jobs))
    assert curves is not None
    axes = Figure().subplots()
    draw_panel(axes, COLUMNS[0], curves)
    line = axes.get_lines()[0]
    assert list(line.get_xdata()) == [1.0, 4.0]
    # One that failed is named below the chart, as the table says of how many seeds a median is.
    assert list(line.get_ydata()) == [1.0, 6.5]


def test_nets_are_compared_by_size_and_cost() -> None:
    with_nets = summarise(jobs_of(("backbone=a",), ("backbone=b",), metrics=NETS))
    keys = [column.key for column in with_nets.columns()]
    assert keys == [
        "ate_se3_m",
        "t_rel_percent",
        "r_rel_deg_per_100m",
        "completion",
        "ms_per_frame.total",
        "model.gmac",
        "model.parameters",
    ]
    shown = {column.title: column.show(NETS[column.key]) for column in with_nets.columns()}
    assert (shown["parameters [M]"], shown["GMAC"], shown["ms/frame"]) == ("52.90", "20.50", "40.0")
    without = {name: value for name, value in NETS.items() if not name.startswith("model.")}
    plain = [column.key for column in summarise(jobs_of(("fuser=a",), metrics=without)).columns()]
    assert "real_time_factor" in plain and "ms_per_frame.total" not in plain
