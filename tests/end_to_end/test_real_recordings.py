"""The command line on real recordings: what a newcomer tries second."""

import json

import numpy as np
import pytest

from shared_data import shared_data


def row_of(folder):
    return json.loads((folder / "metrics.json").read_text())["sequences"][0]


@pytest.mark.parametrize("system", ["ekf", "imu_only", "vo_only vo=stereo"])
def test_standing_still_invents_no_motion(cli, tmp_path, system):
    root = shared_data("euroc_V1_01_micro")
    options = ["dataset=euroc", f"dataset.root={root}", "tracker=none", "hydra.run.dir=out"]
    done = cli(*f"system={system}".split(), *options)
    assert done.returncode == 0, done.stderr
    poses = np.loadtxt(tmp_path / "out" / "trajectory.tum")
    assert len(poses) >= 4
    assert np.linalg.norm(poses[:, 1:4] - poses[0, 1:4], axis=1).max() < 0.05
    assert row_of(tmp_path / "out")["states"]["lost"] == 0


@pytest.mark.parametrize("sequence", ["01", "06"])
def test_a_car_in_motion_with_its_own_imu(cli, tmp_path, sequence):
    root = shared_data("kitti")
    options = [f"dataset.root={root}", f"dataset.sequence='{sequence}'", "init=groundtruth", "tracker=none"]
    done = cli("system=msf", "dataset=kitti", *options, "hydra.run.dir=out")
    assert done.returncode == 0, done.stderr
    row = row_of(tmp_path / "out")
    assert row["completion"] > 0.9
    assert row["ate_se3_m"] < 0.03 * row["path_m"]
    assert row["protocol"]["init"] == "groundtruth"


def test_the_gyro_alone_keeps_a_cars_heading(cli, tmp_path):
    root = shared_data("kitti")
    options = [f"dataset.root={root}", "dataset.sequence=['04','07']", "init=groundtruth", "tracker=none"]
    done = cli("system=imu_only", "dataset=kitti", *options, "hydra.run.dir=out")
    assert done.returncode == 0, done.stderr
    rows = json.loads((tmp_path / "out" / "metrics.json").read_text())["sequences"]
    assert np.mean([row["r_rel_deg_per_100m"] for row in rows]) < 0.3


def test_recorded_motion_is_replayed_through_the_renderer_with_the_recorded_imu(cli, tmp_path):
    root = shared_data("euroc_imu_gt")
    source = [f"dataset.source.root={root}", "dataset.source.sequence=V1_02_medium"]
    options = ["dataset.duration_s=12", "tracker=none", "hydra.run.dir=out"]
    done = cli("system=msf", "dataset=replay", *source, *options)
    assert done.returncode == 0, done.stderr
    row = row_of(tmp_path / "out")
    assert row["path_m"] > 3.0
    assert row["ate_se3_m"] < 0.3


@pytest.mark.parametrize(
    ("dataset", "folder"),
    [("euroc", "euroc_imu_gt"), ("euroc", "euroc_V1_01_micro"), ("kitti", "kitti"), ("tumvi", "tumvi")],
)
def test_the_doctor_reads_what_is_there_and_leaves_nothing_behind(cli, tmp_path, dataset, folder):
    done = cli("task=doctor", f"dataset={dataset}", f"dataset.root={shared_data(folder)}", "rig=blind")
    assert "Traceback" not in done.stderr
    assert "good" in done.stdout
    assert list(tmp_path.iterdir()) == []
