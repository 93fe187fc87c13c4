"""Bags written from a simulated recording give it back, packet by packet; damaged ones say what is wrong."""

import inspect
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import yaml

from bag_writing import CAMERAS, FORMATS, TRUTH_TOPIC, open_bag, spoil_frame, write_bag
from vioframe.data.recording import prefetch
from vioframe.errors import ConfigError, DataError
from vioframe.geometry import se3, so3
from vioframe.types import Frame, ImuBlock
from vioframe_bags import BagDataset, bag


def flatten(packets) -> list[tuple]:
    """Samples and frames in order; how samples are cut into blocks does not matter."""
    events: list[tuple] = []
    for packet in packets:
        if isinstance(packet, ImuBlock):
            events += [
                ("imu", int(stamp_ns), tuple(gyro), tuple(accel))
                for stamp_ns, gyro, accel in zip(packet.stamps_ns, packet.gyro, packet.accel, strict=True)
            ]
        else:
            events.append(("frame", packet.stamp_ns, tuple(image.tobytes() for image in packet.images)))
    return events


@pytest.mark.parametrize("kind", FORMATS)
def test_bag_gives_back_what_was_recorded(tmp_path, simulated, options, kind):
    path = write_bag(tmp_path / "walk", kind, simulated)
    recording = open_bag(path, ground_truth_topic=TRUTH_TOPIC, cameras=2, **options)
    expected = flatten(simulated.packets)
    # The simulated recording ends with samples after the last frame, which are of no use.
    last = max(index for index, event in enumerate(expected) if event[0] == "frame")
    given = flatten(recording.packets())
    assert given[: last + 1] == expected[: last + 1]
    assert len(given) - last - 1 <= 1
    assert given == flatten(prefetch(recording.packets()))
    assert recording.name == "walk"
    assert recording.frame_count == sum(isinstance(packet, Frame) for packet in simulated.packets)
    assert recording.duration_s == pytest.approx(1.0)
    assert recording.counters() == {}
    assert not [finding for finding in recording.findings() if finding.level == "bad"]
    rig = recording.rig
    assert rig.camera_delay_ns == simulated.rig.camera_delay_ns == 4_000_000
    assert rig.imu.gyro_noise == simulated.rig.imu.gyro_noise
    for mine, theirs in zip(rig.cameras, simulated.rig.cameras, strict=True):
        assert mine.model == "equidistant" and mine.size_px == tuple(theirs.size_px)
        np.testing.assert_allclose(mine.T_body_cam, theirs.T_body_cam, atol=1e-12)
        np.testing.assert_allclose(mine.intrinsics_px, theirs.intrinsics_px)


@pytest.mark.parametrize("kind", bag.POSE)
def test_ground_truth_of_each_message_type(tmp_path, simulated, options, kind):
    path = write_bag(tmp_path / "walk", "mcap", simulated, truth=kind)
    truth = open_bag(path, ground_truth_topic=TRUTH_TOPIC, **options).ground_truth()
    np.testing.assert_array_equal(truth.stamps_ns, simulated.truth.stamps_ns[::5])
    np.testing.assert_allclose(truth.T_world_body, simulated.truth.T_world_body[::5], atol=1e-12)


def with_marker(simulated, T_body_marker: np.ndarray, late_ns: int = 0) -> SimpleNamespace:
    """The recording with the poses of a marker on the body, stamped by a clock that is late."""
    poses = replace(
        simulated.truth,
        stamps_ns=simulated.truth.stamps_ns + late_ns,
        T_world_body=simulated.truth.T_world_body @ T_body_marker,
        v_world_body=None,
    )
    return SimpleNamespace(**{**vars(simulated), "truth": poses})


T_BODY_MARKER = se3.from_parts(so3.exp(np.array([0.2, -0.4, 1.0])), np.array([0.1, 0.2, -0.3]))


def test_ground_truth_of_a_marker_is_moved_to_the_body_and_the_clock_of_the_imu(tmp_path, simulated, options):
    path = write_bag(tmp_path / "walk", "ros1", with_marker(simulated, T_BODY_MARKER, 20_000_000))
    recording = open_bag(
        path,
        ground_truth_topic=TRUTH_TOPIC,
        T_body_truth=T_BODY_MARKER.tolist(),
        ground_truth_delay_s=-0.02,
        **options,
    )
    truth = recording.ground_truth()
    np.testing.assert_allclose(truth.T_world_body, simulated.truth.T_world_body[::5], atol=1e-12)
    np.testing.assert_array_equal(truth.stamps_ns, simulated.truth.stamps_ns[::5])
    found = {finding.subject: finding for finding in recording.findings()}
    assert found["vertical"].level == "good" and found["ground truth of the frames"].level == "good"


def test_ground_truth_of_a_marker_that_is_taken_for_the_body_is_refused(tmp_path, simulated, options):
    path = write_bag(tmp_path / "walk", "ros1", with_marker(simulated, T_BODY_MARKER))
    with pytest.raises(DataError, match=r"from the vertical on average.*dataset\.T_body_truth"):
        open_bag(path, ground_truth_topic=TRUTH_TOPIC, **options)


