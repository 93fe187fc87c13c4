"""A body that moves through a cloud of points along analytic curves: exact inertial samples, exact rays."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from vioframe.geometry import camera as projection
from vioframe.geometry import se3, so3
from vioframe.types import (
    Camera,
    Frame,
    ImuBlock,
    ImuNoise,
    Measurement,
    SensorRig,
    SyncedWindow,
    Tracks,
    VisualFeatures,
)

GRAVITY = 9.81
IMU_HZ, IMAGE_HZ = 200, 20
R_BODY_CAM = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]) @ so3.exp(np.array([0.05, -0.03, 0.02]))


def rig(cameras: int = 1) -> SensorRig:
    """A rig that looks along the body's x axis, with a second camera 12 cm to the right of the first."""
    made = []
    for index in range(cameras):
        T_body_cam = se3.from_parts(R_BODY_CAM, np.array([0.06, 0.02, 0.01]) + R_BODY_CAM @ [0.12 * index, 0.0, 0.0])
        made.append(
            Camera(
                model="pinhole",
                intrinsics_px=np.array([400.0, 400.0, 319.5, 239.5]),
                size_px=(640, 480),
                T_body_cam=T_body_cam,
            )
        )
    noise = ImuNoise(gyro_noise=1.7e-4, gyro_walk=2e-5, accel_noise=2e-3, accel_walk=3e-3, rate_hz=float(IMU_HZ))
    return SensorRig(cameras=tuple(made), imu=noise, gravity=GRAVITY)


