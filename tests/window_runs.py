"""Recorded measurements of a sequence as a batch of training windows, so that both can be held against each other."""

import numpy as np

from vioframe.data.windows import PairAnswers, TrainingWindow
from vioframe.geometry import se3
from vioframe.learning.batch import WindowBatch, collate
from vioframe.types import Measurement, SensorRig, Trajectory


def window_of(measurements: list[Measurement], truth: Trajectory, rig: SensorRig, *, answers: bool = True):
    """One training window of consecutive measurements, with what the VO answered for its pairs."""
    stamps_ns = np.array(
        [measurements[0].window.previous.stamp_ns, *(each.window.current.stamp_ns for each in measurements)]
    )
    places = np.searchsorted(truth.stamps_ns, stamps_ns)
    T_world_body = truth.T_world_body[places]
    T_body_cam = rig.cameras[0].T_body_cam
    T_world_cam = T_world_body @ T_body_cam
    back = T_world_body[:, :3, :3].transpose(0, 2, 1)
    imu, imu_time_s = [], []
    for each in measurements:
        block = each.window.imu
        imu.append(np.concatenate([block.gyro, block.accel], axis=1))
        imu_time_s.append((block.stamps_ns - each.window.previous.stamp_ns) * 1e-9)
    poses = [each.relative_pose for each in measurements]
    vo = None
    if answers:
        vo = PairAnswers(
            T_prev_cur=np.array([np.eye(4) if p is None or not p.valid else p.T_prev_cur for p in poses]),
            covariance=np.array(
                [np.zeros((6, 6)) if p is None or p.covariance is None else p.covariance for p in poses]
            ),
            valid=np.array([p is not None and p.valid for p in poses]),
        )
    return TrainingWindow(
        images=np.zeros((len(stamps_ns), 0, 0, 1), dtype=np.uint8),
        stamps_ns=stamps_ns,
        T_prev_cur=se3.inverse(T_world_cam[:-1]) @ T_world_cam[1:],
        imu=tuple(imu),
        imu_time_s=tuple(imu_time_s),
        intrinsics_px=rig.cameras[0].intrinsics_px,
        T_body_cam=T_body_cam,
        gravity=rig.gravity,
        velocity_body=(back @ truth.v_world_body[places][:, :, None])[:, :, 0],
        gravity_body=back @ np.array([0.0, 0.0, -rig.gravity]),
        vo=vo,
    )


def batch_of(windows: list[TrainingWindow]) -> WindowBatch:
    """A batch with images in [0, 1]."""
    return collate(windows).as_float()


def upstream_of(batch: WindowBatch):
    """What the training module starts with where a VO has answered beforehand."""
    return {"T_prev_cur": batch.vo.T_prev_cur, "covariance": batch.vo.covariance, "valid": batch.vo.valid}
