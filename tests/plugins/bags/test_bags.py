"""Bags written from a simulated recording give it back, packet by packet; damaged ones say what is wrong."""

import inspect
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import yaml

from vioframe.data.recording import prefetch
from vioframe.data.simulator import CameraSettings, ImuSettings, SimulatedDataset
from vioframe.errors import ClockError, ConfigError, DataError
from vioframe.geometry import quaternion, se3, so3
from vioframe.types import Frame, ImuBlock

pytest.importorskip("rosbags", reason="rosbags is not installed (pip install 'vioframe[bags]')")

from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from vioframe_bags import BagDataset, bag, calibration, messages

FORMATS = ("ros1", "db3", "mcap")
IMU_TOPIC, TRUTH_TOPIC, CAMERAS = "/imu0", "/vicon/pose", ("/cam0/image_raw", "/cam1/image_raw")
# Records carry the computer's clock, far from that of the sensors.
RECORDED_LATER_NS = 987_654_321
DELAY_S = 0.004


class BagWriter:
    """Writes messages of one format; stores differ in what a header holds."""

    def __init__(self, path: Path, kind: str) -> None:
        self.ros1 = kind == "ros1"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.ros1 else Stores.ROS2_HUMBLE)
        if self.ros1:
            self.path = path.with_suffix(".bag")
            self.writer = Writer1(self.path)
        else:
            self.path = path
            plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
            self.writer = Writer2(path, version=9, storage_plugin=plugin)
        self.connections: dict[str, object] = {}
        self.recorded_ns = 0

    def __enter__(self) -> "BagWriter":
        self.writer.open()
        return self

    def __exit__(self, *exc: object) -> None:
        self.writer.close()

    def make(self, name: str, **fields: object) -> object:
        return self.store.types[name](**fields)

    def header(self, stamp_ns: int) -> object:
        stamp = self.make("builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
        extra = {"seq": 0} if self.ros1 else {}
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id="a frame", **extra)

    def vector(self, values: np.ndarray) -> object:
        return self.make("geometry_msgs/msg/Vector3", **dict(zip("xyz", map(float, values), strict=True)))

    def rotation(self, R: np.ndarray) -> object:
        return self.make(
            "geometry_msgs/msg/Quaternion", **dict(zip("wxyz", map(float, quaternion.from_matrix(R)), strict=True))
        )

    def write(self, topic: str, kind: str, message: object) -> None:
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        serialize = self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr
        self.recorded_ns += 1_000_000
        self.writer.write(self.connections[topic], RECORDED_LATER_NS + self.recorded_ns, serialize(message, kind))

    def imu(self, stamp_ns: int, gyro: np.ndarray, accel: np.ndarray, topic: str = IMU_TOPIC) -> None:
        message = self.make(
            "sensor_msgs/msg/Imu",
            header=self.header(stamp_ns),
            orientation=self.rotation(np.eye(3)),
            orientation_covariance=np.zeros(9),
            angular_velocity=self.vector(gyro),
            angular_velocity_covariance=np.zeros(9),
            linear_acceleration=self.vector(accel),
            linear_acceleration_covariance=np.zeros(9),
        )
        self.write(topic, "sensor_msgs/msg/Imu", message)

    def image(self, topic: str, stamp_ns: int, image: np.ndarray, **changes: object) -> None:
        height, width = image.shape[:2]
        fields = {
            "header": self.header(stamp_ns),
            "height": height,
            "width": width,
            "encoding": "mono8",
            "is_bigendian": 0,
            "step": width,
            "data": np.ascontiguousarray(image).reshape(-1),
        }
        self.write(topic, bag.RAW_IMAGE, self.make(bag.RAW_IMAGE, **(fields | changes)))

    def compressed(self, topic: str, stamp_ns: int, data: bytes) -> None:
        message = self.make(
            bag.COMPRESSED_IMAGE,
            header=self.header(stamp_ns),
            format="png",
            data=np.frombuffer(data, dtype=np.uint8),
        )
        self.write(topic, bag.COMPRESSED_IMAGE, message)

    def pose(self, stamp_ns: int, T: np.ndarray, kind: str = bag.POSE[0]) -> None:
        point = self.make("geometry_msgs/msg/Point", **dict(zip("xyz", map(float, T[:3, 3]), strict=True)))
        pose = self.make("geometry_msgs/msg/Pose", position=point, orientation=self.rotation(T[:3, :3]))
        fields: dict[str, object]
        if kind.endswith("PoseStamped"):
            fields = {"pose": pose}
        elif kind.endswith("TransformStamped"):
            turned = self.rotation(T[:3, :3])
            transform = self.make("geometry_msgs/msg/Transform", translation=self.vector(T[:3, 3]), rotation=turned)
            fields = {"child_frame_id": "imu", "transform": transform}
        else:
            zero = self.vector(np.zeros(3))
            still = self.make("geometry_msgs/msg/Twist", linear=zero, angular=zero)
            fields = {
                "child_frame_id": "imu",
                "pose": self.make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36)),
                "twist": self.make("geometry_msgs/msg/TwistWithCovariance", twist=still, covariance=np.zeros(36)),
            }
        self.write(TRUTH_TOPIC, kind, self.make(kind, header=self.header(stamp_ns), **fields))


