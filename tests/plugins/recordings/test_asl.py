"""ASL folders: what is streamed, in which order, and what is said about it."""

import logging
import weakref
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from vioframe.data import agreement
from vioframe.data.checked import BLOCK_NS
from vioframe.data.selection import match_stamps
from vioframe.errors import ClockError, DataError
from vioframe.geometry import se3, so3
from vioframe.types import Frame, ImuBlock
from vioframe_recordings import EurocDataset, TumviDataset
from vioframe_recordings.asl_files import read_imu
from vioframe_recordings.stored import StoredRecording

Maker = Callable[..., Path]


def opened(mav0: Path, **options: object) -> StoredRecording:
    return EurocDataset(root=str(mav0.parents[1]), sequence=mav0.parent.name, **options).open(mav0.parent.name)  # type: ignore[arg-type]


def levels(recording: StoredRecording, level: str) -> dict[str, str]:
    return {finding.subject: finding.text for finding in recording.findings() if finding.level == level}


def test_a_sound_recording_has_nothing_bad(make_asl: Maker) -> None:
    recording = opened(make_asl(), cameras=2)
    assert not levels(recording, "bad") and not levels(recording, "note")
    assert recording.frame_count == 20
    assert recording.duration_s == pytest.approx(1.9)
    assert recording.name == "swing"
    camera = recording.rig.cameras[0]
    assert camera.model == "radtan" and camera.size_px == (64, 48)
    np.testing.assert_allclose(camera.intrinsics_px, [60.0, 61.0, 31.5, 23.5])
    assert recording.rig.imu.rate_hz == 200.0 and recording.rig.imu.accel_noise == 2e-3


def test_packets_come_in_order_and_each_once(make_asl: Maker) -> None:
    recording = opened(make_asl())
    packets = list(recording.packets())
    blocks = [p for p in packets if isinstance(p, ImuBlock)]
    stamps = np.concatenate([block.stamps_ns for block in blocks])
    assert (np.diff(stamps) > 0).all()
    np.testing.assert_array_equal(stamps, recording.imu.stamps_ns)
    assert max(int(block.stamps_ns[-1] - block.stamps_ns[0]) for block in blocks) <= BLOCK_NS
    seen_ns = 0
    for packet in packets:
        if isinstance(packet, Frame):
            # The sample that closes the window is there, and only that one is ahead of the frame.
            assert packet.stamp_ns <= seen_ns < packet.stamp_ns + 5_000_000
        else:
            seen_ns = int(packet.stamps_ns[-1])
    assert [int(p.images[0][0, 0]) for p in packets if isinstance(p, Frame)] == list(range(20))


def test_packets_begin_anew_each_time(make_asl: Maker) -> None:
    recording = opened(make_asl())
    first, second = ([p.stamp_ns for p in recording.packets() if isinstance(p, Frame)] for _ in range(2))
    assert first == second and len(first) == 20


def test_memory_is_flat(make_asl: Maker) -> None:
    recording = opened(make_asl(), cameras=2)
    alive: list[weakref.ref[np.ndarray]] = []
    most = 0
    for packet in recording.packets():
        if isinstance(packet, Frame):
            alive += [weakref.ref(image) for image in packet.images]
        del packet
        most = max(most, sum(ref() is not None for ref in alive))
    assert len(alive) == 40 and most <= 2


def test_stereo_pairs(make_asl: Maker) -> None:
    mav0 = make_asl()
    listing = mav0 / "cam1" / "data.csv"
    rows = listing.read_text().split("\n")
    # The seventh image of cam1 is missing, the third 0.4 ms late: 19 pairs.
    del rows[7]
    stamp, _, name = rows[3].partition(",")
    rows[3] = f"{int(stamp) + 400_000},{name}"
    listing.write_text("\n".join(rows))
    recording = opened(mav0, cameras=2)
    frames = [p for p in recording.packets() if isinstance(p, Frame)]
    assert len(frames) == 19 == recording.frame_count
    for frame in frames:
        left, right = frame.images
        assert left[0, 0] == right[0, 0] and (left[0, 1], right[0, 1]) == (0, 1)
    assert "1 of 20" in levels(recording, "note")["stereo pairs"]


