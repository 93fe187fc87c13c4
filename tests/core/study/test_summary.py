"""What a study says of its cells."""

import pytest

from composing import composed
from vioframe.build import build
from vioframe.study import Study
from vioframe.study.cells import CellResult
from vioframe.study.page import make_page, write_study
from vioframe.study.plan import Cell
from vioframe.study.summary import StudySummary, column_of
from vioframe.study.table import print_study

T_REL = column_of("t_rel_percent")


def summary(errors, *overrides, metric="t_rel_percent"):
    """Of a study; ``errors[variant][value]`` holds the metric by seed, None a failure."""
    config = composed("study=time_offset", "study.seeds=[0,1]", f"study.metrics=[{metric}]", *overrides)
    plan = build(config, "study", Study)
    results = {}
    for variant, line in errors.items():
        for value, by_seed in line.items():
            for seed, error in enumerate(by_seed):
                cell = Cell(variant=variant, value=value, seed=seed)
                results[cell] = (
                    CellResult(key="", status="failed", error="the camera <fell> off")
                    if error is None
                    else CellResult(key="k", status="finished", metrics={metric: error} if error >= 0 else {})
                )
    return StudySummary(plan, results)


VALUES = "study.values=[-0.02,-0.01,0,0.01,0.02]"
FLAT = {-0.02: (1.0, 2.0), -0.01: (1.0, 2.0), 0.0: (1.0, 2.0), 0.01: (1.0, 2.0), 0.02: (1.0, 2.0)}


def test_losses_are_against_the_same_seed():
    """Recordings differ by far more than a fault costs: each seed is its own reference."""
    told = summary({"ekf": {**FLAT, 0.02: (1.5, 2.2)}}, VALUES, "study.chosen=[ekf]")
    assert told.loss("ekf", 0.02, T_REL) == pytest.approx((0.5 + 0.1) / 2)
    assert told.loss("ekf", 0.0, T_REL) == 0.0
    spread = told.spread("ekf", 0.02, T_REL)
    assert (spread.median, spread.low, spread.high) == pytest.approx((1.85, 1.5, 2.2))


def test_tolerated_stretch_ends_where_the_first_value_loses_more():
    line = {**FLAT, 0.01: (1.05, 2.1), 0.02: (1.3, 2.6), -0.01: (1.2, 2.4), -0.02: (1.0, 2.0)}
    told = summary({"ekf": line}, VALUES, "study.chosen=[ekf]")
    assert told.tolerated("ekf", T_REL) == (0.0, 0.01)
    assert told.sentences() == [
        "ekf: t_rel 1.50 % at 0 ms; within 10 % of that from 0 to 10 ms; 1.95 % at 20 ms (+30 %)."
    ]


def test_where_more_is_better_less_is_a_loss():
    told = summary({"ekf": {**FLAT, 0.02: (0.8, 1.6)}}, VALUES, "study.chosen=[ekf]", metric="completion")
    assert told.loss("ekf", 0.02, told.columns[0]) == pytest.approx(0.2)


def test_seed_without_a_value_does_not_drop_out_of_the_median_unseen():
    told = summary({"ekf": {**FLAT, 0.02: (1.0, -1.0)}}, VALUES, "study.chosen=[ekf]")
    assert told.spread("ekf", 0.02, T_REL) is None
    assert told.loss("ekf", 0.02, T_REL) is None
    assert told.tolerated("ekf", T_REL) == (-0.02, 0.01)
    assert "undefined at 20 ms" in told.sentences()[0]


def test_failed_cells_are_told_with_their_reason_and_the_others_count(capsys):
    told = summary({"ekf": {**FLAT, 0.02: (1.0, None)}, "msf": FLAT}, VALUES)
    assert [cell.seed for cell in told.failures()["the camera <fell> off"]] == [1]
    assert told.spread("ekf", 0.02, T_REL).median == 1.0
    print_study(told)
    printed = capsys.readouterr().out
    assert "failed: ekf at 0.02, seed 1: the camera <fell> off" in printed
    assert "msf" in printed
    assert told.metrics()["failed_cells"] == 1.0


def test_variant_without_any_result_is_said_to_have_none():
    told = summary({"ekf": FLAT, "msf": {value: (None, None) for value in FLAT}}, VALUES)
    assert told.sentences()[1] == "msf: t_rel is undefined at 0 ms."


def test_page_stands_alone_and_escapes_what_it_is_told(tmp_path):
    told = summary({"ekf": {**FLAT, 0.02: (1.5, None)}, "msf": FLAT}, VALUES)
    paths = write_study(told, tmp_path, "a: <b>")
    assert sorted(path.name for path in paths) == ["study.csv", "study.html", "study.json", "study.png"]
    page = make_page(told, tmp_path / "study.png", "a: <b>")
    assert "data:image/png;base64," in page and "&lt;fell&gt;" in page and "a: &lt;b&gt;" in page
    assert "src='http" not in page and "<script" not in page
    lines = (tmp_path / "study.csv").read_text().splitlines()
    assert lines[0] == "variant,faults.time_offset_s,seed,status,error,t_rel_percent"
    assert len(lines) == 1 + len(told.results)


def test_unknown_metric_is_shown_under_its_own_name():
    assert column_of("rpe_rot_deg_10m").title == "rpe_rot_deg_10m"


def test_what_was_not_run_is_not_called_undefined(capsys):
    told = summary({"ekf": {0.0: (1.0, 1.0), 0.01: (1.0, 1.0)}}, VALUES, "study.chosen=[ekf,msf]")
    assert told.sentences() == ["ekf: t_rel 1.00 % at 0 ms; within 10 % of that from 0 to 10 ms.", "msf: not run."]
    print_study(told)
    assert "[ms]" in capsys.readouterr().out