@pytest.fixture(scope="module")
def simulated():
    """A second of stereo, with a camera clock that is off."""
    dataset = SimulatedDataset(
        duration_s=1.0,
        standstill_s=0.0,
        camera=CameraSettings(
            count=2, size_px=[160, 120], rate_hz=10.0, delay_s=DELAY_S, model="equidistant", T_body_cam=None
        ),
        imu=ImuSettings(rate_hz=100.0),
    )
    recording = dataset.open(dataset.sequences[0])
    return SimpleNamespace(
        rig=recording.rig, packets=list(recording.packets()), truth=recording.ground_truth(), name=recording.name
    )


def write_bag(path: Path, kind: str, simulated, *, truth=bag.POSE[0], spoil=None, cameras=CAMERAS) -> Path:
    """A bag of a simulated recording.

    ``spoil(writer, packet)`` may write a packet in its own way and return True.
    """
    with BagWriter(path, kind) as writer:
        if truth:
            for stamp_ns, T in zip(simulated.truth.stamps_ns[::5], simulated.truth.T_world_body[::5], strict=True):
                writer.pose(int(stamp_ns), T, truth)
        for packet in simulated.packets:
            if spoil is not None and spoil(writer, packet):
                continue
            if isinstance(packet, ImuBlock):
                for stamp_ns, gyro, accel in zip(packet.stamps_ns, packet.gyro, packet.accel, strict=True):
                    writer.imu(int(stamp_ns), gyro, accel)
            else:
                for topic, image in zip(cameras, packet.images, strict=False):
                    writer.image(topic, packet.stamp_ns, image)
    return writer.path


def write_calibration(folder: Path, rig) -> dict[str, object]:
    """Kalibr's two files; the topics are in them."""
    folder.mkdir(exist_ok=True)
    noise = {
        "rostopic": IMU_TOPIC,
        "update_rate": rig.imu.rate_hz,
        "gyroscope_noise_density": rig.imu.gyro_noise,
        "gyroscope_random_walk": rig.imu.gyro_walk,
        "accelerometer_noise_density": rig.imu.accel_noise,
        "accelerometer_random_walk": rig.imu.accel_walk,
    }
    chain = {}
    for index, camera in enumerate(rig.cameras):
        chain[f"cam{index}"] = {
            "camera_model": "pinhole",
            "distortion_model": "equidistant",
            "intrinsics": camera.intrinsics_px.tolist(),
            "distortion_coeffs": camera.distortion.tolist(),
            "resolution": list(camera.size_px),
            "rostopic": CAMERAS[index],
            "timeshift_cam_imu": rig.camera_delay_ns / 1e9,
        }
    T_cam_imu = [se3.inverse(camera.T_body_cam) for camera in rig.cameras]
    chain["cam0"]["T_cam_imu"] = T_cam_imu[0].tolist()
    chain["cam1"]["T_cn_cnm1"] = (T_cam_imu[1] @ se3.inverse(T_cam_imu[0])).tolist()
    (folder / "imu.yaml").write_text(yaml.safe_dump(noise))
    (folder / "camchain-imucam.yaml").write_text(yaml.safe_dump(chain))
    return {
        "imu_calibration": str(folder / "imu.yaml"),
        "camera_calibration": str(folder / "camchain-imucam.yaml"),
    }


@pytest.fixture
def options(tmp_path, simulated):
    return write_calibration(tmp_path / "calibration", simulated.rig)


def open_bag(path: Path, **options):
    dataset = BagDataset(root=str(path), **options)
    return dataset.open(dataset.sequences[0])


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
    assert rig.camera_delay_ns == round(DELAY_S * 1e9)
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


def test_ground_truth_of_a_marker_is_moved_to_the_body_and_the_clock_of_the_imu(tmp_path, simulated, options):
    path = write_bag(tmp_path / "walk", "ros1", simulated)
    T_body_truth = se3.from_parts(so3.exp(np.array([0.2, -0.4, 1.0])), np.array([0.1, 0.2, -0.3]))
    truth = open_bag(
        path,
        ground_truth_topic=TRUTH_TOPIC,
        T_body_truth=T_body_truth.tolist(),
        ground_truth_delay_s=-0.02,
        **options,
    ).ground_truth()
    np.testing.assert_allclose(truth.T_world_body @ T_body_truth, simulated.truth.T_world_body[::5], atol=1e-12)
    np.testing.assert_array_equal(truth.stamps_ns, simulated.truth.stamps_ns[::5] - 20_000_000)


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


