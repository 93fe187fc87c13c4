"""Bags written from a recording, in every format, with whatever is to be wrong about them."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from vioframe.geometry import quaternion, se3
from vioframe.types import Frame, ImuBlock

pytest.importorskip("rosbags", reason="rosbags is not installed (pip install 'vioframe[bags]')")

from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from vioframe_bags import BagDataset, bag

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


def open_bag(path: Path, **options):
    dataset = BagDataset(root=str(path), **options)
    return dataset.open(dataset.sequences[0])


def spoil_frame(number, write):
    """A ``spoil`` that hands the frame of a number to ``write(writer, frame)``."""
    count = iter(range(10**6))

    def spoil(writer, packet):
        if isinstance(packet, Frame) and next(count) == number:
            write(writer, packet)
            return True
        return False

    return spoil


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