def test_cameras_without_common_stamps_are_refused(make_asl: Maker) -> None:
    mav0 = make_asl()
    listing = mav0 / "cam1" / "data.csv"
    lines = [
        line if line.startswith("#") or not line else f"{int(line[:19]) + 50_000_000}{line[19:]}"
        for line in listing.read_text().split("\n")
    ]
    listing.write_text("\n".join(lines))
    with pytest.raises(ClockError, match="do not form pairs"):
        opened(mav0, cameras=2)


@pytest.mark.parametrize("shift", [0, 600_000, -600_000])
def test_stamps_match_to_the_nearest_each_once(shift: int) -> None:
    rng = np.random.default_rng(1)
    left = np.cumsum(rng.integers(40_000_000, 60_000_000, 50))
    kept = np.sort(rng.choice(50, 40, replace=False))
    a, b = match_stamps(left, left[kept] + shift)
    np.testing.assert_array_equal(a, kept)
    np.testing.assert_array_equal(b, np.arange(40))


def test_decimation_and_span(make_asl: Maker) -> None:
    recording = opened(make_asl(), every=3, start_s=0.25, duration_s=1.2)
    numbers = [int(p.images[0][0, 0]) for p in recording.packets() if isinstance(p, Frame)]
    assert numbers == [3, 6, 9, 12]
    assert recording.frame_count == 4


def test_without_images_stamps_are_streamed_and_calibration_is_kept(make_asl: Maker) -> None:
    recording = opened(make_asl(), images=False)
    frames = [p for p in recording.packets() if isinstance(p, Frame)]
    assert len(frames) == 20 and all(frame.images == () for frame in frames)
    assert not recording.rig.has_images and len(recording.rig.cameras) == 1


def test_published_calibration_stands_in_only_without_images(make_asl: Maker) -> None:
    mav0 = make_asl()
    for name in ("cam0", "cam1", "imu0"):
        (mav0 / name / "sensor.yaml").unlink()
    recording = opened(mav0, images=False)
    assert recording.rig.cameras[0].size_px == (752, 480)
    assert "published" in levels(recording, "note")["camera calibration"]
    with pytest.raises(DataError, match=r"sensor.yaml: no such file"):
        opened(mav0)
    with pytest.raises(DataError, match=r"sensor.yaml: no such file"):
        opened(mav0, images=False, calibration="files")


def test_stamps_alone_are_enough_without_images(make_asl: Maker) -> None:
    mav0 = make_asl()
    listing = mav0 / "cam0" / "data.csv"
    stamps = [line[:19] for line in listing.read_text().split("\n")[1:] if line]
    listing.unlink()
    (mav0 / "cam0" / "timestamps.txt").write_text("\n".join(stamps) + "\n")
    assert opened(mav0, images=False).frame_count == 20
    # The images are still there, named after their stamps.
    assert opened(mav0).frame_count == 20


def test_a_corrupt_image_is_skipped_counted_and_told_once(make_asl: Maker, caplog: pytest.LogCaptureFixture) -> None:
    mav0 = make_asl()
    images = sorted((mav0 / "cam0" / "data").iterdir())
    images[7].write_bytes(images[7].read_bytes()[:50])
    images[9].write_bytes(b"")
    recording = opened(mav0)
    for _ in range(2):
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            frames = [p for p in recording.packets() if isinstance(p, Frame)]
        assert len(frames) == 18
        assert recording.counters() == {"corrupt images": 2}
        assert len([r for r in caplog.records if "cannot be decoded" in r.message]) == 1


def test_an_image_of_another_size_in_mid_run_is_skipped(make_asl: Maker) -> None:
    import cv2

    mav0 = make_asl()
    victim = sorted((mav0 / "cam0" / "data").iterdir())[12]
    cv2.imwrite(str(victim), np.zeros((10, 10), dtype=np.uint8))
    recording = opened(mav0)
    assert sum(isinstance(p, Frame) for p in recording.packets()) == 19
    assert recording.counters() == {"corrupt images": 1}


def test_missing_images_are_counted(make_asl: Maker) -> None:
    mav0 = make_asl()
    sorted((mav0 / "cam0" / "data").iterdir())[4].unlink()
    recording = opened(mav0)
    assert recording.frame_count == 19
    assert recording.counters() == {"missing images": 1}
    assert "1 of 20 images are not there" in next(
        f.text for f in recording.findings() if f.subject == "images" and f.level == "note"
    )


