"""What both front ends promise; with TVNet where torch is installed."""

from importlib.util import find_spec

import numpy as np
import pytest

from vioframe.errors import ConfigError, DataError, StateError
from vioframe.interfaces import FLOW
from vioframe.types import Frame
from vioframe_flow import DisFrontend, TvnetFrontend

HAS_TORCH = find_spec("torch") is not None and find_spec("safetensors") is not None
needs_torch = pytest.mark.skipif(not HAS_TORCH, reason="torch is not installed (pip install 'vioframe[learn]')")


def dis(**options) -> DisFrontend:
    return DisFrontend(**options)


def tvnet(**options) -> TvnetFrontend:
    return TvnetFrontend(**{"size_px": None, "device": "cpu", "iterations": 5, **options})


BOTH = [pytest.param(dis, id="dis"), pytest.param(tvnet, id="tvnet", marks=needs_torch)]


@pytest.mark.parametrize("make", BOTH)
def test_flow_is_what_moved(make, rig_of, sliding) -> None:
    frontend = make()
    assert frontend.provides == {FLOW}
    frontend.setup(rig_of(160, 96))
    found = [frontend.process(frame) for frame in sliding(160, 96, (3, -2))]
    assert [features.flow.shape for features in found] == [(96, 160, 2)] * 5
    assert all(features.flow.dtype == np.float32 for features in found)
    assert np.abs(found[0].flow).max() == 0.0
    for features in found[1:]:
        inner = features.flow[10:-10, 10:-10].reshape(-1, 2)
        np.testing.assert_allclose(np.median(inner, axis=0), [3.0, -2.0], atol=0.25)
        assert np.mean(np.linalg.norm(inner - [3.0, -2.0], axis=1) < 0.5) > 0.97


@pytest.mark.parametrize("make", BOTH)
def test_many_images_give_what_they_give_one_by_one(make, rig_of, sliding) -> None:
    frames = sliding(96, 64, count=8)
    one, many = make(quantise=False), make(quantise=False)
    one.setup(rig_of(96, 64))
    many.setup(rig_of(96, 64))
    alone = [one.process(frame) for frame in frames]
    # A generator, in two goes: the second begins with the flow from the last image of the first.
    together = [*many.process_many(iter(frames[:3])), *many.process_many(iter(frames[3:]))]
    assert [features.frame for features in together] == frames
    for a, b in zip(alone, together, strict=True):
        np.testing.assert_allclose(a.flow, b.flow, atol=1e-4)
    assert many.process_many([]) == []


@pytest.mark.parametrize("make", BOTH)
def test_levels_only_round(make, rig_of, sliding) -> None:
    frames = sliding(96, 64)
    flows = []
    for quantise in (False, True):
        frontend = make(quantise=quantise, bound=10.0 / 96)
        frontend.setup(rig_of(96, 64))
        flows.append(frontend.process_many(frames)[-1].flow)
    exact, rounded = flows
    assert np.abs(rounded - np.clip(exact, -128 * 10 / 127, 10.0)).max() <= 0.5 * 10.0 / 127 + 1e-4
    assert len(np.unique(rounded)) <= 256 < len(np.unique(exact))


@pytest.mark.parametrize("make", BOTH)
def test_flow_is_in_pixels_of_its_own_size(make, rig_of, sliding) -> None:
    frontend = make(size_px=[80, 96], quantise=False)
    frontend.setup(rig_of(160, 96))
    flow = frontend.process_many(sliding(160, 96, (4, 2)))[-1].flow
    assert flow.shape == (96, 80, 2)
    np.testing.assert_allclose(np.median(flow[10:-10, 10:-10].reshape(-1, 2), axis=0), [2.0, 2.0], atol=0.2)


@pytest.mark.parametrize("make", BOTH)
def test_setup_forgets_and_colour_is_grey(make, rig_of, sliding) -> None:
    frontend = make()
    frames = sliding(96, 64)
    frontend.setup(rig_of(96, 64))
    first = frontend.process_many(frames)
    frontend.setup(rig_of(96, 64))
    coloured = [Frame(stamp_ns=f.stamp_ns, images=(np.repeat(f.images[0][..., None], 3, axis=2),)) for f in frames]
    again = frontend.process_many(coloured)
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a.flow, b.flow)


