"""``task=evaluate`` as a user runs it, and its function."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from shared_data import shared_data
from synthetic_runs import moved, walk
from vioframe.errors import ConfigError, DataError, MetricError
from vioframe.evaluation import EvaluationOptions
from vioframe.geometry import se3, so3
from vioframe.tasks.evaluate import evaluate_files, evaluate_to_folder
from vioframe.trajectory_io import write_euroc, write_kitti, write_tum

NO_PLOTS = EvaluationOptions(plots=False)
SOMEWHERE = se3.from_parts(so3.rotation_z(0.7), np.array([1.0, 2.0, 3.0]))


def command(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "vioframe", "task=evaluate", "hydra.run.dir=out", *words],
        cwd=folder,
        env={**os.environ, "COLUMNS": "120"},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def test_kitti_00_as_evo_has_it(tmp_path: Path) -> None:
    estimate = shared_data("trajectories", "evo", "KITTI_00_ORB.txt")
    truth = shared_data("trajectories", "evo", "KITTI_00_gt.txt")
    done = command(tmp_path, f"task.estimate={estimate}", f"task.ground_truth={truth}")
    assert done.returncode == 0, done.stderr
    assert "1.303450" in done.stdout
    document = json.loads((tmp_path / "out" / "metrics.json").read_text(encoding="utf-8"))
    (row,) = document["sequences"]
    assert row["ate_m"] == pytest.approx(1.3034497, abs=1e-6)
    assert row["protocol"]["alignment"] == "SE(3)"
    assert (tmp_path / "out" / "report.html").exists()
    assert (tmp_path / "out" / "plots" / "top_view.png").exists()


def test_kitti_10_to_the_published_digits() -> None:
    row = evaluate_files(
        shared_data("trajectories", "kitti_odom_eval", "10.txt"),
        shared_data("kitti", "poses", "10.txt"),
        alignment="sim3",
    )
    assert f"{row['t_rel_percent']:.3f} {row['r_rel_deg_per_100m']:.3f} {row['ate_m']:.3f}" == "3.298 0.305 6.630"


def test_mistakes_are_one_sentence(tmp_path: Path) -> None:
    truth = walk(5.0)
    write_tum(tmp_path / "a.tum", truth)
    write_tum(tmp_path / "late.tum", walk(5.0, start_ns=0))
    for words, sentence in (
        ((), "task=evaluate needs task.estimate"),
        (("task.estimate=none.tum", "task.ground_truth=a.tum"), "none.tum: no such file"),
        (("task.estimate=late.tum", "task.ground_truth=a.tum"), "no pose of the estimate (0.000 to 5.000 s)"),
        (("task.estimate=a.tum", "task.ground_truth=a.tum", "task.alignment=se2"), "task.alignment must be one of"),
    ):
        done = command(tmp_path, *words)
        assert done.returncode != 0
        assert sentence in done.stderr
        assert "Traceback" not in done.stderr


def test_formats_tell_themselves(tmp_path: Path) -> None:
    truth = walk(20.0)
    other = moved(truth, SOMEWHERE)
    write_euroc(tmp_path / "truth.csv", truth)
    write_tum(tmp_path / "estimate.tum", other)
    write_kitti(tmp_path / "estimate.txt", other, tmp_path / "times.txt")
    for name, stamps in (("estimate.tum", None), ("estimate.txt", tmp_path / "times.txt")):
        row = evaluate_files(tmp_path / name, tmp_path / "truth.csv", stamps=stamps, alignment="yaw")
        assert row["ate_m"] == pytest.approx(0.0, abs=1e-6)
        assert row["poses"] == len(truth)
        assert row["gravity_rmse_deg"] == pytest.approx(0.0, abs=1e-3)


def test_one_of_several_may_fail(tmp_path: Path) -> None:
    truth = walk(20.0)
    write_tum(tmp_path / "truth.tum", truth)
    (tmp_path / "x").mkdir()
    write_tum(tmp_path / "x" / "run.tum", moved(truth, SOMEWHERE))
    (tmp_path / "run.tum").write_text("", encoding="utf-8")
    estimates = [tmp_path / "x" / "run.tum", tmp_path / "run.tum"]
    rows = evaluate_to_folder(estimates, tmp_path / "truth.tum", tmp_path / "out")
    assert [row["status"] for row in rows] == ["finished", "failed"]
    assert "empty" in str(rows[1]["error"])
    assert str(rows[0]["sequence"]).endswith("x/run.tum")
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "failed" in page
    with pytest.raises(DataError, match="empty"):
        evaluate_to_folder(estimates[1:], tmp_path / "truth.tum", tmp_path / "out")


def test_function_refuses_what_it_cannot_do(tmp_path: Path) -> None:
    write_tum(tmp_path / "a.tum", walk(5.0))
    write_tum(tmp_path / "b.tum", walk(5.0, start_ns=0))
    with pytest.raises(ConfigError, match="alignment"):
        evaluate_files(tmp_path / "a.tum", tmp_path / "a.tum", alignment="7dof")  # type: ignore[arg-type]
    with pytest.raises(MetricError, match="no pose of the estimate"):
        evaluate_files(tmp_path / "a.tum", tmp_path / "b.tum")
    row = evaluate_files(tmp_path / "a.tum", tmp_path / "b.tum", offset_s=-1_403_715_273.262142976)
    assert row["ate_m"] == pytest.approx(0.0, abs=1e-6)
