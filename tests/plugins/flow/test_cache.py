import errno
import os

import numpy as np
import pytest

from vioframe.errors import DataError
from vioframe_flow import DisFrontend
from vioframe_flow.cache import FlowCache


def entries(folder) -> list:
    return sorted(path for path in folder.rglob("*") if path.is_file())


def run(folder, rig, frames, **options):
    frontend = DisFrontend(cache=str(folder), **options)
    frontend.setup(rig)
    return [features.flow for features in frontend.process_many(frames)], frontend.counters()


@pytest.mark.parametrize("quantise", [True, False])
def test_the_second_time_nothing_is_computed(quantise, tmp_path, rig_of, sliding, monkeypatch) -> None:
    rig, frames = rig_of(96, 64), sliding(96, 64)
    first, counted = run(tmp_path / "flows", rig, frames, quantise=quantise)
    assert counted == {"flows from cache": 0, "flows computed": 4}
    monkeypatch.setattr(DisFrontend, "solve", lambda *_: pytest.fail("computed again"))
    again, counted = run(tmp_path / "flows", rig, frames, quantise=quantise)
    assert counted == {"flows from cache": 4, "flows computed": 0}
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a, b)
        assert a.dtype == b.dtype == np.float32


def test_flows_are_told_apart_by_content_order_and_settings(tmp_path, rig_of, sliding) -> None:
    rig, frames = rig_of(96, 64), sliding(96, 64)
    run(tmp_path, rig, frames)
    cases = [
        (frames[::-1], {}),
        (sliding(96, 64, seed=1), {}),
        (frames, {"preset": "fast"}),
        (frames, {"quantise": False}),
        (frames, {"bound": 0.2}),
        (frames, {"size_px": [64, 48]}),
    ]
    for others, options in cases:
        assert run(tmp_path, rig, others, **options)[1]["flows from cache"] == 0, options
    # The same images under other stamps, or in part, are the same images.
    assert run(tmp_path, rig, frames[2:])[1] == {"flows from cache": 2, "flows computed": 0}


def test_what_is_damaged_is_computed_again(tmp_path, rig_of, sliding, caplog) -> None:
    rig, frames = rig_of(96, 64), sliding(96, 64)
    good, _ = run(tmp_path, rig, frames)
    paths = entries(tmp_path)
    assert len(paths) == 4
    whole = paths[0].read_bytes()
    paths[0].write_bytes(whole[:-1000])
    paths[1].write_bytes(b"")
    flipped = bytearray(paths[2].read_bytes())
    flipped[500] ^= 1
    paths[2].write_bytes(bytes(flipped))
    with caplog.at_level("WARNING"):
        again, counted = run(tmp_path, rig, frames)
    assert counted == {"flows from cache": 1, "flows computed": 3, "damaged flows": 3}
    assert "will be computed again" in caplog.text
    for a, b in zip(good, again, strict=True):
        np.testing.assert_array_equal(a, b)
    assert paths[0].read_bytes() == whole


def test_an_array_of_another_shape_is_not_taken(tmp_path) -> None:
    cache = FlowCache(str(tmp_path), "settings")
    cache.store(cache.key(b"a", b"b"), np.zeros((2, 3), np.uint8))
    assert cache.load(cache.key(b"a", b"b"), (3, 2), np.uint8) is None
    assert cache.load(cache.key(b"a", b"b"), (2, 3), np.float32) is None
    assert cache.load(cache.key(b"a", b"b"), (2, 3), np.uint8) is not None


def test_no_space_is_said_and_leaves_nothing_behind(tmp_path, rig_of, sliding, monkeypatch) -> None:
    def full(source, target):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("vioframe_flow.cache.os.replace", full)
    with pytest.raises(DataError, match=r"frontend\.cache=.*12 KiB \(No space left.*frontend\.cache=null"):
        run(tmp_path, rig_of(96, 64), sliding(96, 64))
    assert entries(tmp_path) == []


def test_a_file_is_no_folder(tmp_path, rig_of, sliding) -> None:
    (tmp_path / "taken").write_text("")
    with pytest.raises(DataError, match="cannot be made a folder"):
        run(tmp_path / "taken", rig_of(96, 64), sliding(96, 64))
