"""Whatever is wrong with a bag is told when it is opened: one sentence with the bag, and the topic or key."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from bag_writing import CAMERAS, FORMATS, BagWriter, open_bag, spoil_imu, write_bag
from vioframe.errors import ClockError, ConfigError, DataError


@pytest.mark.parametrize(
    ("change", "error", "sentence"),
    [
        (lambda n, t, w, a: (t - 50_000_000 * (n == 40), w, a), ClockError, "of message 41 is earlier"),
        (lambda n, t, w, a: (t - 10_000_000 * (n == 40), w, a), ClockError, "of message 41 repeats"),
        (lambda n, t, w, a: (0, w, a), ClockError, "does not fill in header.stamp"),
        (lambda n, t, w, a: (t, w * np.where(n == 40, np.nan, 1.0), a), DataError, "not finite"),
        (lambda n, t, w, a: (t, w + 40.0, a), DataError, "degrees per second"),
        (lambda n, t, w, a: (t, w, a / 9.81), DataError, "multiples of g"),
        (lambda n, t, w, a: (t + 10**13, w, a), ClockError, "do not overlap"),
    ],
)
def test_spoilt_samples_are_refused_in_one_sentence(tmp_path, simulated, options, change, error, sentence):
    path = write_bag(tmp_path / "walk", "mcap", simulated, spoil=spoil_imu(change))
    with pytest.raises(error, match=sentence) as caught:
        open_bag(path, **options)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_unsuitable_topics_are_refused_with_what_there_is(tmp_path, simulated, options):
    path = write_bag(tmp_path / "walk", "ros1", simulated)
    with pytest.raises(DataError, match=r"imu_topic=/imu is not in the bag.*set it to /imu0"):
        open_bag(path, imu_topic="/imu", **options)
    with pytest.raises(DataError, match=r"camera_topics=/imu0 has messages of type sensor_msgs/msg/Imu"):
        open_bag(path, camera_topics="/imu0", **options)
    with pytest.raises(DataError, match=r"ground_truth_topic=/odometry is not in the bag.*set it to /vicon/pose"):
        open_bag(path, ground_truth_topic="/odometry", **options)
    with pytest.raises(ConfigError, match="camera_topics=/cam0/image_raw names 1 camera, but rig=stereo needs 2"):
        open_bag(path, camera_topics=CAMERAS[0], cameras=2, **options)
    bare = write_bag(tmp_path / "bare", "ros1", simulated, truth=None)
    with pytest.raises(DataError, match=r"the bag's topics are /cam0/image_raw \(sensor_msgs/msg/Image\)"):
        open_bag(bare, ground_truth_topic="/odometry", **options)


def test_topics_are_asked_for_where_nothing_settles_them(tmp_path, simulated, options):
    path = write_bag(tmp_path / "walk", "mcap", simulated)
    noise = yaml.safe_load(Path(options["imu_calibration"]).read_text())
    del noise["rostopic"]
    Path(options["imu_calibration"]).write_text(yaml.safe_dump(noise))
    # There is only one topic of inertial samples, but two of images.
    with pytest.raises(ConfigError, match=r"camera_topics is not set.*/cam0/image_raw, /cam1/image_raw"):
        open_bag(path, imu_calibration=options["imu_calibration"], images=False)


@pytest.mark.parametrize(
    ("file", "path", "sentence"),
    [
        ("imu_calibration", ("gyroscope_noise_density",), "the key 'gyroscope_noise_density' is missing"),
        ("camera_calibration", ("cam0", "T_cam_imu"), "the key 'cam0.T_cam_imu' is missing"),
        ("camera_calibration", ("cam0", "intrinsics"), "the key 'cam0.intrinsics' is missing"),
        ("camera_calibration", ("cam1", "distortion_coeffs"), "the key 'cam1.distortion_coeffs' is missing"),
    ],
)
def test_missing_calibration_key(tmp_path, simulated, options, file, path, sentence):
    content = yaml.safe_load(Path(options[file]).read_text())
    inner = content
    for key in path[:-1]:
        inner = inner[key]
    del inner[path[-1]]
    Path(options[file]).write_text(yaml.safe_dump(content))
    with pytest.raises(DataError, match=sentence) as caught:
        open_bag(write_bag(tmp_path / "walk", "mcap", simulated), **options)
    assert str(options[file]) in str(caught.value)


def test_wrong_image_size_is_refused(tmp_path, simulated, options):
    content = yaml.safe_load(Path(options["camera_calibration"]).read_text())
    content["cam0"]["resolution"] = [161, 120]
    Path(options["camera_calibration"]).write_text(yaml.safe_dump(content))
    with pytest.raises(DataError, match="160×120 px but the calibration says 161×120"):
        open_bag(write_bag(tmp_path / "walk", "mcap", simulated), **options)


def test_no_camera_calibration(tmp_path, simulated, options):
    path = write_bag(tmp_path / "walk", "mcap", simulated)
    with pytest.raises(ConfigError, match="camera_calibration holds 0 of the 1 cameras"):
        open_bag(path, imu_calibration=options["imu_calibration"], camera_topics=CAMERAS[0])


@pytest.mark.parametrize("kind", FORMATS)
def test_empty_bag(tmp_path, options, kind):
    with BagWriter(tmp_path / "empty", kind) as writer:
        pass
    with pytest.raises(DataError, match="the bag holds no messages") as caught:
        open_bag(writer.path, **options)
    assert str(writer.path) in str(caught.value)


def test_damaged_bags(tmp_path, simulated, options):
    nothing = tmp_path / "nothing.bag"
    nothing.write_bytes(b"")
    with pytest.raises(DataError, match=r"nothing.bag: cannot be opened as a bag"):
        open_bag(nothing, **options)
    noise = tmp_path / "noise.mcap"
    noise.write_bytes(np.random.default_rng(0).bytes(5000))
    with pytest.raises(DataError, match=r"noise.mcap: cannot be opened as a bag"):
        open_bag(noise, **options)
    cut = write_bag(tmp_path / "cut", "ros1", simulated)
    cut.write_bytes(cut.read_bytes()[:100_000])
    with pytest.raises(DataError, match=r"cut.bag: (cannot be opened|damaged)"):
        open_bag(cut, **options)