def test_frames_outside_the_imu_are_left_out(make_asl: Maker) -> None:
    mav0 = make_asl()
    path = mav0 / "imu0" / "data.csv"
    path.write_text("\n".join(path.read_text().split("\n")[:400]) + "\n")
    recording = opened(mav0)
    assert recording.frame_count == 15
    assert "5 of 20 frames" in levels(recording, "note")["camera and imu clocks"]


def test_the_delay_of_the_camera_is_in_the_rig(make_asl: Maker) -> None:
    recording = opened(make_asl(), camera_delay_s=0.0123)
    assert recording.rig.camera_delay_ns == 12_300_000
    seen_ns = 0
    for packet in recording.packets():
        if isinstance(packet, Frame):
            assert packet.stamp_ns + 12_300_000 <= seen_ns
        else:
            seen_ns = int(packet.stamps_ns[-1])


def test_body_is_the_imu_where_the_files_say_otherwise(make_asl: Maker) -> None:
    """A recording whose body is not its IMU: cameras and truth are moved to the IMU."""
    mav0 = make_asl()
    T_body_imu = se3.from_parts(so3.exp(np.array([0.05, -0.08, 0.1])), np.array([0.1, 0.2, -0.3]))
    T_body_cam = se3.from_parts(so3.exp(np.array([-0.5, 0.4, 0.2])), np.array([0.0, 0.1, 0.05]))
    plain = opened(mav0).ground_truth()
    for name, T in (("imu0", T_body_imu), ("cam0", T_body_cam)):
        path = mav0 / name / "sensor.yaml"
        path.write_text(path.read_text().replace(identity_text(path), f"data: {T.ravel().tolist()}"))
    recording = opened(mav0)
    np.testing.assert_allclose(recording.rig.cameras[0].T_body_cam, se3.inverse(T_body_imu) @ T_body_cam, atol=1e-12)
    truth = recording.ground_truth()
    assert truth is not None and plain is not None
    np.testing.assert_allclose(truth.T_world_body, plain.T_world_body @ T_body_imu, atol=1e-12)
    # Now the file says that its poses are those of the IMU.
    beside = mav0 / "state_groundtruth_estimate0" / "sensor.yaml"
    beside.write_text(f"T_BS:\n  data: {T_body_imu.ravel().tolist()}\n")
    truth = opened(mav0).ground_truth()
    assert truth is not None
    np.testing.assert_allclose(truth.T_world_body, plain.T_world_body, atol=1e-12)


def identity_text(path: Path) -> str:
    text = path.read_text()
    start = text.index("data: [")
    return text[start : text.index("]", start) + 1]


def drop_samples(mav0: Path, start: int, count: int) -> None:
    path = mav0 / "imu0" / "data.csv"
    lines = path.read_text().split("\n")
    del lines[start + 1 : start + 1 + count]
    path.write_text("\n".join(lines))


