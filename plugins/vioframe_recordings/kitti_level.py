"""Which way is up in a KITTI drive, whose poses are given in the frame of its first image."""

from dataclasses import replace

import numpy as np

from vioframe.checks import Array, Stamps
from vioframe.data import agreement
from vioframe.data.recording import Finding
from vioframe.errors import DataError
from vioframe.geometry import se3, so3
from vioframe.types import ImuBlock, Trajectory
from vioframe_recordings.kitti_calibration import spline_velocities


def check_vehicle_up(imu: ImuBlock, where: str) -> Finding:
    """A car stays upright: the mean specific force must be +g along the vehicle's z.

    Raises:
        DataError: it is not; axes or columns are swapped.
    """
    force = imu.accel.mean(axis=0)
    tilt = agreement.tilt_deg(force)
    if tilt > agreement.TILT_BAD_DEG:
        raise DataError(
            f"{where}: the mean specific force is ({force[0]:.2f}, {force[1]:.2f}, {force[2]:.2f}) m/s², {tilt:.0f}° "
            "from the vehicle's z axis, but a car stays upright: columns or axes are swapped; put them right"
        )
    text = f"mean specific force {force[2]:.2f} m/s² along the vehicle's z, {tilt:.1f}° off (banked and crowned road)"
    return Finding(level="good", subject="vehicle upright", text=text)


def check_level(imu: ImuBlock, truth: Trajectory) -> Finding:
    """Whether both halves of a recording agree on the vertical, which one average over both cannot tell."""
    middle = len(truth) // 2
    tilts = []
    for part in (slice(None, middle), slice(middle, None)):
        half = Trajectory(stamps_ns=truth.stamps_ns[part], T_world_body=truth.T_world_body[part])
        if truth.v_world_body is not None:
            half = replace(half, v_world_body=truth.v_world_body[part])
        tilts.append(agreement.tilt_deg(agreement.mean_specific_force(imu, half)[0]))
    text = f"the halves of the recording put the vertical {tilts[0]:.2f}° and {tilts[1]:.2f}° off the whole"
    return Finding(level="good" if max(tilts) < 1.0 else "note", subject="level of the world", text=text)


def level_world(stamps_ns: Stamps, T_ref_body: Array, imu: ImuBlock) -> tuple[Trajectory, float]:
    """Turn poses in any fixed frame into poses in a world with z up.

    Up is the specific force averaged over all samples in the true attitude, less the mean acceleration
    of the body: ``u = (1/T) ∫ R_ref_body a dt − (v(T) − v(0)) / T``. KITTI's odometry poses start with
    camera 0, which looks up or down by a degree or so. The heading is free: the body starts along x.

    Args:
        stamps_ns: (N,) of the poses, IMU clock.
        T_ref_body: (N, 4, 4).
        imu: samples that cover most of the poses.

    Returns:
        The trajectory with velocities, starting at the origin, and the magnitude of u in m/s².
    """
    velocity = spline_velocities(stamps_ns, T_ref_body[:, :3, 3])
    reference = Trajectory(stamps_ns=stamps_ns, T_world_body=T_ref_body, v_world_body=velocity)
    up, _ = agreement.mean_specific_force(imu, reference)
    return _turn_up(reference, velocity, up), float(np.linalg.norm(up))


def level_by_vehicle(stamps_ns: Stamps, T_ref_body: Array) -> Trajectory:
    """The same without inertial samples: up is the mean of the vehicle's z axis, which a car keeps upright.

    It is that of the road on average, not of gravity: a drive that only climbs comes out as flat.

    Args:
        stamps_ns: (N,) of the poses.
        T_ref_body: (N, 4, 4).
    """
    velocity = spline_velocities(stamps_ns, T_ref_body[:, :3, 3])
    reference = Trajectory(stamps_ns=stamps_ns, T_world_body=T_ref_body, v_world_body=velocity)
    return _turn_up(reference, velocity, T_ref_body[:, :3, 2].mean(axis=0))


def _turn_up(reference: Trajectory, v_ref_body: Array, up: Array) -> Trajectory:
    """Turn the z axis of the world to ``up`` (3,), x to where the body looks first, and begin at the origin."""
    T_ref_body = reference.T_world_body
    R_level_ref = so3.from_two_vectors(up, np.array([0.0, 0.0, 1.0]))
    heading = R_level_ref @ T_ref_body[0, :3, 0]
    R_world_ref = so3.rotation_z(-np.arctan2(heading[1], heading[0])) @ R_level_ref
    T_world_ref = se3.from_parts(R_world_ref, -R_world_ref @ T_ref_body[0, :3, 3])
    return Trajectory(
        stamps_ns=reference.stamps_ns,
        T_world_body=T_world_ref @ T_ref_body,
        v_world_body=v_ref_body @ R_world_ref.T,
    )
