"""The output folder, the page, the figures and the table."""

import io
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from synthetic_runs import make_run
from vioframe.evaluation import EvaluationOptions, SequenceRun
from vioframe.evaluation.plots import draw_run
from vioframe.evaluation.plots.motion import nearest_turn_deg
from vioframe.evaluation.report import folder_names, write_outputs
from vioframe.evaluation.rows import evaluate_run
from vioframe.evaluation.table import print_rows, render_rows
from vioframe.evaluation.wording import significant
from vioframe.trajectory_io import read_trajectory

OPTIONS = EvaluationOptions()
NO_PLOTS = EvaluationOptions(plots=False)


def write(runs: list[SequenceRun], folder: Path, options: EvaluationOptions = OPTIONS) -> dict[str, object]:
    rows = [evaluate_run(run, options) for run in runs]
    return write_outputs(
        runs, rows, folder, config_yaml="fuser: <b>ekf</b>\n", options=options, extra={"parts": {"fuser": "ekf"}}
    )


def printed(runs: list[SequenceRun], width: int) -> str:
    console = Console(file=io.StringIO(), width=width)
    for part in render_rows([evaluate_run(run) for run in runs], width):
        console.print(part)
    return console.file.getvalue()  # type: ignore[attr-defined,no-any-return]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("outputs")
    write([make_run(duration_s=20.0, images=True)], place)
    return place


def test_one_sequence_leaves_everything(folder: Path) -> None:
    assert {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()} == {
        "metrics.json",
        "report.html",
        "trajectory.tum",
        "trajectory_final.tum",
        *(f"plots/{name}.png" for name in ("top_view", "pose", "errors", "biases", "tracks", "time", "frames")),
    }


def test_trajectories_hold_what_the_metrics_compare(folder: Path) -> None:
    run = make_run(duration_s=20.0)
    causal, final = read_trajectory(folder / "trajectory.tum"), read_trajectory(folder / "trajectory_final.tum")
    assert causal.causal
    assert not final.causal
    kept = [state for state in run.states if state.status != "starting"]
    assert causal.stamps_ns.tolist() == [state.stamp_ns for state in kept]
    np.testing.assert_allclose(causal.T_world_body, [state.T_world_body for state in kept], atol=1e-9)


def test_the_page_stands_alone(folder: Path) -> None:
    page = (folder / "report.html").read_text(encoding="utf-8")
    links = re.findall(r"(?:src|href)\s*=\s*['\"]?([^'\" >]+)", page)
    assert len(links) == 7
    assert all(link.startswith("data:image/png;base64,iVBOR") for link in links)
    assert "://" not in page
    assert "url(" not in page
    assert "<script" not in page
    # What a user wrote is text, not markup.
    assert "&lt;b&gt;ekf&lt;/b&gt;" in page


def test_the_page_has_the_numbers_and_their_protocol(folder: Path) -> None:
    page = (folder / "report.html").read_text(encoding="utf-8")
    row = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))["sequences"][0]
    assert f"<td>{significant(row['ate_se3_m'])}</td>" in page
    assert "init=auto" in page
    assert "dropped frames: 3" in page
    assert "no segment of 100 m fits" in page


def test_several_sequences_share_a_page_with_a_row_each(tmp_path: Path) -> None:
    whole, failed = make_run("a/b", duration_s=10.0), replace(make_run("c", duration_s=10.0), error="disk <full>")
    unopened = SequenceRun(
        sequence="d",
        states=[],
        frames_expected=0,
        duration_s=0.0,
        pipeline_s=0.0,
        windows=0,
        wall_s=0.0,
        error="no folder",
    )
    document = write([whole, failed, unopened], tmp_path)
    assert [row["status"] for row in document["sequences"]] == ["finished", "failed", "failed"]  # type: ignore[index,attr-defined]
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert [f"<h2>{name}</h2>" in page for name in ("a/b", "c", "d")] == [True] * 3
    assert "disk &lt;full&gt;" in page
    assert "no folder" in page
    assert (tmp_path / "a_b" / "trajectory.tum").exists()
    assert (tmp_path / "plots" / "c" / "top_view.png").exists()
    assert not (tmp_path / "d").exists()


def test_without_plots_there_are_numbers_only(tmp_path: Path) -> None:
    write([make_run(duration_s=5.0)], tmp_path, NO_PLOTS)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "metrics.json",
        "trajectory.tum",
        "trajectory_final.tum",
    ]


def test_what_cannot_be_drawn_is_left_out(tmp_path: Path) -> None:
    run = make_run(duration_s=5.0)
    bare = replace(
        run,
        ground_truth=None,
        smoothed=None,
        states=[replace(s, covariance=None, status="tracking") for s in run.states[:1]],
        track_stamps_ns=np.zeros(0, dtype=np.int64),
        track_counts=np.zeros(0, dtype=np.int64),
        windows=0,
    )
    assert [path.name for path in draw_run(bare, OPTIONS, tmp_path).values()] == [
        "top_view.png",
        "pose.png",
        "biases.png",
    ]
    assert draw_run(replace(bare, states=[]), OPTIONS, tmp_path) == {}


def test_folder_names_are_harmless_and_different() -> None:
    assert folder_names(["V1_01", "../etc", "a/b", "a b", ""]) == ["V1_01", "_etc", "a_b", "a_b_2", "sequence"]


def test_undefined_is_printed_as_undefined_with_its_reason() -> None:
    text = printed([make_run(duration_s=10.0)], 100)
    assert re.search(r"t_rel \(KITTI\) +undefined", text)
    assert "no segment of 100 m fits" in text
    assert re.search(r"completion +80\.50 +%", text)


def test_the_last_lines_say_where_everything_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    hints = {"compare": "mlflow ui", "watch": ""}
    print_rows([], tmp_path, hints=hints)
    assert capsys.readouterr().out.splitlines() == [f"results in {tmp_path}", "compare    mlflow ui"]
    (tmp_path / "report.html").touch()
    print_rows([], tmp_path, hints=hints)
    assert capsys.readouterr().out.splitlines()[1:] == [
        f"report     {tmp_path / 'report.html'}",
        "compare    mlflow ui",
    ]


@pytest.mark.parametrize("width", [60, 80, 120, 200])
def test_tables_of_several_sequences_lose_nothing_to_the_width(width: int) -> None:
    runs = [make_run("first"), replace(make_run("second", seed=1), smoothed=None, error="broken off")]
    text = printed(runs, width)
    assert max(map(len, text.splitlines())) <= width
    assert "…" not in text
    for run in runs:
        row = evaluate_run(run)
        for key in ("ate_se3_m", "ate_sim3_m", "anees_position", "real_time_factor"):
            assert significant(float(row[key])) in text, key  # type: ignore[arg-type]
    assert "second: failed: broken off" in text


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (0.33263, "0.333"),
        (126.97, "127"),
        (3724.2, "3724"),
        (0.00012345, "0.000123"),
        (-20.06, "-20.1"),
        (1e-9, "1.00e-09"),
    ],
)
def test_significant_digits(value: float, text: str) -> None:
    assert significant(value) == text


def test_angles_are_drawn_in_the_turn_of_the_truth() -> None:
    angles = np.array([[187.0, -68.0, -350.0], [190.0, -67.0, -352.0]])
    moved = nearest_turn_deg(angles, np.array([-171.0, -67.5, 9.0]))
    np.testing.assert_allclose(moved, [[-173.0, -68.0, 10.0], [-170.0, -67.0, 8.0]])
