"""From config to objects: what a config may name, and what the user reads when it may not."""

import os

import pytest
from omegaconf import OmegaConf

from vioframe.build import build, build_pipeline, resolve_class
from vioframe.errors import ConfigError, TargetError
from vioframe.interfaces import Fuser
from vioframe.tracking import NullTracker, Tracker


@pytest.mark.parametrize(
    "target",
    [
        "os.system",
        "builtins.open",
        "builtins.eval",
        "torch.load",
        "pathlib.Path",
        "subprocess.Popen",
        "vioframe.pipeline.time.sleep",
        "vioframe.tasks.experiment.signal.signal",
        "vioframe.build.importlib.import_module",
        "vioframe.plugins.discover",
        "vioframe.plugins.Path",
        "vioframe_evil.Thing",
        "vioframe",
        "",
        7,
        None,
    ],
)
def test_a_config_cannot_name_what_is_not_a_class_of_ours(target):
    config = OmegaConf.create({"tracker": {"_target_": target}})
    with pytest.raises((TargetError, ConfigError)) as caught:
        build(config, "tracker", Tracker)
    assert "tracker" in str(caught.value)


def test_nothing_runs_before_the_refusal(tmp_path):
    marker = tmp_path / "harmed"
    config = OmegaConf.create(
        {
            "tracker": {
                "_target_": "vioframe.tracking.NullTracker",
                "x": {"_target_": "os.system", "command": f"touch {marker}"},
            }
        }
    )
    with pytest.raises(TargetError, match=r"tracker\.x\._target_=os\.system is not allowed"):
        build(config, "tracker", Tracker)
    assert not marker.exists()


def test_an_interpolated_target_is_checked_too(monkeypatch):
    monkeypatch.setitem(os.environ, "EVIL", "os.system")
    config = OmegaConf.create({"tracker": {"_target_": "${oc.env:EVIL}"}})
    with pytest.raises(TargetError, match="os.system"):
        build(config, "tracker", Tracker)


def test_the_right_target_is_built():
    config = OmegaConf.create({"tracker": {"_target_": "vioframe.tracking.NullTracker"}})
    assert isinstance(build(config, "tracker", Tracker), NullTracker)


def test_wrong_interface_is_named():
    config = OmegaConf.create({"fuser": {"_target_": "vioframe.tracking.NullTracker"}})
    with pytest.raises(ConfigError, match="fuser=odd must be a Fuser"):
        build(config, "fuser", Fuser, "odd")


def test_options_the_constructor_does_not_know_are_named():
    config = OmegaConf.create({"tracker": {"_target_": "vioframe.tracking.NullTracker", "gain": 3}})
    with pytest.raises(ConfigError, match="NullTracker refuses its options.*|takes no arguments"):
        build(config, "tracker", Tracker, "none")


def test_missing_node_is_named():
    with pytest.raises(ConfigError, match="fuser=ekf needs a _target_"):
        build(OmegaConf.create({"fuser": None}), "fuser", Fuser, "ekf")


def test_missing_class_is_named():
    with pytest.raises(ConfigError, match="has no NoSuchThing"):
        resolve_class("vioframe.tracking.NoSuchThing", "tracker._target_")
    with pytest.raises(ConfigError, match="cannot be imported"):
        resolve_class("vioframe.nowhere.Thing", "tracker._target_")


def test_a_slot_that_must_be_filled():
    with pytest.raises(ConfigError, match="synchronizer=none leaves the slot empty"):
        build_pipeline(OmegaConf.create({"synchronizer": {}}), {"synchronizer": "none"})
