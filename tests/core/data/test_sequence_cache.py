"""The cache of decoded recordings: what comes back is what went in, once, and what cannot be kept is told."""

import shutil
from collections import namedtuple
from dataclasses import replace

import numpy as np
import pytest

from learned_scenes import SceneRecording
from vioframe.data.sequence_cache import SequenceCache, resized_camera
from vioframe.errors import ConfigError, DataError
from vioframe.geometry.camera import project

FULL = (320, 240)


def test_round_trip_is_exact_at_full_size(tmp_path):
    recording = SceneRecording()
    stored, _ = SequenceCache(tmp_path, size_px=FULL, channels=1).get(recording, "scene")
    np.testing.assert_array_equal(stored.images[..., 0], np.stack([f.images[0] for f in recording.frames]))
    np.testing.assert_array_equal(stored.stamps_ns, recording.scene.truth.stamps_ns)
    T_body_cam = recording.rig.cameras[0].T_body_cam
    np.testing.assert_allclose(stored.T_world_cam, recording.scene.truth.T_world_body @ T_body_cam, atol=1e-12)
    np.testing.assert_array_equal(stored.imu.gyro, recording.scene.imu.gyro)
    assert stored.known.all()


def test_second_time_nothing_is_decoded_beyond_the_key(tmp_path):
    recording = SceneRecording()
    cache = SequenceCache(tmp_path, size_px=(64, 48), channels=3)
    _, first = cache.get(recording, "scene")
    recording.streamed = 0
    _, second = cache.get(recording, "scene")
    assert first == second
    assert recording.streamed <= 4
    assert len(list(tmp_path.iterdir())) == 1


def test_other_pixels_configuration_or_size_are_kept_apart(tmp_path):
    def dim(index, frame):
        return replace(frame, images=tuple(image // 2 for image in frame.images))

    cache = SequenceCache(tmp_path, size_px=(64, 48), channels=1)
    hashes = {
        cache.get(SceneRecording(), "scene")[1],
        cache.get(SceneRecording(change=dim), "scene")[1],
        SequenceCache(tmp_path, size_px=(32, 24), channels=1).get(SceneRecording(), "scene")[1],
    }
    cache.get(SceneRecording(), "another configuration")
    assert len(hashes) == 3
    assert len(list(tmp_path.iterdir())) == 4


def test_resized_calibration_puts_points_where_resized_images_do():
    camera = SceneRecording().rig.cameras[0]
    small = resized_camera(camera, (160, 60))
    point = np.array([0.3, 0.2, 2.0])
    full, _ = project(camera, point)
    half, _ = project(small, point)
    # Continuous coordinates, which begin at the corner of the first pixel, scale.
    np.testing.assert_allclose((half + 0.5) / (full + 0.5), [0.5, 0.25])


def test_one_frame_is_refused(tmp_path):
    with pytest.raises(DataError, match="has 1 image, but a motion takes two"):
        SequenceCache(tmp_path, size_px=(64, 48), channels=1).get(SceneRecording(frames=1), "scene")
    assert not list(tmp_path.iterdir())


def test_images_of_mixed_sizes_are_refused(tmp_path):
    def crop(index, frame):
        return replace(frame, images=tuple(image[:100] for image in frame.images)) if index == 4 else frame

    with pytest.raises(DataError, match=r"image 4 is 320×100 px, those before are 320×240"):
        SequenceCache(tmp_path, size_px=(64, 48), channels=1).get(SceneRecording(change=crop), "scene")
    assert not list(tmp_path.iterdir())


def test_a_few_damaged_images_are_told_and_many_are_refused(tmp_path, monkeypatch, caplog):
    recording = SceneRecording()
    cache = SequenceCache(tmp_path, size_px=(64, 48), channels=1)
    count = len(recording.frames)
    monkeypatch.setattr(type(recording), "counters", lambda self: {"corrupt images": count})
    with pytest.raises(
        DataError, match=rf"{count} of {2 * count} images are damaged or of another size.*leave the rec"
    ):
        cache.get(recording, "scene")
    assert list(tmp_path.iterdir()) == []
    monkeypatch.setattr(type(recording), "counters", lambda self: {"corrupt images": 1})
    monkeypatch.setattr("vioframe.data.sequence_cache._MOST_LOST", 1.0 / count)
    cache.get(recording, "scene")
    assert f"1 of {count + 1} images are damaged" in caplog.text


def test_no_space_is_told_before_anything_is_decoded(tmp_path, monkeypatch):
    usage = namedtuple("usage", "total used free")(10**9, 10**9, 1000)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage)
    with pytest.raises(DataError, match=r"trainer.cache=.* free some space"):
        SequenceCache(tmp_path, size_px=FULL, channels=1).get(SceneRecording(), "scene")
    assert not list(tmp_path.iterdir())


def test_space_that_ends_on_the_way_leaves_nothing_behind(tmp_path, monkeypatch):
    def full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(DataError, match="free some space"):
        SequenceCache(tmp_path, size_px=(64, 48), channels=1).get(SceneRecording(), "scene")
    assert not list(tmp_path.iterdir())


def test_truncated_cache_is_told_with_what_to_do(tmp_path):
    cache = SequenceCache(tmp_path, size_px=(64, 48), channels=1)
    cache.get(SceneRecording(), "scene")
    pixels = next(tmp_path.rglob("images.u8"))
    pixels.write_bytes(pixels.read_bytes()[:1000])
    with pytest.raises(DataError, match="damaged .* delete it"):
        cache.get(SceneRecording(), "scene")


@pytest.mark.parametrize(("size", "channels"), [((0, 48), 1), ((64,), 1), ((64, 48), 2)])
def test_impossible_format_is_refused(tmp_path, size, channels):
    with pytest.raises(ConfigError, match=r"trainer\.(size_px|channels)"):
        SequenceCache(tmp_path, size_px=size, channels=channels)
