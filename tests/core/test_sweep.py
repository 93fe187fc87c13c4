"""Sweeps: what is made of the folders of jobs, and whole multiruns of a tiny application."""

import csv
import json
import os
import re
import signal
import sqlite3
import subprocess
import sys
import time
from dataclasses import replace
from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from vioframe.sweep import conclude, failed_jobs, write_status
from vioframe.sweep.chart import draw_chart
from vioframe.sweep.files import write_files
from vioframe.sweep.jobs import JobResult, collect
from vioframe.sweep.summary import COLUMNS, summarise
from vioframe.sweep.table import markdown_table, print_table

REPOSITORY = Path(__file__).resolve().parents[2]

ATE, SPEED = "ate_se3_m", "real_time_factor"


def leave_job(
    sweep: Path, number: int, *overrides: str, document: object = None, status: tuple[str, str] | None = None
) -> Path:
    """Write what a job leaves in its folder."""
    folder = sweep / str(number)
    folder.mkdir(parents=True)
    (folder / "job.json").write_text(json.dumps({"job": number, "overrides": overrides}))
    if document is not None:
        text = document if isinstance(document, str) else json.dumps(document)
        (folder / "metrics.json").write_text(text)
    if status is not None:
        write_status(folder, *status)
    return folder


def document(ate: float | None, *, status: str = "finished", error: str | None = None) -> dict[str, object]:
    return {"sequences": [{"sequence": "walk", "status": status, "error": error, ATE: ate, SPEED: 2.0}]}


def job(number: int, *overrides: str, ate: float | None = None, status: str = "finished") -> JobResult:
    metrics = {} if ate is None else {ATE: ate, "completion": 1.0}
    error = "" if status == "finished" else "gyro in [bold]degrees[/bold] | convert"
    return JobResult(number=number, overrides=overrides, status=status, error=error, metrics=metrics)


def printed(jobs: list[JobResult]) -> str:
    stream = StringIO()
    print_table(summarise(jobs), Console(file=stream, width=160, force_terminal=True, color_system="standard"))
    return stream.getvalue()


# What a folder says


@pytest.mark.parametrize(
    ("content", "word", "status", "error"),
    [
        (document(0.5), None, "finished", ""),
        (document(0.5), ("finished", ""), "finished", ""),
        (document(0.5), ("failed", "the disk is full"), "failed", "the disk is full"),
        (None, ("failed", "no such folder"), "failed", "no such folder"),
        (None, ("failed", ""), "failed", "no reason given"),
        (document(0.5), ("interrupted", "after 3 of 9"), "interrupted", "after 3 of 9"),
        (None, ("finished", ""), "finished", ""),
        (None, None, "unfinished", "ended without a word"),
        ('{"sequences": [', None, "failed", "cannot be read"),
        ("[]", ("finished", ""), "failed", "cannot be read"),
        (document(0.5, status="failed", error="a hole of 9 s"), None, "failed", "a hole of 9 s"),
        (document(0.5, status="killed"), None, "failed", "walk: killed"),
    ],
)
def test_a_job_is_what_its_folder_says(
    tmp_path: Path, content: object, word: tuple[str, str] | None, status: str, error: str
) -> None:
    leave_job(tmp_path, 0, "fuser=ekf", document=content, status=word)
    (found,) = collect(tmp_path)
    assert (found.number, found.overrides, found.status) == (0, ("fuser=ekf",), status)
    assert error in found.error
    assert bool(found.error) == (status != "finished")
    assert [entry.number for entry in failed_jobs(tmp_path)] == ([] if status == "finished" else [0])


def test_the_first_word_stands(tmp_path: Path) -> None:
    write_status(tmp_path, "failed", "the cause")
    write_status(tmp_path, "finished")
    assert json.loads((tmp_path / "status.json").read_text()) == {"status": "failed", "error": "the cause"}


def test_jobs_come_in_order_and_those_that_never_ran_are_listed(tmp_path: Path) -> None:
    for number in (10, 2):
        leave_job(tmp_path, number, f"x={number}", document=document(0.1))
    jobs = collect(tmp_path, [[f"x={number}"] for number in range(12)])
    assert [entry.number for entry in jobs] == list(range(12))
    assert {entry.number for entry in jobs if entry.status == "finished"} == {2, 10}
    assert {entry.status for entry in jobs if entry.number not in (2, 10)} == {"not started"}


