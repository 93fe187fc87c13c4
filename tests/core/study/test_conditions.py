"""Studies of conditions with names: what they run, what fails in them, and what stands beside the baseline."""

import csv
import json
import math

import pytest

from composing import composed
from vioframe.build import build
from vioframe.errors import ConfigError
from vioframe.study import Study
from vioframe.study.cells import CellResult
from vioframe.study.page import write_study
from vioframe.study.plan import Cell
from vioframe.study.summary import StudySummary, column_of
from vioframe.study.table import print_study

ATE = column_of("ate_se3_m")
SMALL = (
    "study=illumination",
    "study.values=[dark_weak,blur_weak]",
    "study.recordings=[V1,MH]",
    "study.seeds=[0,1,2]",
    "study.metrics=[ate_se3_m,completion]",
    "study.chosen=[vins_mono,vins_orb]",
)


def study(*overrides: str) -> Study:
    return build(composed(*SMALL, *overrides), "study", Study)


def summary(factors, *overrides, completion=None, errors=()):
    """Of a study in which a variant has ``factors[variant][condition]`` times the error of the recording and seed."""
    plan = study(*overrides)
    results = {}
    for cell in plan.cells():
        error = (1.0 if cell.recording == "V1" else 3.0) + 0.1 * cell.seed
        metrics = {"ate_se3_m": error * factors[cell.variant][cell.value], "completion": 0.97}
        metrics["completion"] = (completion or {}).get((cell.variant, cell.value, *cell.run), 0.97)
        results[cell] = CellResult(key="k", status="finished", metrics=metrics)
        if (cell.variant, cell.value, *cell.run) in errors:
            results[cell] = CellResult(key="k", status="failed", error="it fell")
    return StudySummary(plan, results)


CALM = {"none": 1.0, "dark_weak": 1.0, "blur_weak": 1.0}
BETTER = {"none": 1.0, "dark_weak": 0.5, "blur_weak": 0.8}


def test_cells_are_conditions_on_recordings_with_seeds():
    plan = study()
    assert plan.all_values() == ["none", "dark_weak", "blur_weak"]
    cells = plan.cells()
    assert len(set(cells)) == len(cells) == 2 * 3 * 2 * 3
    assert cells[0] == Cell(variant="vins_mono", value="none", seed=0, recording="V1")
    assert str(cells[0]) == "vins_mono at none, V1, seed 0"
    assert plan.varied == "condition" and study("study.values=null").all_values()[0] == "none"


@pytest.mark.parametrize(
    ("override", "match"),
    [
        ("study.values=[dusk]", r"study\.values=\['dusk'\] must name conditions: none, ramp_weak"),
        ("study.values=[]", r"study\.values=\[\] must name conditions"),
        ("study.reference=0", r"study\.reference=\[0\] must name conditions"),
        ("study.key=faults.time_offset_s", r"study\.key=faults\.time_offset_s: .*either .* or study\.conditions"),
        ("study.conditions.none=0", r"study\.conditions=.*list of overrides"),
        ("study.baseline=nobody", r"study\.baseline=nobody must name a variant: vins_mono"),
        ("study.least_completion=2", r"study\.least_completion=2"),
    ],
)
def test_wrong_options_are_refused_by_name(override, match):
    with pytest.raises(ConfigError, match=match):
        study(override)


def test_variants_are_compared_run_by_run():
    told = summary({"vins_mono": CALM, "vins_orb": BETTER})
    assert told.compared() == ["vins_orb"]
    dark = told.comparison("vins_orb", ["dark_weak"], ATE)
    assert dark.of_medians.value == pytest.approx(0.5) and (dark.better, dark.pairs) == (6, 6)
    # Six differences of one sign: 2 of 64 patterns.
    assert dark.p_value == pytest.approx(2 / 64)
    alike = told.comparison("vins_orb", ["none"], ATE)
    assert (alike.of_pairs.value, alike.p_value) == (1.0, 1.0)
    places = [where for _, where, _ in told.comparisons(ATE)]
    assert places == ["all but none", "none", "dark_weak", "blur_weak"]
    together = told.comparisons(ATE)[0][2]
    assert together.pairs == 12 and together.better == 12
    assert told.metrics()["vins_orb/ate_se3_m.beside_vins_mono/dark_weak/median_ratio"] == pytest.approx(0.5)
    assert told.sentences()[2].startswith("ATE of vins_orb / vins_mono: at all but none ratio")
    assert summary({"vins_mono": CALM, "vins_orb": BETTER}, "study.baseline=null").comparisons(ATE) == []


def test_losses_are_against_the_same_recording_and_seed():
    told = summary({"vins_mono": {**CALM, "dark_weak": 1.5}, "vins_orb": CALM})
    assert told.loss("vins_mono", "dark_weak", ATE) == pytest.approx(0.5)
    assert told.sentences()[0] == (
        "vins_mono: ATE 2.100 m at none; within 10 % of that at blur_weak; 3.150 m at dark_weak (+50 %)."
    )


