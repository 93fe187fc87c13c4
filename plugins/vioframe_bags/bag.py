"""One bag on disk, whatever its format: topics, and messages in the order in which they were recorded."""

import struct
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vioframe.errors import ConfigError, DataError

IMU = ("sensor_msgs/msg/Imu",)
RAW_IMAGE, COMPRESSED_IMAGE = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
IMAGE = (RAW_IMAGE, COMPRESSED_IMAGE)
POSE = ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/TransformStamped", "nav_msgs/msg/Odometry")


@dataclass(frozen=True, slots=True, kw_only=True)
class Topic:
    """Type of a topic's messages, as ROS 2 writes it (``sensor_msgs/msg/Imu``), and their number."""

    kind: str
    count: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Message:
    """One message; nothing but its header stamp is decoded until it is asked for.

    Attributes:
        topic: where it was published.
        kind: type of the message.
        stamp_ns: of the header, by the sensor's clock; never the time of recording.
        decode: gives the message's fields, or raises ``DataError``.
    """

    topic: str
    kind: str
    stamp_ns: int
    decode: Callable[[], Any]


class Bag:
    """A ROS 1 file, a ROS 2 folder, or a bare MCAP or SQLite file; opened anew for each pass.

    Raises:
        ConfigError: rosbags is not installed.
        DataError: it cannot be opened, or holds nothing.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with self._reader() as reader:
            self.topics: dict[str, Topic] = {
                name: Topic(kind=str(info.msgtype or "several types"), count=int(info.msgcount))
                for name, info in reader.topics.items()
            }
        if not sum(topic.count for topic in self.topics.values()):
            raise DataError(f"{path}: the bag holds no messages: record or fetch it again")

    def require(self, topic: str, kinds: Collection[str], option: str) -> None:
        """Refuse a topic that is not there, is empty, or has messages of another type.

        Raises:
            DataError: names the option, and the topics that would do.
        """
        found = self.topics.get(topic)
        if found is None or found.kind not in kinds:
            fitting = [name for name, other in self.topics.items() if other.kind in kinds]
            others = ", ".join(f"{name} ({other.kind})" for name, other in sorted(self.topics.items()))
            what = "is not in the bag" if found is None else f"has messages of type {found.kind}"
            advice = f"set it to {' or '.join(sorted(fitting))}" if fitting else f"the bag's topics are {others}"
            raise DataError(f"{self.path}: {option}={topic} {what}, but {' or '.join(kinds)} is needed: {advice}")
        if not found.count:
            raise DataError(f"{self.path}: {option}={topic} has no messages: record the bag again, or change the topic")

    def read(self, topics: Collection[str]) -> Iterator[Message]:
        """Messages of these topics in the order of recording, one at a time.

        Raises:
            DataError: the file is damaged, with how far it could be read.
        """
        done = 0
        with self._reader() as reader:
            wanted = [connection for connection in reader.connections if connection.topic in topics]
            messages = reader.messages(wanted)
            while True:
                try:
                    connection, _, data = next(messages)
                    stamp_ns = header_stamp(data, ros2=reader.is2)
                except StopIteration:
                    return
                except Exception as error:
                    # A damaged file surfaces as whatever the decompressor, sqlite or struct raises.
                    raise DataError(
                        f"{self.path}: damaged after {done} messages ({_first_line(error)}): fetch the bag again"
                    ) from error
                done += 1
                yield Message(
                    topic=connection.topic,
                    kind=connection.msgtype,
                    stamp_ns=stamp_ns,
                    decode=_decoder(self.path, reader, connection, data, stamp_ns),
                )

    @contextmanager
    def _reader(self) -> Iterator[Any]:
        try:
            from rosbags.highlevel import AnyReader
            from rosbags.typesys import Stores, get_typestore
        except ImportError as error:
            raise ConfigError(
                "dataset=bag needs the package rosbags, which is not installed: pip install 'vioframe[bags]'"
            ) from error
        try:
            # SQLite bags written before ROS 2 Iron do not hold the definitions of their messages.
            reader = AnyReader([self.path], default_typestore=get_typestore(Stores.LATEST))
            reader.open()
        except Exception as error:
            # As in read(): a file that is no bag can make the reader raise anything.
            raise DataError(
                f"{self.path}: cannot be opened as a bag ({_first_line(error)}): fetch it again, or reindex it if its "
                "recording was cut short"
            ) from error
        try:
            yield reader
        finally:
            reader.close()


def _decoder(path: Path, reader: Any, connection: Any, data: bytes, stamp_ns: int) -> Callable[[], Any]:
    def decode() -> Any:
        try:
            return reader.deserialize(data, connection.msgtype)
        except Exception as error:
            raise DataError(
                f"{path}: the message of {connection.topic} at stamp {stamp_ns} cannot be decoded "
                f"({_first_line(error)}): fetch the bag again"
            ) from error

    return decode


def header_stamp(data: bytes, *, ros2: bool) -> int:
    """Stamp in ns of a message that begins with ``std_msgs/Header``, without decoding the rest.

    ROS 1 writes seq, secs, nsecs as little-endian uint32; ROS 2 four bytes that tell the byte order (CDR
    encapsulation), then sec as int32 and nanosec as uint32.
    """
    if ros2:
        sec, nanosec = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4)
    else:
        _, sec, nanosec = struct.unpack_from("<III", data, 0)
    return int(sec) * 1_000_000_000 + int(nanosec)


def _first_line(error: BaseException) -> str:
    text = str(error).strip()
    return text.splitlines()[0][:200] if text else type(error).__name__
