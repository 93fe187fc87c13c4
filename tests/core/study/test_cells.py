"""Cells are kept under what has a bearing on them, and nothing that goes wrong in one ends a study."""

import json

import pytest
from omegaconf import OmegaConf

from composing import composed
from vioframe.errors import ConfigError
from vioframe.study.cells import CellResult, CellStore, cell_key, failed, run_cell

SHORT = ("vo=simulated", "fuser=ekf", "dataset.duration_s=3", "init=groundtruth", "evaluation.segment_lengths_m=[1]")


def test_key_follows_all_that_has_a_bearing_and_nothing_else(tmp_path):
    key = cell_key(composed(*SHORT))
    for override in ("faults.time_offset_s=0.01", "vo.seed=1", "dataset.seed=1", "fuser.visual.lost_after_s=2"):
        assert cell_key(composed(*SHORT, override)) != key
    for override in ("tracker=mlflow", "progress=false", "report_frames=0", "evaluation.plots=false", "trainer=cpu"):
        assert cell_key(composed(*SHORT, override)) == key


def test_key_follows_the_content_of_weights_not_their_name(tmp_path):
    config = OmegaConf.create({"fuser": {"weights": ""}})
    keys = []
    for name, content in (("a", b"1"), ("b", b"1"), ("c", b"2")):
        (tmp_path / name).write_bytes(content)
        config.fuser.weights = str(tmp_path / name)
        keys.append(cell_key(config))
    assert keys[0] == keys[1] != keys[2]


def test_key_follows_the_content_of_weights_that_came_with_a_package(tmp_path, monkeypatch):
    """Trained anew they are another net, under the same name."""
    (tmp_path / "acme_net" / "weights").mkdir(parents=True)
    (tmp_path / "acme_net" / "__init__.py").write_text("raise RuntimeError('no key needs an import')")
    monkeypatch.syspath_prepend(tmp_path)

    def key(name="small", weights="shipped"):
        options = {"_target_": "acme_net.Part", "weights": weights, "encoder": {"name": name}}
        return cell_key(OmegaConf.create({"frontend": options}))

    keys = [key()]
    for name, content in (("small", b"1"), ("small", b"2"), ("large", b"3")):
        (tmp_path / "acme_net" / "weights" / f"{name}.safetensors").write_bytes(content)
        keys.append(key())
    # The last file is that of another encoder.
    assert len(set(keys[:3])) == 3 and keys[3] == keys[2] != key("large")
    # What lies elsewhere is not what came with the package.
    assert len({key(weights="runs:/A/w"), key(weights="runs:/B/w"), key()}) == 3


def test_option_that_leads_nowhere_is_named():
    with pytest.raises(ConfigError, match="fuser: "):
        cell_key(OmegaConf.create({"fuser": {"seed": "${nowhere}"}}))


def test_cell_is_what_the_experiment_would_have_measured(tmp_path):
    result = run_cell(composed(*SHORT), {"vo": "simulated", "fuser": "ekf"}, "key")
    assert result.status == "finished" and result.error == ""
    assert 0.0 < result.metrics["ate_se3_m"] < 0.5
    assert result.metrics["completion"] > 0.9
    again = run_cell(composed(*SHORT), {"vo": "simulated", "fuser": "ekf"}, "key")
    assert again.metrics["ate_se3_m"] == result.metrics["ate_se3_m"]


def test_mean_over_several_sequences(tmp_path):
    both = run_cell(composed(*SHORT, "dataset.seed=[0,1]"), {}, "")
    alone = [run_cell(composed(*SHORT, f"dataset.seed={seed}"), {}, "").metrics["ate_se3_m"] for seed in (0, 1)]
    # The noise of vo=simulated begins anew with each sequence.
    assert both.metrics["ate_se3_m"] == pytest.approx(sum(alone) / 2)


@pytest.mark.parametrize(
    ("overrides", "match"),
    [
        (("fuser=ekf", "vo=none"), "needs metric_scale"),
        (("fuser=ekf", "vo=simulated", "vo.scale=-1"), r"vo\.scale must be positive"),
        (("fuser=ekf", "vo=simulated", "init=nonsense"), "init=nonsense"),
    ],
)
def test_what_goes_wrong_is_a_sentence(overrides, match):
    result = run_cell(composed(*overrides, "dataset.duration_s=2"), {}, "key")
    assert result.status == "failed"
    assert match.replace("\\", "") in result.error and "\n" not in result.error


def test_what_a_library_says_over_many_lines_becomes_one():
    assert failed(RuntimeError("\nIndeterminate system\n\nThrown when ...")).error == (
        "RuntimeError: Indeterminate system Thrown when ..."
    )
    assert len(failed(RuntimeError("word " * 1000)).error) == 400


def test_store_keeps_what_finished_and_takes_damage_for_nothing(tmp_path):
    store = CellStore(tmp_path / "cells")
    assert store.find("one") is None
    store.keep(CellResult(key="one", status="finished", metrics={"ate_se3_m": 1.5}, counters={"x": 2}), {"seed": 0})
    found = store.find("one")
    assert found.stored and found.metrics == {"ate_se3_m": 1.5} and found.counters == {"x": 2}
    assert json.loads((tmp_path / "cells" / "one.json").read_text())["about"] == {"seed": 0}
    store.keep(failed(ConfigError("no"), "two"), {})
    assert store.find("two") is None
    (tmp_path / "cells" / "one.json").write_text("{")
    assert store.find("one") is None
    assert [path.name for path in (tmp_path / "cells").iterdir()] == ["one.json"]