def spoil_frame(number, write):
    """A ``spoil`` that hands the frame of a number to ``write(writer, frame)``."""
    count = iter(range(10**6))

    def spoil(writer, packet):
        if isinstance(packet, Frame) and next(count) == number:
            write(writer, packet)
            return True
        return False

    return spoil


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


def fields_of(image: np.ndarray, encoding: str, padding: int = 0, big_endian: bool = False) -> SimpleNamespace:
    if image.dtype == np.uint16:
        image = image.astype(">u2" if big_endian else "<u2")
    rows = np.ascontiguousarray(image).view(np.uint8).reshape(image.shape[0], -1)
    padded = np.pad(rows, ((0, 0), (0, padding)), constant_values=99)
    return SimpleNamespace(
        height=image.shape[0],
        width=image.shape[1],
        encoding=encoding,
        is_bigendian=int(big_endian),
        step=padded.shape[1],
        data=padded.reshape(-1),
    )


@pytest.mark.parametrize("padding", [0, 5])
def test_encodings(padding):
    rng = np.random.default_rng(5)
    rgb = rng.integers(0, 256, (4, 6, 3), dtype=np.uint8)
    for encoding, pixels in (("rgb8", rgb), ("bgr8", rgb[..., ::-1])):
        fields = fields_of(pixels, encoding, padding)
        color = messages.image_of(fields, bag.RAW_IMAGE, color=True, mono16_bits=16)
        np.testing.assert_array_equal(color, rgb)
        gray = messages.image_of(fields, bag.RAW_IMAGE, color=False, mono16_bits=16)
        np.testing.assert_array_equal(gray, cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY))
    deep = rng.integers(0, 4096, (4, 6), dtype=np.uint16)
    for big_endian in (False, True):
        fields = fields_of(deep, "mono16", 2 * padding, big_endian)
        np.testing.assert_array_equal(
            messages.image_of(fields, bag.RAW_IMAGE, color=False, mono16_bits=12), (deep >> 4).astype(np.uint8)
        )
        np.testing.assert_array_equal(
            messages.image_of(fields, bag.RAW_IMAGE, color=False, mono16_bits=16), (deep >> 8).astype(np.uint8)
        )
    with pytest.raises(DataError, match="bayer_rggb8"):
        messages.image_of(fields_of(rgb[..., 0], "bayer_rggb8"), bag.RAW_IMAGE, color=False, mono16_bits=16)


def spoil_imu(change):
    """A ``spoil`` that puts every sample through ``change(number, stamp_ns, gyro, accel)``."""
    count = iter(range(10**6))

    def spoil(writer, packet):
        if not isinstance(packet, ImuBlock):
            return False
        for row in zip(packet.stamps_ns, packet.gyro, packet.accel, strict=True):
            writer.imu(*change(next(count), int(row[0]), row[1], row[2]))
        return True

    return spoil


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
    with pytest.raises(DataError, match="160×120 px, but the calibration says 161×120"):
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


def test_euroc_sensor_files(tmp_path):
    """The camera's pose is relative to the IMU, also where the IMU is not the body of the files."""
    T_body_imu = se3.from_parts(so3.exp(np.array([0.1, 0.2, 0.3])), np.array([1.0, 2.0, 3.0]))
    T_body_cam = se3.from_parts(so3.exp(np.array([-1.0, 0.2, 0.5])), np.array([0.1, -0.2, 0.3]))

    def matrix(T):
        return {"rows": 4, "cols": 4, "data": T.ravel().tolist()}

    (tmp_path / "imu.yaml").write_text(
        "%YAML:1.0\n"
        + yaml.safe_dump(
            {
                "T_BS": matrix(T_body_imu),
                "rate_hz": 200,
                "gyroscope_noise_density": 1e-4,
                "gyroscope_random_walk": 1e-5,
                "accelerometer_noise_density": 1e-3,
                "accelerometer_random_walk": 1e-4,
            }
        )
    )
    (tmp_path / "cam0.yaml").write_text(
        yaml.safe_dump(
            {
                "T_BS": matrix(T_body_cam),
                "camera_model": "pinhole",
                "distortion_model": "radial-tangential",
                "distortion_coefficients": [0.1, 0.01, 0.0, 0.0],
                "intrinsics": [400.0, 401.0, 320.0, 240.0],
                "resolution": [640, 480],
            }
        )
    )
    imu = calibration.read_imu(tmp_path / "imu.yaml")
    (one,) = calibration.read_cameras([tmp_path / "cam0.yaml"], imu.T_body_imu)
    assert one.camera.model == "radtan" and one.delay_ns is None and imu.noise.rate_hz == 200.0
    np.testing.assert_allclose(T_body_imu @ one.camera.T_body_cam, T_body_cam, atol=1e-12)


def test_every_option_is_in_the_config():
    path = Path(bag.__file__).parent / "conf" / "dataset" / "bag.yaml"
    assert set(yaml.safe_load(path.read_text())) - {"_target_"} == set(inspect.signature(BagDataset).parameters)
