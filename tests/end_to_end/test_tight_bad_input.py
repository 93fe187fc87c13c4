"""What a tightly coupled system answers to recordings and maps that do not fit: one sentence, and a status."""

import json
import shutil

import cv2
import pytest

from shared_data import shared_data

QUIET = ["tracker=none", "evaluation.plots=false", "hydra.run.dir=out"]


def without_imu(folder):
    shutil.rmtree(folder / "imu0")


def without_samples(folder):
    listing = folder / "imu0" / "data.csv"
    listing.write_text(listing.read_text().partition("\n")[0] + "\n")


def without_camera_1(folder):
    shutil.rmtree(folder / "cam1")


def with_a_sheared_camera(folder):
    sensor = folder / "cam0" / "sensor.yaml"
    text = sensor.read_text()
    assert "0.0148655429818" in text
    sensor.write_text(text.replace("0.0148655429818", "0.5148655429818"))


def with_a_mirrored_camera(folder):
    sensor = folder / "cam0" / "sensor.yaml"
    text = sensor.read_text()
    rows = "0.0148655429818, -0.999880929698, 0.00414029679422"
    assert rows in text
    sensor.write_text(text.replace(rows, "-0.0148655429818, 0.999880929698, -0.00414029679422"))


@pytest.fixture
def damaged(tmp_path):
    def make(damage):
        target = tmp_path / "V1_01"
        shutil.copytree(shared_data("euroc_V1_01_micro"), target)
        for path in [target, *target.rglob("*")]:
            path.chmod(0o755 if path.is_dir() else 0o644)
        damage(target / "mav0")
        return [f"dataset.root={target}", "dataset=euroc"]

    return make


@pytest.mark.parametrize(
    ("damage", "system", "words"),
    [
        (without_imu, "msckf", "imu0: no such folder: without inertial samples there is nothing to run"),
        (without_samples, "msckf", "data.csv: empty, it should hold the IMU samples"),
        (without_camera_1, "vins_stereo", "cam1: no such folder; it should hold the images of this camera"),
        (with_a_sheared_camera, "msckf", "T_BS must be a rigid motion, but R Rᵀ is off the identity by"),
        (with_a_mirrored_camera, "msckf", "T_BS must be a rotation, but its determinant is negative"),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_recording_that_cannot_be_used_is_refused_in_one_sentence(cli, damaged, damage, system, words):
    done = cli(f"system={system}", *damaged(damage), *QUIET)
    assert done.returncode == 1
    errors = [line for line in done.stderr.splitlines() if line.startswith("ERROR")]
    assert len(errors) == 1
    assert words in errors[0]
    assert "Traceback" not in done.stderr


def test_image_of_another_size_is_left_out_named_and_counted(cli, damaged, tmp_path):
    def resize(folder):
        image = sorted((folder / "cam0" / "data").glob("*.png"))[10]
        cv2.imwrite(str(image), cv2.resize(cv2.imread(str(image), cv2.IMREAD_GRAYSCALE), (640, 480)))

    done = cli("system=msckf", *damaged(resize), *QUIET)
    assert done.returncode == 0, done.stderr
    assert "the image is 640×480 px but the calibration says 752×480; frame left out" in done.stderr
    row = json.loads((tmp_path / "out" / "metrics.json").read_text())["sequences"][0]
    assert row["counters"]["corrupt images"] == 1
    assert row["windows"] == 18


def test_one_camera_where_two_are_asked_of_a_rectified_recording(cli):
    options = [f"dataset.root={shared_data('kitti')}", "dataset=kitti", "dataset.sequence='06'"]
    done = cli("system=msckf", "rig=stereo", *options, *QUIET)
    assert done.returncode == 1
    assert (
        "lacks sequences/06/image_1, for the sequences 06: fetch it, or run on what is there: rig=mono" in done.stderr
    )


def test_truth_that_covers_no_image_starts_nothing_and_says_so(cli):
    """The static excerpt's ground truth begins when its images are over."""
    options = [f"dataset.root={shared_data('euroc_V1_01_micro')}", "dataset=euroc", "init=groundtruth"]
    done = cli("system=msckf", *options, *QUIET)
    assert done.returncode == 1
    assert "init=groundtruth, but the ground truth has no pose at any image: use init=auto" in done.stderr


def test_loop_map_of_another_rig_is_refused(cli, tmp_path):
    pytest.importorskip("gtsam")
    system = ["system=vins_mono", "dataset.standstill_s=1", "dataset.camera.kit=tumvi", *QUIET]
    made = cli(*system, "dataset.duration_s=4", f"loop.save_map={tmp_path / 'map.npz'}")
    assert made.returncode == 0, made.stderr
    other = cli(*system, "dataset.duration_s=2", "dataset.camera.kit=euroc", f"loop.load_map={tmp_path / 'map.npz'}")
    assert other.returncode == 1
    assert "was made with another rig: its camera 0 has model" in other.stderr
    assert "Traceback" not in other.stderr
