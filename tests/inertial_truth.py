"""A motion with exact derivatives, and what an ideal inertial sensor reads along it."""

from dataclasses import dataclass

import numpy as np

from vioframe.conventions import NANOSECONDS, gravity_vector
from vioframe.geometry import se3, so3
from vioframe.types import Frame, ImuBlock, ImuNoise, SensorRig, SyncedWindow

NOISE = ImuNoise(gyro_noise=1.7e-4, gyro_walk=2e-5, accel_noise=2e-3, accel_walk=3e-3, rate_hz=200.0)
QUIET = ImuNoise(gyro_noise=0.0, gyro_walk=0.0, accel_noise=0.0, accel_walk=0.0, rate_hz=200.0)


def make_rig(noise: ImuNoise = NOISE, camera_delay_ns: int = 0) -> SensorRig:
    """A rig without cameras, for parts that see inertial samples and stamps only."""
    return SensorRig(cameras=(), imu=noise, gravity=9.81, camera_delay_ns=camera_delay_ns)


@dataclass(frozen=True)
class Truth:
    """Poses (N, 4, 4), velocities (N, 3) in the world, body rates (N, 3) and specific forces (N, 3)."""

    T_world_body: np.ndarray
    velocity: np.ndarray
    gyro: np.ndarray
    accel: np.ndarray


def motion(t: np.ndarray, gravity: float = 9.81) -> Truth:
    """A brisk tumble at times (N,) s: yaw–pitch–roll angles and a position, each a sine with its derivatives.

    The body rate of R = Rz(yaw) Ry(pitch) Rx(roll) is ω = e_x roll' + Rxᵀ e_y pitch' + (Ry Rx)ᵀ e_z yaw'.
    """
    t = np.atleast_1d(np.asarray(t, dtype=float))
    zero = np.zeros_like(t)
    yaw, yaw_rate = 0.8 * np.sin(1.3 * t), 1.04 * np.cos(1.3 * t)
    pitch, pitch_rate = 0.5 * np.sin(1.7 * t + 0.3), 0.85 * np.cos(1.7 * t + 0.3)
    roll, roll_rate = 0.6 * np.cos(1.1 * t), -0.66 * np.sin(1.1 * t)
    Rz = so3.exp(np.stack([zero, zero, yaw], axis=-1))
    Ry = so3.exp(np.stack([zero, pitch, zero], axis=-1))
    Rx = so3.exp(np.stack([roll, zero, zero], axis=-1))
    R = Rz @ Ry @ Rx
    gyro = (
        np.stack([roll_rate, zero, zero], axis=-1)
        + np.einsum("nji,nj->ni", Rx, np.stack([zero, pitch_rate, zero], axis=-1))
        + np.einsum("nji,nj->ni", Ry @ Rx, np.stack([zero, zero, yaw_rate], axis=-1))
    )
    position = np.stack([2 * np.sin(0.9 * t), 1.5 * np.cos(1.4 * t), 0.7 * np.sin(2 * t)], axis=-1)
    velocity = np.stack([1.8 * np.cos(0.9 * t), -2.1 * np.sin(1.4 * t), 1.4 * np.cos(2 * t)], axis=-1)
    acceleration = np.stack([-1.62 * np.sin(0.9 * t), -2.94 * np.cos(1.4 * t), -2.8 * np.sin(2 * t)], axis=-1)
    accel = np.einsum("nji,nj->ni", R, acceleration - gravity_vector(gravity))
    return Truth(T_world_body=se3.from_parts(R, position), velocity=velocity, gyro=gyro, accel=accel)


def exact_increment(start_s: float, end_s: float, gravity: float = 9.81) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """ΔR, Δv, Δp that the true states imply (Forster et al. 2017, eq. 33)."""
    truth = motion(np.array([start_s, end_s]), gravity)
    T, g = end_s - start_s, gravity_vector(gravity)
    R, p, v = truth.T_world_body[:, :3, :3], truth.T_world_body[:, :3, 3], truth.velocity
    back = R[0].T
    return back @ R[1], back @ (v[1] - v[0] - g * T), back @ (p[1] - p[0] - v[0] * T - 0.5 * g * T * T)


def samples(stamps_ns: np.ndarray, gravity: float = 9.81) -> ImuBlock:
    """What an ideal sensor reads at the stamps."""
    truth = motion(stamps_ns / NANOSECONDS, gravity)
    return ImuBlock(stamps_ns=stamps_ns, gyro=truth.gyro, accel=truth.accel)


def even_stamps(start_s: float, end_s: float, steps: int) -> np.ndarray:
    """``steps + 1`` stamps, ns, evenly from start to end."""
    return np.round(np.linspace(start_s, end_s, steps + 1) * NANOSECONDS).astype(np.int64)


def window_of(imu: ImuBlock, gap_ns: int | None = None) -> SyncedWindow:
    """A window that these samples fill exactly."""
    steps = np.diff(imu.stamps_ns)
    return SyncedWindow(
        previous=Frame(stamp_ns=int(imu.stamps_ns[0])),
        current=Frame(stamp_ns=int(imu.stamps_ns[-1])),
        imu=imu,
        gap_ns=int(steps.max()) if gap_ns is None else gap_ns,
    )


def windows_of(imu: ImuBlock, every: int) -> list[SyncedWindow]:
    """Windows of ``every`` steps that share their end samples."""
    out = []
    for first in range(0, len(imu) - every, every):
        part = slice(first, first + every + 1)
        out.append(window_of(ImuBlock(stamps_ns=imu.stamps_ns[part], gyro=imu.gyro[part], accel=imu.accel[part])))
    return out