def test_gap_kept_refused_filled(make_asl: Maker) -> None:
    mav0 = make_asl()
    whole, _ = read_imu(mav0)
    drop_samples(mav0, 300, 30)
    kept = opened(mav0)
    assert len(kept.imu) < 600 and "1 hole, the longest 0.155 s" in levels(kept, "note")["imu gaps"]
    with pytest.raises(ClockError, match="gap_policy=refuse"):
        opened(mav0, gap_policy="refuse")
    with pytest.raises(ClockError, match="too long to fill"):
        opened(mav0, gap_policy="fill", max_fill_s=0.1)
    filled = opened(mav0, gap_policy="fill")
    np.testing.assert_array_equal(filled.imu.stamps_ns, whole.stamps_ns[: len(filled.imu)])
    # On the straight line between the samples at both sides of the hole.
    middle = 0.5 * (whole.accel[299] + whole.accel[330])
    at = int(np.searchsorted(filled.imu.stamps_ns, (whole.stamps_ns[299] + whole.stamps_ns[330]) // 2))
    np.testing.assert_allclose(0.5 * (filled.imu.accel[at - 1] + filled.imu.accel[at]), middle, atol=1e-9)


def test_gap_splits_into_sequences(make_asl: Maker) -> None:
    mav0 = make_asl()
    drop_samples(mav0, 300, 30)
    dataset = EurocDataset(root=str(mav0.parents[1]), gap_policy="split")
    assert list(dataset.sequences) == ["swing.part0", "swing.part1"]
    numbers = []
    for name in dataset.sequences:
        recording = dataset.open(name)
        assert recording.name == name
        assert np.diff(recording.imu.stamps_ns).max() == 5_000_000
        numbers.append([int(p.images[0][0, 0]) for p in recording.packets() if isinstance(p, Frame)])
    # Frame 10 (at 1.502 s) and 11 (at 1.602 s) fall into or beside the hole from 1.495 to 1.65 s.
    assert numbers == [list(range(10)), list(range(12, 20))]


def test_a_recording_without_a_gap_is_not_split(make_asl: Maker) -> None:
    mav0 = make_asl()
    assert list(EurocDataset(root=str(mav0.parents[1]), gap_policy="split").sequences) == ["swing"]


def test_one_sequence_may_be_the_root(make_asl: Maker) -> None:
    mav0 = make_asl()
    for root in (mav0.parent, mav0):
        dataset = EurocDataset(root=str(root))
        assert list(dataset.sequences) == ["swing"]
        assert dataset.open("swing").frame_count == 20


def test_several_sequences_in_the_order_asked_for(make_asl: Maker) -> None:
    make_asl("a", count=3)
    root = make_asl("b", count=4).parents[1]
    assert list(EurocDataset(root=str(root)).sequences) == ["a", "b"]
    dataset = EurocDataset(root=str(root), sequence=["b", "a"])
    assert [dataset.open(name).frame_count for name in dataset.sequences] == [4, 3]


def test_truth_choices(make_asl: Maker) -> None:
    mav0 = make_asl()
    truth_file = mav0 / "state_groundtruth_estimate0" / "data.csv"
    (mav0 / "gt_openvins_swing_corrected.csv").write_text(truth_file.read_text())
    truth = opened(mav0).ground_truth()
    assert truth is not None and len(truth) == 600 and truth.v_world_body is not None
    assert "dataset.ground_truth=corrected" in levels(opened(mav0), "note")["ground truth choice"]
    assert opened(mav0, ground_truth="none").ground_truth() is None
    assert opened(mav0, ground_truth="corrected").ground_truth() is not None
    assert opened(mav0, ground_truth="gt_openvins_swing_corrected.csv").ground_truth() is not None
    truth_file.unlink()
    recording = opened(mav0)
    assert recording.ground_truth() is None and "none in this recording" in levels(recording, "note")["ground truth"]


def test_tumvi_reads_mocap(make_asl: Maker) -> None:
    mav0 = make_asl("dataset-room9_512_16")
    lines = (mav0 / "state_groundtruth_estimate0" / "data.csv").read_text().split("\n")
    (mav0 / "mocap0").mkdir()
    (mav0 / "mocap0" / "data.csv").write_text("\n".join(",".join(line.split(",")[:8]) for line in lines if line))
    recording = TumviDataset(root=str(mav0.parents[1])).open("dataset-room9_512_16")
    truth = recording.ground_truth()
    assert truth is not None and truth.v_world_body is None


def test_the_vertical_is_found_in_a_short_clip(make_asl: Maker) -> None:
    """Three seconds of strong motion: the mean acceleration must be taken out to see which way is up."""
    recording = opened(make_asl())
    truth = recording.ground_truth()
    assert truth is not None
    imu, _ = read_imu(Path(recording._image_paths[0][0]).parents[2])
    force, _ = agreement.mean_specific_force(imu, truth)
    np.testing.assert_allclose(force, [0.0, 0.0, 9.81], atol=0.02)


def test_drop_outs_of_the_truth_are_kept(make_asl: Maker) -> None:
    mav0 = make_asl()
    path = mav0 / "state_groundtruth_estimate0" / "data.csv"
    lines = path.read_text().split("\n")
    del lines[200:300]
    path.write_text("\n".join(lines))
    recording = opened(mav0)
    truth = recording.ground_truth()
    assert truth is not None and np.diff(truth.stamps_ns).max() == 505_000_000
    assert "1 drop-out" in levels(recording, "note")["ground truth gaps"]
