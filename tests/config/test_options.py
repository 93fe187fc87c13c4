"""Every option composes, every part builds, and every constructor argument is in its YAML."""

import inspect

import pytest
from omegaconf import OmegaConf

from composing import built, composed, offered
from vioframe.build import build, build_pipeline, resolve_class
from vioframe.data.recording import Dataset
from vioframe.errors import ConfigError
from vioframe.evaluation.rows import evaluate_run
from vioframe.interfaces import STEREO_TRACKS
from vioframe.pipeline import SLOTS
from vioframe.tasks.run_sequence import run_sequence

LOOPS = [("loop", name) for name in offered("loop") if name != "none"]
PARTS = [(slot, name) for slot in SLOTS for name in offered(slot) if name != "none"]


def targets(node, key: str):
    if OmegaConf.is_dict(node):
        if "_target_" in node:
            yield key, node
        for name in node:
            if not OmegaConf.is_missing(node, name) and not OmegaConf.is_interpolation(node, name):
                yield from targets(node[name], f"{key}.{name}")


@pytest.mark.parametrize(("slot", "name"), PARTS, ids=lambda value: str(value))
def test_part_builds_from_its_yaml(slot, name):
    built(slot, name)


@pytest.mark.parametrize(
    ("group", "name"),
    [
        *PARTS,
        *LOOPS,
        *(("dataset", name) for name in offered("dataset")),
        *(("tracker", name) for name in offered("tracker")),
        ("faults", "default"),
    ],
    ids=lambda value: str(value),
)
def test_every_constructor_argument_is_in_the_yaml_and_nothing_else(group, name):
    """So that Hydra refuses a misspelt option, and a reader finds every choice."""
    # The group loop= exists only with a fuser that has a place for it.
    config = composed(f"{group}={name}", *(["fuser=window"] if group == "loop" else []))
    found = list(targets(config[group], group))
    assert found
    for key, node in found:
        cls = resolve_class(node["_target_"], key)
        # A class without a constructor of its own shows object's, which takes anything by its signature.
        own = cls.__init__ is not object.__init__
        parameters = list(inspect.signature(cls.__init__).parameters.values())[1:] if own else []
        assert not [p for p in parameters if p.kind in (p.VAR_KEYWORD, p.VAR_POSITIONAL)], f"{key}: {cls}"
        assert {p.name for p in parameters} == set(node) - {"_target_"}, f"{key}: {cls}"


# A net of random weights in a tenth of the time; those that come with the package have tests of their own.
SMALLER = {"cnn_vins": ("frontend.weights=null", "encoder=mobilenetv2", "encoder.width=0.25")}


@pytest.mark.parametrize("system", offered("system"))
def test_preset_runs_two_simulated_seconds(system, tmp_path):
    smaller = SMALLER.get(system, ())
    config = composed(
        f"system={system}", *smaller, "dataset.duration_s=2", "dataset.standstill_s=0", "init=groundtruth"
    )
    pipeline = build_pipeline(config, {})
    dataset = build(config, "dataset", Dataset)
    recording = dataset.open(dataset.sequences[0])
    run, _, stop = run_sequence(
        pipeline,
        recording,
        folder=tmp_path,
        init="groundtruth",
        sample_count=1,
        progress=lambda done: None,
    )
    assert stop is None
    row = evaluate_run(run)
    # At 20 Hz 41 frames, of which 30 and 35.
    assert row["poses"] >= 0.73 * recording.frame_count
    assert len(run.states) >= 0.85 * recording.frame_count


def test_what_the_user_writes_wins_over_what_a_part_brings():
    assert "stereo" in str(composed("fuser=ekf").vo._target_).lower()
    assert "simulated" in composed("fuser=ekf", "vo=simulated").vo._target_.lower()
    assert composed("system=imu_only", "rig=stereo").rig.cameras == 2


def test_a_part_brings_the_partners_without_which_it_is_meaningless():
    assert composed("fuser=ekf").rig.cameras == 2
    assert composed("fuser=imu_only").rig.images is False


@pytest.mark.parametrize("fuser", ["msckf", "window"])
def test_one_word_takes_a_tightly_coupled_system_from_one_camera_to_two(fuser):
    for rig, stereo in (("mono", False), ("stereo", True)):
        config = composed(f"fuser={fuser}", f"rig={rig}")
        assert not config.vo
        assert (config.fuser.stereo, config.frontend.stereo) == (stereo, stereo)
        features = {STEREO_TRACKS} if stereo else set()
        pipeline = build_pipeline(config, {})
        assert features <= pipeline.fuser.requires and features <= pipeline.frontend.provides
    assert composed(f"fuser={fuser}", "rig=stereo", "fuser.stereo=false").frontend.stereo is False
    assert composed("fuser=ekf").frontend.stereo is False, "a VO that matches by itself needs no points in camera 1"


def test_presets_close_loops_unless_told_otherwise():
    assert "_target_" in composed("system=vins_mono").fuser.loop
    assert not composed("system=vins_mono", "loop=none").fuser.loop
    assert not composed("fuser=window").fuser.loop
    assert not composed("system=okvis").fuser.loop
    for system in ("vins_stereo", "okvis"):
        config = composed(f"system={system}")
        assert (config.rig.cameras, config.frontend.stereo) == (2, True)


def test_unknown_fuser_options_are_refused_by_hydra():
    from hydra.errors import ConfigCompositionException

    with pytest.raises(ConfigCompositionException, match="no_such_option"):
        composed("fuser.no_such_option=1")


def test_missing_value_is_named():
    config = composed("dataset=euroc")
    with pytest.raises(ConfigError, match="dataset"):
        build(config, "dataset", Dataset, "euroc")