def test_leaving_the_stream_early_and_beginning_anew(tmp_path, simulated, options, recwarn):
    recording = open_bag(write_bag(tmp_path / "walk", "db3", simulated), **options)
    stream = prefetch(recording.packets(), depth=1)
    first = next(stream)
    stream.close()
    assert flatten([first]) == flatten([next(iter(recording.packets()))])
    assert not [warning for warning in recwarn if "nraisable" in str(warning.category)]


def test_span_and_every(tmp_path, simulated, options):
    path = write_bag(tmp_path / "walk", "mcap", simulated)
    frames = [p for p in open_bag(path, **options).packets() if isinstance(p, Frame)]
    recording = open_bag(path, start_s=0.2, duration_s=0.6, every=2, **options)
    chosen = [p for p in recording.packets() if isinstance(p, Frame)]
    assert [f.stamp_ns for f in chosen] == [f.stamp_ns for f in frames[2:9:2]]
    assert recording.frame_count == len(chosen)


def test_blind_streams_stamps_only_and_needs_no_camera_calibration(tmp_path, simulated, options):
    path = write_bag(tmp_path / "walk", "ros1", simulated)
    recording = open_bag(path, imu_calibration=options["imu_calibration"], camera_topics=CAMERAS[0], images=False)
    frames = [p for p in recording.packets() if isinstance(p, Frame)]
    assert len(frames) == recording.frame_count and not any(f.images for f in frames)
    assert not recording.rig.has_images


@pytest.mark.parametrize("cameras", [1, 2])
def test_corrupt_image_is_left_out_and_counted(tmp_path, simulated, options, cameras, caplog):
    def truncated(writer, frame):
        writer.image(CAMERAS[0], frame.stamp_ns, frame.images[0])
        if cameras == 2:
            writer.image(CAMERAS[1], frame.stamp_ns, frame.images[1], data=frame.images[1].reshape(-1)[:-7])

    def broken(writer, frame):
        writer.image(CAMERAS[0], frame.stamp_ns, frame.images[0], data=frame.images[0].reshape(-1)[:100])
        writer.image(CAMERAS[1], frame.stamp_ns, frame.images[1])

    path = write_bag(tmp_path / "walk", "mcap", simulated, spoil=spoil_frame(4, truncated if cameras == 2 else broken))
    recording = open_bag(path, cameras=cameras, **options)
    frames = [p for p in recording.packets() if isinstance(p, Frame)]
    expected = [p for p in simulated.packets if isinstance(p, Frame)]
    assert [f.stamp_ns for f in frames] == [f.stamp_ns for f in expected[:4] + expected[5:]]
    assert recording.counters() == {"corrupt images": 1}
    assert str(expected[4].stamp_ns) in caplog.text


def test_compressed_images(tmp_path, simulated, options):
    def spoil(writer, packet):
        if isinstance(packet, Frame):
            for topic, image in zip(CAMERAS, packet.images, strict=True):
                writer.compressed(topic, packet.stamp_ns, cv2.imencode(".png", image)[1].tobytes())
            return True
        return False

    path = write_bag(tmp_path / "walk", "ros1", simulated, spoil=spoil)
    frames = [p for p in open_bag(path, **options).packets() if isinstance(p, Frame)]
    for mine, theirs in zip(frames, (p for p in simulated.packets if isinstance(p, Frame)), strict=True):
        np.testing.assert_array_equal(mine.images[0], theirs.images[0])


def test_folder_of_bags(tmp_path, simulated, options):
    folder = tmp_path / "bags"
    folder.mkdir()
    for name, kind in (("a", "ros1"), ("b", "db3"), ("c", "mcap")):
        write_bag(folder / name, kind, simulated, truth=None)
    assert BagDataset(root=str(folder), **options).sequences == ["a", "b", "c"]
    assert BagDataset(root=str(folder), sequence=["c", "a.bag"], **options).sequences == ["c", "a"]
    with pytest.raises(DataError, match="there is no bag d here.*there are a, b, c"):
        BagDataset(root=str(folder), sequence="d", **options)
    empty = tmp_path / "none"
    empty.mkdir()
    with pytest.raises(DataError, match="no bag here"):
        BagDataset(root=str(empty), **options)
    with pytest.raises(DataError, match="no such file or folder"):
        BagDataset(root=str(tmp_path / "missing"), **options)


def test_missing_extra(tmp_path, simulated, options, monkeypatch):
    path = write_bag(tmp_path / "walk", "mcap", simulated)
    monkeypatch.setitem(__import__("sys").modules, "rosbags.highlevel", None)
    with pytest.raises(ConfigError, match=r"pip install 'vioframe\[bags\]'"):
        open_bag(path, **options)


def test_every_option_is_in_the_config():
    path = Path(bag.__file__).parent / "conf" / "dataset" / "bag.yaml"
    assert set(yaml.safe_load(path.read_text())) - {"_target_"} == set(inspect.signature(BagDataset).parameters)
