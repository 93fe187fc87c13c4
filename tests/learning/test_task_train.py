"""``task=train`` from the command line, with a part that a stranger brings."""

import csv
import json
import subprocess
import sys

import pytest

pytest.importorskip("torch", reason="needs the extra learn")
pytest.importorskip("lightning", reason="needs the extra learn")

SMALL = [
    "task=train",
    "vo=tiny",
    "fuser=vo_only",
    "trainer=smoke",
    "tracker=none",
    "progress=false",
    "training_data.train.seed=[0]",
    "training_data.validation.seed=[0]",
    "training_data.train.duration_s=6",
    "training_data.validation.duration_s=6",
    "training_data.train.camera.rate_hz=10",
    "training_data.validation.camera.rate_hz=10",
    "training_data.train.sequence=walk",
    "training_data.validation.sequence=walk",
]


def test_a_strangers_part_is_trained_by_one_process_or_two_resumed_and_used(install, cli, tmp_path):
    sites = (install("tiny"),)
    small = [*SMALL, f"trainer.cache={tmp_path}/cache"]
    done = cli(*small, "hydra.run.dir=one", sites=sites)
    assert done.returncode == 0, done.stderr
    assert "t_rel" in done.stdout + done.stderr
    weights = next((tmp_path / "one" / "weights").glob("vo-*.safetensors"))
    card = json.loads(weights.with_suffix(".json").read_text())
    assert card["parts"] == {"vo": "tiny"}
    assert [each["name"] for each in card["data"]["training"]] == ["walk-20000"]
    assert [each["name"] for each in card["data"]["validation"]] == ["walk-10000"]
    assert len(list((tmp_path / "cache" / "recordings").iterdir())) == 2

    # Two processes take half a batch each: together the same steps, so the same curve.
    shared = cli(*small, "hydra.run.dir=both", "trainer.devices=2", "trainer.batch_size=2", sites=sites)
    assert shared.returncode == 0, shared.stderr
    one, two = (
        list(csv.DictReader((tmp_path / name / "curve.csv").read_text().splitlines())) for name in ("one", "both")
    )
    for alone, together in zip(one, two, strict=True):
        assert set(alone) == set(together)
        for name in set(alone) - {"images_per_s"}:
            assert float(together[name]) == pytest.approx(float(alone[name]), rel=1e-3), name

    resumed = cli(*small, "hydra.run.dir=two", "trainer.resume=one/resume.ckpt", "trainer.max_epochs=3", sites=sites)
    assert resumed.returncode == 0, resumed.stderr
    rows = (tmp_path / "one" / "curve.csv").read_text().splitlines()
    assert [row.split(",")[0] for row in rows] == ["epoch", "0", "1", "2"]

    weights = next((tmp_path / "one" / "weights").glob("vo-*.safetensors"))
    use = [
        "vo=tiny",
        "fuser=vo_only",
        "tracker=none",
        "dataset.duration_s=2",
        "progress=false",
        "evaluation.plots=false",
    ]
    ran = cli(*use, f"vo.weights={weights}", "init=groundtruth", sites=sites)
    assert ran.returncode == 0, ran.stderr


def test_nothing_to_train_is_told(cli):
    done = cli("task=train", "tracker=none", "hydra.run.dir=.")
    assert done.returncode == 1
    assert "nothing to train" in done.stdout + done.stderr
    assert "Traceback" not in done.stdout + done.stderr


def test_without_torch_there_is_one_sentence(install):
    site = install("tiny")
    code = (
        "import sys, importlib.util as u\n"
        f"sys.path.insert(0, {str(site)!r})\n"
        "find = u.find_spec\n"
        "u.find_spec = lambda name, package=None: None if name in ('torch', 'safetensors') else find(name, package)\n"
        "import tiny_learned\n"
        "tiny_learned.TinyVo(width=8, weights=None)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert (
        done.stderr.strip()
        .splitlines()[-1]
        .endswith("vo=tiny needs torch and safetensors, which is not installed: pip install 'vioframe[learn]'")
    )
