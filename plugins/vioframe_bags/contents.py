"""What one pass through a bag collects: everything but the pixels."""

import array
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from vioframe.checks import Stamps
from vioframe.errors import ClockError, DataError
from vioframe.types import ImuBlock
from vioframe_bags.bag import Bag
from vioframe_bags.messages import imu_row, pose_of


@dataclass(slots=True)
class Contents:
    """What one pass through the bag collects.

    Attributes:
        imu_stamps_ns, imu_rows: of all inertial samples; six numbers a row.
        frame_stamps_ns: by camera, in the order of recording.
        imu_before: by camera and image, the number of inertial samples recorded before it.
        truth_stamps_ns, truth_rows: of all true poses; position and quaternion w, x, y, z.
    """

    imu_stamps_ns: "array.array[int]" = field(default_factory=lambda: array.array("q"))
    imu_rows: "array.array[float]" = field(default_factory=lambda: array.array("d"))
    frame_stamps_ns: "list[array.array[int]]" = field(default_factory=list)
    imu_before: "list[array.array[int]]" = field(default_factory=list)
    truth_stamps_ns: "array.array[int]" = field(default_factory=lambda: array.array("q"))
    truth_rows: "array.array[float]" = field(default_factory=lambda: array.array("d"))

    def imu_block(self, where: str) -> ImuBlock:
        """All inertial samples.

        Raises:
            DataError: too few, out of order, or not finite.
        """
        stamps_ns = np.array(self.imu_stamps_ns, dtype=np.int64)
        values = np.array(self.imu_rows).reshape(-1, 6)
        if len(stamps_ns) < 10:
            raise DataError(f"{where}: {len(stamps_ns)} samples are too few for a recording: record the bag again")
        check_order(stamps_ns, where)
        bad = ~np.isfinite(values).all(axis=1)
        if bad.any():
            raise DataError(
                f"{where}: the sample at stamp {int(stamps_ns[np.argmax(bad)])} is not finite ({int(bad.sum())} such "
                "samples): filter them out of the bag"
            )
        return ImuBlock(stamps_ns=stamps_ns, gyro=values[:, :3].copy(), accel=values[:, 3:].copy())

    def image_stamps(self, topics: Sequence[str], where: str) -> list[Stamps]:
        """Stamps of all images by camera.

        Raises:
            ClockError: out of order.
        """
        all_stamps_ns = [np.array(stamps, dtype=np.int64) for stamps in self.frame_stamps_ns]
        for topic, stamps_ns in zip(topics, all_stamps_ns, strict=True):
            check_order(stamps_ns, f"{where}: {topic}")
        return all_stamps_ns


def collect(bag: Bag, imu_topic: str, topics: list[str], truth_topic: str | None) -> Contents:
    """Read the bag through once; images are passed over but for their stamps."""
    contents = Contents(
        frame_stamps_ns=[array.array("q") for _ in topics], imu_before=[array.array("q") for _ in topics]
    )
    cameras = {topic: index for index, topic in enumerate(topics)}
    for message in bag.read({imu_topic, *topics} | ({truth_topic} if truth_topic else set())):
        if message.topic == imu_topic:
            contents.imu_stamps_ns.append(message.stamp_ns)
            contents.imu_rows.extend(imu_row(message.decode()))
        elif message.topic in cameras:
            camera = cameras[message.topic]
            contents.frame_stamps_ns[camera].append(message.stamp_ns)
            contents.imu_before[camera].append(len(contents.imu_stamps_ns))
        else:
            position, quat_wxyz = pose_of(message.decode())
            contents.truth_stamps_ns.append(message.stamp_ns)
            contents.truth_rows.extend((*position, *quat_wxyz))
    return contents


def check_order(stamps_ns: Stamps, where: str) -> None:
    """Refuse header stamps that repeat or go back.

    Args:
        stamps_ns: (N,) in the order of recording.
        where: bag and topic.

    Raises:
        ClockError: with the first offending message and both stamps.
    """
    steps = np.diff(stamps_ns)
    if not len(steps) or steps.min() > 0:
        return
    index = int(np.argmax(steps <= 0))
    before, after = int(stamps_ns[index]), int(stamps_ns[index + 1])
    how = "repeats the one before" if before == after else "is earlier than the one before"
    advice = "the driver does not fill in header.stamp" if not after else "drop or sort such messages"
    raise ClockError(
        f"{where}: the header stamp {after} ns of message {index + 2} {how} ({before} ns): {advice}; record or filter "
        "the bag anew"
    )