@pytest.mark.parametrize("make", BOTH)
def test_blank_images_are_no_motion(make, rig_of) -> None:
    frontend = make()
    frontend.setup(rig_of(96, 64))
    blank = [Frame(stamp_ns=k, images=(np.full((64, 96), 90, np.uint8),)) for k in (1, 2, 3)]
    assert all(np.abs(features.flow).max() == 0.0 for features in frontend.process_many(blank))


@pytest.mark.parametrize("make", BOTH)
def test_what_cannot_be_used_is_said(make, rig_of, sliding) -> None:
    frontend = make()
    frame = sliding(96, 64)[0]
    with pytest.raises(StateError, match="before setup"):
        frontend.process(frame)
    with pytest.raises(DataError, match="needs a camera"):
        frontend.setup(rig_of(96, 64, cameras=0))
    with pytest.raises(DataError, match="at least 16×16 px.*are 96×12"):
        frontend.setup(rig_of(96, 12))
    frontend.setup(rig_of(96, 64))
    frontend.process(frame)
    # One image of another size among them.
    with pytest.raises(DataError, match="48×64 px, but its calibration says 96×64"):
        frontend.process(Frame(stamp_ns=7, images=(np.zeros((64, 48), np.uint8),)))
    with pytest.raises(DataError, match="no image"):
        frontend.process(Frame(stamp_ns=7))


@pytest.mark.parametrize("make", BOTH)
@pytest.mark.parametrize(
    ("option", "value"),
    [("size_px", [512]), ("size_px", [512, 8]), ("size_px", [51.2, 64]), ("bound", 0.0), ("bound", -1.0)],
)
def test_wrong_options_are_named(make, option: str, value: object) -> None:
    with pytest.raises(ConfigError, match=rf"frontend\.{option} must be"):
        make(**{option: value})


@pytest.mark.parametrize(
    ("option", "value"),
    [("preset", "slow"), ("finest_scale", 5), ("descent_steps", 0), ("refinement_steps", -1)],
)
def test_wrong_options_of_dis_are_named(option: str, value: object) -> None:
    with pytest.raises(ConfigError, match=rf"frontend\.{option} must be"):
        dis(**{option: value})


@pytest.mark.parametrize(
    ("option", "value"),
    [("dual_step", 0.0), ("data_weight", -1.0), ("coupling", 0.0), ("warps", 0), ("iterations", 0), ("zoom", 1.0),
     ("max_scales", 0), ("smoothing_px", -0.1), ("start_grid", [0, 3]), ("start_grid", [3]), ("device", "tpu"),
     ("batch", 0)],
)  # fmt: skip
def test_wrong_options_of_tvnet_are_named(option: str, value: object) -> None:
    with pytest.raises(ConfigError, match=rf"frontend\.{option} must be"):
        tvnet(**{option: value})


def test_dis_refuses_images_in_which_opencv_crashes(rig_of, sliding) -> None:
    """OpenCV 5.0 ends the process where a patch does not fit into the coarsest scale."""
    for scale, least in ((0, 16), (2, 32), (4, 128)):
        with pytest.raises(DataError, match="finest_scale|at least 16×16"):
            dis(finest_scale=scale).setup(rig_of(200, least - 1))
        frontend = dis(finest_scale=scale)
        frontend.setup(rig_of(200, least))
        frontend.process_many(sliding(200, least, count=2))


def test_dis_takes_its_options() -> None:
    settings = {dis(preset=preset).settings() for preset in ("ultrafast", "fast", "medium")}
    settings |= {dis(finest_scale=0).settings(), dis(descent_steps=3).settings(), dis(refinement_steps=0).settings()}
    assert len(settings) == 6


def test_without_torch_there_is_a_sentence(monkeypatch) -> None:
    monkeypatch.setattr("vioframe.learning.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"frontend=tvnet needs torch.*pip install 'vioframe\[learn\]'"):
        tvnet()