def test_a_folder_without_jobs_has_none(tmp_path: Path) -> None:
    assert collect(tmp_path) == []
    assert failed_jobs(tmp_path / "missing") == []
    assert conclude() == []


# What is compared


def test_only_choices_that_vary_name_a_job() -> None:
    summary = summarise([job(0, "dataset=euroc", "fuser=ekf"), job(1, "dataset=euroc", "fuser=msf")])
    assert [summary.label(entry.overrides) for entry in summary.jobs] == ["fuser=ekf", "fuser=msf"]
    alone = summarise([job(0, "dataset=euroc")])
    assert alone.label(alone.jobs[0].overrides) == "dataset=euroc"


def test_the_best_is_the_best_of_those_that_finished() -> None:
    jobs = [job(0, "x=0", ate=0.5), job(1, "x=1", ate=0.1, status="failed"), job(2, "x=2", ate=0.7)]
    assert summarise(jobs).metrics() == {
        "jobs": 3.0,
        "failed_jobs": 1.0,
        "best/ate_se3_m": 0.5,
        "best/completion": 1.0,
    }
    winners = re.findall(r"\x1b\[1;32m *([0-9.]+)", printed(jobs))
    # Every job completes alike, and nobody wins that.
    assert winners == ["0.500"]


def test_jobs_on_different_recordings_are_not_compared_in_silence(tmp_path: Path) -> None:
    for number, (fuser, name) in enumerate((("ekf", "walk"), ("msf", "car-0"))):
        sequences = {"sequences": [{"sequence": name, "status": "finished", ATE: 1.0}]}
        leave_job(tmp_path, number, f"fuser={fuser}", document=sequences)
    jobs = collect(tmp_path)
    said = "#0 on walk; #1 on car-0"
    assert said in " ".join(printed(jobs).split())
    assert said in markdown_table(summarise(jobs))
    # What was asked for needs no word, nor does what is the same.
    asked = [replace(each, overrides=(f"dataset.sequence={each.recordings[0]}",)) for each in jobs]
    assert not summarise(asked).caution()
    assert not summarise([replace(each, recordings=("walk",)) for each in jobs]).caution()


def test_messages_are_shown_as_they_are() -> None:
    jobs = [job(0, "x=0", ate=0.5), job(1, "frontend.size=[3,4]", status="failed")]
    text = printed(jobs)
    assert "gyro in [bold]degrees[/bold] | convert" in text
    assert "frontend.size=[3,4]" in text
    assert "undefined" not in text
    markdown = markdown_table(summarise(jobs))
    assert "[/bold] \\| convert" in markdown
    assert len({line.count(" | ") for line in markdown.splitlines() if line.startswith("| ")}) == 1


def test_an_undefined_metric_is_no_zero(tmp_path: Path) -> None:
    leave_job(tmp_path, 0, "x=0", document=document(None))
    leave_job(tmp_path, 1, "x=1", document=document(0.25))
    jobs = collect(tmp_path)
    assert "undefined" in printed(jobs)
    assert summarise(jobs).best(COLUMNS[0]) == 0.25


def test_seeds_are_summarised_by_their_median_and_range() -> None:
    values = {"ekf": [0.3, 0.1, 0.8], "msf": [0.2, 0.4, None]}
    jobs = [
        job(3 * i + seed, f"fuser={fuser}", f"dataset.seed={seed}", ate=ate, status="finished" if ate else "failed")
        for i, (fuser, series) in enumerate(values.items())
        for seed, ate in enumerate(series)
    ]
    ekf, msf = summarise(jobs).groups
    assert (ekf.choices, ekf.jobs, ekf.finished) == (("fuser=ekf",), 3, 3)
    assert (ekf.median[ATE], ekf.smallest[ATE], ekf.largest[ATE]) == (0.3, 0.1, 0.8)
    assert (msf.finished, msf.median[ATE]) == (2, pytest.approx(0.3))
    text = printed(jobs)
    assert "0.300 (0.100 to 0.800)" in text
    assert "2 of 3" in text