def test_run_that_tracks_too_little_failed_and_is_the_worst(capsys):
    """A trajectory of the first seconds has a small error; it must not win."""
    one = {("vins_orb", "dark_weak", "V1", 0): 0.1}
    told = summary({"vins_mono": CALM, "vins_orb": {**BETTER, "dark_weak": 1e-3}}, completion=one)
    spread = told.spread("vins_orb", "dark_weak", ATE)
    assert (spread.failed, spread.runs) == (1, 6) and math.isinf(spread.high) and math.isfinite(spread.median)
    compared = told.comparison("vins_orb", ["dark_weak"], ATE)
    assert (compared.better, compared.worse) == (5, 1)
    # How much was tracked is told as it is.
    assert told.spread("vins_orb", "dark_weak", column_of("completion")).low == pytest.approx(10.0)
    most = {("vins_orb", "dark_weak", name, seed): 0.1 for name in ("V1", "MH") for seed in range(2)}
    told = summary({"vins_mono": CALM, "vins_orb": BETTER}, completion=most)
    assert told.comparison("vins_orb", ["dark_weak"], ATE).of_medians is None
    assert "4 of 6 runs failed at dark_weak" in told.sentences()[1]
    assert "vins_orb/ate_se3_m" in told.metrics()
    print_study(told)
    printed = capsys.readouterr().out
    assert "failed" in printed and "tracked less than 80 %" in printed and "none" in printed


def test_run_that_ended_in_an_error_is_the_worst_where_variants_are_compared():
    """Left out, it would spare its variant the recording that it cannot do."""
    told = summary({"vins_mono": CALM, "vins_orb": BETTER}, errors={("vins_orb", "dark_weak", "V1", 0)})
    spread = told.spread("vins_orb", "dark_weak", ATE)
    assert (spread.failed, spread.runs) == (1, 6) and math.isinf(spread.high)
    compared = told.comparison("vins_orb", ["dark_weak"], ATE)
    assert (compared.pairs, compared.better, compared.worse) == (6, 5, 1)


def test_page_and_numbers_hold_conditions_recordings_and_comparisons(tmp_path):
    failed = {("vins_orb", "dark_weak", "V1", 0): 0.1}
    told = summary({"vins_mono": CALM, "vins_orb": BETTER}, completion=failed)
    write_study(told, tmp_path, "a: b")
    page = (tmp_path / "study.html").read_text(encoding="utf-8")
    assert "Beside vins_mono" in page and "dataset.degradations.low_light=0.9" in page and "1 of 6 failed" in page
    document = json.loads((tmp_path / "study.json").read_text())
    found = {(entry["metric"], entry["at"]): entry for entry in document["comparisons"]}
    assert found["ate_se3_m", "blur_weak"]["of_pairs"]["value"] == pytest.approx(0.8)
    assert document["cells"][0]["recording"] == "V1"
    with (tmp_path / "study.csv").open() as file:
        lines = list(csv.reader(file))
    assert lines[0][:6] == ["variant", "condition", "recording", "seed", "status", "error"]
    assert lines[1][:4] == ["vins_mono", "none", "V1", "0"] and len(lines) == 1 + len(told.results)


def test_figure_is_drawn_of_a_single_run_and_of_nothing_but_failures(tmp_path):
    one = ("study.seeds=[0]", "study.recordings=[V1]")
    for completion in ({}, {(v, c, "V1", 0): 0.0 for v in ("vins_mono", "vins_orb") for c in CALM}):
        told = summary({"vins_mono": CALM, "vins_orb": BETTER}, *one, completion=completion)
        assert (write_study(told, tmp_path, "")[0]).stat().st_size > 5000


def test_conditions_run_from_the_command_line_and_are_kept(cli, tmp_path):
    """Two walks without images, with and without a late camera."""
    command = (
        "study=custom",
        "study.key=null",
        "+study.conditions.on_time=[]",
        "+study.conditions.late=['faults.time_offset_s=0.05']",
        "study.values=null",
        "study.reference=on_time",
        "study.base=['vo=simulated','init=groundtruth']",
        "study.recordings=[walk,drone]",
        "study.chosen=[ekf,msf]",
        "study.baseline=ekf",
        "study.seeds=[0]",
        "study.metrics=[ate_se3_m]",
        "dataset.duration_s=9",
        "tracker=none",
        "progress=false",
    )
    documents = []
    for folder in ("first", "second"):
        done = cli(*command, f"hydra.run.dir={folder}", VIOFRAME_CACHE=str(tmp_path / "cache"))
        assert done.returncode == 0, done.stderr
        documents.append(json.loads((tmp_path / folder / "study.json").read_text()))
    first, second = documents
    assert len(first["cells"]) == 2 * 2 * 2 and all(cell["stored"] for cell in second["cells"])
    errors = {(c["variant"], c["value"], c["recording"]): c["metrics"]["ate_se3_m"] for c in first["cells"]}
    assert len(set(errors.values())) == len(errors)
    wrong = cli(*command, "study.recording_key=dataset.nothing", VIOFRAME_CACHE=str(tmp_path / "cache"))
    assert wrong.returncode == 1 and "study.recording_key=dataset.nothing is no option of variant ekf" in wrong.stderr