@dataclass(frozen=True, kw_only=True)
class Scene:
    """What moves how, and what is wrong with it.

    Attributes:
        turn: rad, amplitude of the rotation about each axis.
        sway: m, amplitude of the translation along each axis.
        speed: (3,) m/s, constant velocity on top.
        points: how many the camera follows at most.
        pixel_noise: px.
        gyro_bias, accel_bias: (3,).
        delay_s: the images show what was this much earlier than stamped.
        noise: whether the inertial samples are noisy, as the rig states.
        cameras: of the rig.
        seed: of everything random.
    """

    turn: float = 0.35
    sway: float = 0.5
    speed: tuple[float, float, float] = (0.1, 0.3, 0.0)
    points: int = 120
    pixel_noise: float = 0.2
    gyro_bias: tuple[float, float, float] = (0.01, -0.02, 0.05)
    accel_bias: tuple[float, float, float] = (0.03, 0.05, -0.04)
    delay_s: float = 0.0
    noise: bool = True
    cameras: int = 1
    seed: int = 0

    def pose(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """R_world_body (N, 3, 3) and p (N, 3) at times (N,) s."""
        phi, _ = self._turned(t)
        p, _, _ = self._moved(t)
        return so3.exp(phi), p

    def velocity(self, t: np.ndarray) -> np.ndarray:
        """(N, 3) m/s in the world."""
        return self._moved(t)[1]

    def _turned(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rates, phases = np.array([1.9, 1.4, 1.1]), np.array([0.3, 1.2, 2.1])
        angle = rates * t[:, None] + phases
        return self.turn * np.sin(angle), self.turn * rates * np.cos(angle)

    def _moved(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        rates, phases = np.array([1.3, 1.7, 2.3]), np.array([0.1, 0.9, 2.0])
        angle = rates * t[:, None] + phases
        p = self.sway * np.sin(angle) + np.array(self.speed) * t[:, None]
        return p, self.sway * rates * np.cos(angle) + self.speed, -self.sway * rates**2 * np.sin(angle)

    def imu(self, duration_s: float) -> ImuBlock:
        """Samples from 0 to ``duration_s``."""
        rng = np.random.default_rng(self.seed + 1)
        stamps_ns = np.arange(0, round(duration_s * IMU_HZ) + 1) * (10**9 // IMU_HZ)
        t = stamps_ns * 1e-9
        phi, rate = self._turned(t)
        R = so3.exp(phi)
        gyro = (so3.right_jacobian(phi) @ rate[..., None])[..., 0] + self.gyro_bias
        force = self._moved(t)[2] + np.array([0.0, 0.0, GRAVITY])
        accel = (R.swapaxes(1, 2) @ force[..., None])[..., 0] + self.accel_bias
        if self.noise:
            noise = rig().imu
            gyro += noise.gyro_noise * np.sqrt(IMU_HZ) * rng.normal(size=gyro.shape)
            accel += noise.accel_noise * np.sqrt(IMU_HZ) * rng.normal(size=accel.shape)
        return ImuBlock(stamps_ns=stamps_ns, gyro=gyro, accel=accel)

    def measurements(self, duration_s: float, imu: ImuBlock | None = None) -> Iterator[Measurement]:
        """One measurement an image; other inertial samples may be given, on the same clock."""
        imu = imu or self.imu(duration_s)
        rng = np.random.default_rng(self.seed)
        cloud = rng.uniform([-7.0, -7.0, -3.0], [7.0, 7.0, 4.0], size=(6000, 3))
        cloud = cloud[np.linalg.norm(cloud, axis=1) > 2.5]
        step_ns = 10**9 // IMAGE_HZ
        followed: np.ndarray = np.zeros(0, dtype=np.int64)
        for index in range(1, round(duration_s * IMAGE_HZ) + 1):
            start, end = (index - 1) * step_ns, index * step_ns
            window = SyncedWindow(
                previous=Frame(stamp_ns=start), current=Frame(stamp_ns=end), imu=_cut(imu, start, end), gap_ns=0
            )
            tracks, followed = self._see(cloud, followed, end * 1e-9 - self.delay_s, rng)
            features = VisualFeatures(frame=window.current, tracks=tracks[0], stereo=(*tracks, None)[1])
            yield Measurement(window=window, features=features)

    def _see(
        self, cloud: np.ndarray, followed: np.ndarray, t: float, rng: np.random.Generator
    ) -> tuple[list[Tracks], np.ndarray]:
        R, p = self.pose(np.array([t]))
        found: list[Tracks] = []
        for index, camera in enumerate(rig(self.cameras).cameras):
            T_world_cam = se3.from_parts(R[0], p[0]) @ camera.T_body_cam
            in_cam = (cloud - T_world_cam[:3, 3]) @ T_world_cam[:3, :3]
            pixels, visible = projection.project(camera, in_cam)
            visible &= in_cam[:, 2] > 0.5
            if index == 0:
                kept = followed[visible[followed]]
                others = np.setdiff1d(np.flatnonzero(visible), kept)
                new = rng.permutation(others)[: max(self.points - len(kept), 0)]
                ids = followed = np.sort(np.concatenate([kept, new]).astype(np.int64))
            else:
                ids = followed[visible[followed]]
            noisy = pixels[ids] + self.pixel_noise * rng.normal(size=(len(ids), 2))
            found.append(
                Tracks(
                    ids=ids,
                    pixels=noisy,
                    bearings=projection.bearings(camera, noisy),
                    scores=np.ones(len(ids)),
                    camera=index,
                )
            )
        return found, followed


def _cut(imu: ImuBlock, start: int, end: int) -> ImuBlock:
    """Samples from ``start`` to ``end``, interpolated at both."""
    inside = (imu.stamps_ns > start) & (imu.stamps_ns < end)
    stamps_ns = np.concatenate([[start], imu.stamps_ns[inside], [end]])

    def at(values: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(stamps_ns, imu.stamps_ns, column) for column in values.T], axis=1)

    return ImuBlock(stamps_ns=stamps_ns, gyro=at(imu.gyro), accel=at(imu.accel))


def turned_rig(angle_deg: float, axis: tuple[float, float, float]) -> SensorRig:
    """The rig with a camera that is calibrated wrongly: turned about an axis of its own."""
    good = rig()
    T_body_cam = good.cameras[0].T_body_cam.copy()
    T_body_cam[:3, :3] = T_body_cam[:3, :3] @ so3.exp(np.radians(angle_deg) * np.array(axis))
    return replace(good, cameras=(replace(good.cameras[0], T_body_cam=T_body_cam),))