def test_a_seed_without_a_value_takes_the_median_away() -> None:
    defined = [job(i, f"seed={i}", ate=0.1) for i in range(2)]
    (group,) = summarise([*defined, job(2, "seed=2")]).groups
    assert (group.finished, group.median) == (3, {})


@pytest.mark.parametrize("key", ["seed", "dataset.seed", "dataset.seeds", "+noise_seed"])
def test_a_seed_is_known_by_its_name(key: str) -> None:
    assert len(summarise([job(i, f"{key}={i}", ate=0.1) for i in range(3)]).groups) == 1


@pytest.mark.parametrize("key", ["seedling", "dataset.seed.rate", "x"])
def test_what_is_no_seed_makes_no_groups(key: str) -> None:
    assert summarise([job(i, f"{key}={i}", ate=0.1) for i in range(3)]).groups == ()


def test_the_files_say_the_same_as_the_folders(tmp_path: Path) -> None:
    for number, ate in enumerate([0.1, 0.2, None]):
        leave_job(tmp_path, number, f"x={number}", "note='a,b'", document=document(ate) if ate else None)
    summary = summarise(collect(tmp_path))
    assert [path.name for path in write_files(summary, tmp_path)] == ["sweep.csv", "sweep_summary.json", "sweep.png"]
    with (tmp_path / "sweep.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["x"] for row in rows] == ["0", "1", "2"]
    assert [row[ATE] for row in rows] == ["0.1", "0.2", ""]
    assert [row["note"] for row in rows] == ["'a,b'"] * 3
    assert [row["status"] for row in rows] == ["finished", "finished", "unfinished"]
    content = json.loads((tmp_path / "sweep_summary.json").read_text())
    assert content["best"] == {ATE: 0.1, SPEED: 2.0}
    assert [entry["folder"] for entry in content["jobs"]] == ["0", "1", "2"]
    assert (tmp_path / "sweep.png").read_bytes().startswith(b"\x89PNG")


def test_where_nothing_was_measured_nothing_is_drawn(tmp_path: Path) -> None:
    assert not draw_chart(summarise([job(0, "x=0", status="failed")]), tmp_path / "chart.png")


# Whole multiruns

APPLICATION = """
import json, sys, time
from pathlib import Path
import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf
from vioframe.sweep import conclude, write_status
from vioframe.tracking import MlflowTracker, NullTracker, metrics_of

def run(config):
    folder = Path(HydraConfig.get().runtime.output_dir)
    options = OmegaConf.to_container(config.tracker, resolve=True)
    made = {"MlflowTracker": MlflowTracker, "NullTracker": NullTracker}[options.pop("_target_").rpartition(".")[2]]
    with made(**options) as tracker:
        tracker.start(OmegaConf.to_container(config, resolve=True))
        if config.mode == "raise":
            raise ValueError("this job raises")
        if config.mode == "fail":
            write_status(folder, "failed", "gyro in degrees")
            tracker.finish("failed", "gyro in degrees")
            return
        if config.mode == "sleep":
            Path("sleeping").touch()
            time.sleep(60)
        ate = config.x + config.dataset.seed / 10
        row = {"sequence": "walk", "status": "finished", "ate_se3_m": ate, "completion": 1.0}
        (folder / "metrics.json").write_text(json.dumps({"sequences": [row]}))
        tracker.log_metrics(metrics_of({"sequences": [row]}))
        write_status(folder, "finished")

def main():
    interrupted = False
    try:
        hydra.main(version_base="1.3", config_path="conf", config_name="config")(run)()
    except KeyboardInterrupt:
        interrupted = True
    finally:
        failed = conclude(interrupted=interrupted)
    sys.exit(130 if interrupted else 1 if failed else 0)

if __name__ == "__main__":
    main()
"""

CONFIG = """
defaults:
  - tracker: mlflow
  - _self_
mode: good
x: 1
dataset:
  seed: 0
hydra:
  searchpath: ["file://{conf}"]
  job:
    name: tiny
  sweep:
    dir: multirun
    subdir: ${{hydra.job.num}}
  callbacks:
    sweep:
      _target_: vioframe.sweep.SweepCallback
"""


@pytest.fixture
def application(tmp_path: Path) -> Path:
    (tmp_path / "conf").mkdir()
    (tmp_path / "conf" / "config.yaml").write_text(CONFIG.format(conf=REPOSITORY / "conf"))
    (tmp_path / "tiny.py").write_text(APPLICATION)
    return tmp_path


def multirun(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "tiny.py", "-m", *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=180,
        env={name: value for name, value in os.environ.items() if not name.startswith(("VIOFRAME_", "MLFLOW_"))},
    )


def test_parallel_jobs_share_one_fresh_store_below_one_parent(application: Path) -> None:
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher", reason="needs the extra vioframe[cluster]")
    parallel = ("hydra/launcher=joblib", "hydra.launcher.n_jobs=2")
    result = multirun(application, "mode=good,fail,raise", "dataset.seed=0,1", "x=1", *parallel)
    assert result.returncode == 1, result.stderr
    assert "Sweep: 2 of 6 jobs finished" in result.stdout
    assert "failed: gyro in degrees" in result.stdout
    assert "failed: ValueError: this job raises" in result.stdout
    assert "1.050 (1.000 to 1.100)" in result.stdout
    assert [path.name for path in application.rglob("*.db")] == ["mlflow.db"]
    with sqlite3.connect(application / "mlflow.db") as connection:
        runs = connection.execute("SELECT run_uuid, name, status FROM runs").fetchall()
        parents = dict(
            connection.execute("SELECT run_uuid, value FROM tags WHERE key = 'mlflow.parentRunId'").fetchall()
        )
        best = connection.execute("SELECT run_uuid, value FROM latest_metrics WHERE key = 'best/ate_se3_m'").fetchall()
    (parent,) = (run for run in runs if run[0] not in parents)
    assert parent[1:] == ("sweep mode=good,fail,raise dataset.seed=0,1", "FAILED")
    assert best == [(parent[0], 1.0)]
    assert set(parents.values()) == {parent[0]}
    assert {(name, status) for uuid, name, status in runs if uuid in parents} == {
        (f"mode={mode} dataset.seed={seed}", "FINISHED" if mode == "good" else "FAILED")
        for mode in ("good", "fail", "raise")
        for seed in (0, 1)
    }
    recorded = {path.name for path in (application / "mlartifacts" / parent[0] / "artifacts").iterdir()}
    assert recorded == {"sweep.csv", "sweep_summary.json", "sweep.png"}


def test_a_sweep_in_which_all_is_well_succeeds_without_a_record(application: Path) -> None:
    result = multirun(application, "x=range(1,3)", "tracker=none")
    assert result.returncode == 0, result.stderr
    assert "Sweep: 2 of 2 jobs finished" in result.stdout
    assert not list(application.rglob("*.db"))
    assert {path.name for path in (application / "multirun").glob("sweep*")} == {
        "sweep.csv",
        "sweep_summary.json",
        "sweep.png",
    }


def test_an_unreachable_server_stops_the_sweep_before_any_job(application: Path) -> None:
    started = time.monotonic()
    result = multirun(application, "x=1,2", "tracker.uri=http://127.0.0.1:1")
    assert time.monotonic() - started < 20.0
    assert result.returncode == 1
    assert "tracker.uri=http://127.0.0.1:1 cannot be reached" in result.stdout + result.stderr
    assert "Traceback" not in result.stderr
    assert not (application / "multirun").exists()


@pytest.mark.parametrize("mistake", ["modee=a,b", "tracker.urii=x,y", "tracker=none,nowhere"])
def test_a_misspelt_option_leaves_no_record(application: Path, mistake: str) -> None:
    result = multirun(application, mistake)
    assert result.returncode == 1
    assert mistake.partition("=")[0] in result.stderr
    assert not list(application.rglob("*.db"))


def test_ctrl_c_keeps_what_is_done_and_lists_what_is_not(application: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "tiny.py", "-m", "mode=good,sleep,fail", "tracker=none"],
        cwd=application,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        start_new_session=True,
    )
    deadline = time.monotonic() + 60
    while not (application / "sleeping").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGINT)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "Sweep: 1 of 3 jobs finished" in output
    statuses = [
        entry["status"] for entry in json.loads((application / "multirun/sweep_summary.json").read_text())["jobs"]
    ]
    assert statuses == ["finished", "unfinished", "not started"]
