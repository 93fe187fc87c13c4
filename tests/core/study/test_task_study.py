"""``study=``: one command from nothing to curves; a second one runs only what is missing."""

import json
import re

import pytest

SHORT = (
    "study=time_offset",
    "study.values=[0.05]",
    "study.seeds=[0]",
    "dataset.duration_s=12",
    "study.metrics=[ate_se3_m]",
    "progress=false",
)


def results_of(done):
    return re.search(r"results in (\S+)", done.stdout).group(1)


@pytest.fixture
def run(cli, tmp_path):
    def study(*more):
        return cli(*SHORT, *more, VIOFRAME_CACHE=str(tmp_path / "cache"))

    return study


def test_from_nothing_to_curves_and_then_from_what_is_there(run, tmp_path):
    broken = "+study.variants.broken=['fuser=ekf','vo=none']"
    done = run("study.chosen=[ekf,broken]", broken, "tracker=mlflow")
    assert done.returncode == 1, done.stderr
    assert "needs metric_scale" in done.stderr and "Traceback" not in done.stderr
    folder = tmp_path / results_of(done)
    document = json.loads((folder / "study.json").read_text())
    status = {(cell["variant"], cell["value"]): cell["status"] for cell in document["cells"]}
    assert status == {(v, x): s for v, s in (("ekf", "finished"), ("broken", "failed")) for x in (0.0, 0.05)}
    errors = {cell["value"]: cell["metrics"]["ate_se3_m"] for cell in document["cells"] if cell["metrics"]}
    # The picture is late, so the fault must be seen, although no image is: nothing else differs.
    assert errors[0.0] != errors[0.05]
    assert {path.name for path in folder.iterdir()} >= {"study.png", "study.html", "study.csv"}
    assert len(list((tmp_path / "cache" / "cells").iterdir())) == 2

    from mlflow.tracking import MlflowClient

    client = MlflowClient(tracking_uri=f"sqlite:///{tmp_path / 'mlflow.db'}")
    runs = client.search_runs([client.get_experiment_by_name("vioframe").experiment_id])
    parents = [one for one in runs if one.data.tags.get("vioframe.kind") == "study"]
    cells = [one for one in runs if one.data.tags.get("vioframe.kind") == "cell"]
    assert len(parents) == 1 and len(cells) == 4
    assert {one.data.tags["mlflow.parentRunId"] for one in cells} == {parents[0].info.run_id}

    again = run("study.chosen=[ekf,msf]", "study.workers=2", "tracker=none")
    assert again.returncode == 0, again.stderr
    document = json.loads((tmp_path / results_of(again) / "study.json").read_text())
    stored = {(cell["variant"], cell["stored"]) for cell in document["cells"]}
    assert stored == {("ekf", True), ("msf", False)}


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (("study.key=faults.nothing", "tracker=none"), "study.key=faults.nothing must be an option with a number"),
        (("study.chosen=[nobody]",), "must name variants: ekf"),
    ],
)
def test_mistakes_are_one_sentence(run, more, words):
    done = run(*more)
    assert done.returncode == 1
    assert words in done.stderr + done.stdout and "Traceback" not in done.stderr


def test_task_without_a_study_says_what_to_choose(cli):
    done = cli("task=study")
    assert done.returncode == 1
    assert "choose one, such as study=time_offset" in done.stderr
