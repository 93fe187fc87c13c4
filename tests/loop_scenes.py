"""A world of points that look like nothing else, and a body that walks around in it: keyframes without pictures."""

from dataclasses import dataclass

import numpy as np

from vioframe.checks import Array
from vioframe.geometry import camera as projection
from vioframe.geometry import se3, so3
from vioframe.types import Camera, ImuNoise, SensorRig, Tracks
from vioframe_window.loop_interface import LoopKeyframe

STEP_NS = 250_000_000
"""Between keyframes."""
CAMERA = Camera(
    model="pinhole",
    intrinsics_px=np.array([400.0, 400.0, 319.5, 239.5]),
    size_px=(640, 480),
    # The camera looks along the body's x axis.
    T_body_cam=se3.from_parts(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([0.1, 0, 0])),
)
RIG = SensorRig(
    cameras=(CAMERA,),
    imu=ImuNoise(gyro_noise=1e-4, gyro_walk=1e-5, accel_noise=1e-3, accel_walk=1e-4, rate_hz=200.0),
)
NO_IMAGE = np.zeros((480, 640), np.uint8)

_FLIPPED_BITS = 12
_NOISE_PX = 0.4
_RANGE_M = 9.0
_MOST = 110


@dataclass(frozen=True, kw_only=True, eq=False)
class PointWorld:
    """Points (N, 3) m and their descriptors (N, 32)."""

    points: Array
    descriptors: np.ndarray

    @staticmethod
    def around(path: Array, seed: int, *, per_place: int = 40) -> "PointWorld":
        """Points within some metres of a path (M, 4, 4)."""
        rng = np.random.default_rng(seed)
        centres = path[::4, :3, 3]
        spread = rng.uniform((-5.0, -5.0, -1.5), (5.0, 5.0, 1.5), (len(centres) * per_place, 3))
        points = np.repeat(centres, per_place, axis=0) + spread
        descriptors = rng.integers(0, 256, (len(points), 32), dtype=np.uint8)
        return PointWorld(points=points, descriptors=descriptors)

    def keyframe(self, index: int, T_true_body: Array, T_world_body: Array, rng: np.random.Generator) -> LoopKeyframe:
        """What a body sees from a true pose that its odometry holds for another; track ids are never seen again."""
        T_cam_true = se3.inverse(T_true_body @ CAMERA.T_body_cam)
        seen = se3.transform(T_cam_true, self.points)
        pixels, visible = projection.project(CAMERA, seen)
        rows = np.flatnonzero(visible & (seen[:, 2] > 0.5) & (seen[:, 2] < _RANGE_M))
        rows = rng.permutation(rows)[:_MOST]
        noisy = pixels[rows] + _NOISE_PX * rng.standard_normal((len(rows), 2))
        bits = np.unpackbits(self.descriptors[rows], axis=1)
        for row in bits:
            row[rng.choice(256, _FLIPPED_BITS, replace=False)] ^= 1
        ids = np.arange(len(rows), dtype=np.int64) + 1000 * index
        landmarks = se3.transform(T_world_body @ se3.inverse(T_true_body), self.points[rows])
        return LoopKeyframe(
            stamp_ns=index * STEP_NS,
            T_world_body=T_world_body,
            image=NO_IMAGE,
            tracks=Tracks(
                ids=ids,
                pixels=noisy,
                bearings=projection.bearings(CAMERA, noisy),
                scores=np.ones(len(rows)),
                descriptors=np.packbits(bits, axis=1),
            ),
            landmark_ids=ids,
            landmarks_world=landmarks + 0.01 * rng.standard_normal(landmarks.shape),
        )


def circle(laps: float, *, radius: float = 8.0, step_m: float = 0.3) -> Array:
    """Poses (N, 4, 4) of a walk around a circle, looking ahead, nodding a little."""
    count = round(laps * 2.0 * np.pi * radius / step_m)
    angle = np.arange(count) * step_m / radius
    position = np.stack([radius * np.cos(angle), radius * np.sin(angle), 1.5 + 0.1 * np.sin(3.0 * angle)], axis=1)
    zero = np.zeros(count)
    nod = so3.exp(np.stack([zero, 0.05 * np.sin(5.0 * angle), zero], axis=1))
    return se3.from_parts(so3.rotation_z(angle + 0.5 * np.pi) @ nod, position)


def drifted(path: Array, *, yaw_deg: float, scale: float, climb_m: float) -> Array:
    """The same walk as an odometry has it that turns a little too far, and climbs, with every step."""
    steps = se3.inverse(path[:-1]) @ path[1:]
    poses = [path[0]]
    turn = so3.rotation_z(np.radians(yaw_deg))
    for step in steps:
        last = poses[-1]
        moved = last[:3, 3] + scale * (last[:3, :3] @ step[:3, 3]) + (0.0, 0.0, climb_m)
        poses.append(se3.from_parts(turn @ last[:3, :3] @ step[:3, :3], moved))
    return np.array(poses)
