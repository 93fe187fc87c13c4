"""Simulated recordings with what a VO answered: as measurements of a stream, and as windows of training."""

import numpy as np

from filter_runs import FilterRun
from vioframe.data.simulator import SimulatedRecording
from vioframe.data.windows import PairAnswers, StoredSequence, cut_window
from vioframe.learning.batch import WindowBatch, collate
from vioframe.types import ImuBlock


def stored(recording: SimulatedRecording, run: FilterRun) -> StoredSequence:
    """The measurements of a run as a recording for training, without images."""
    windows = [each.window for each in run.measurements]
    stamps = np.array([windows[0].previous.stamp_ns, *(window.current.stamp_ns for window in windows)])
    poses = [each.relative_pose for each in run.measurements]
    samples = {}
    for window in windows:
        for stamp, gyro, accel in zip(window.imu.stamps_ns, window.imu.gyro, window.imu.accel, strict=True):
            samples[int(stamp)] = np.concatenate([gyro, accel])
    values = np.array(list(samples.values()))
    camera = recording.rig.cameras[0]
    zero = np.zeros((6, 6))
    return StoredSequence(
        name=recording.name,
        images=np.zeros((len(stamps), 0, 0, 1), dtype=np.uint8),
        stamps_ns=stamps,
        T_world_cam=np.stack([run.true_pose(stamp) for stamp in stamps]) @ camera.T_body_cam,
        known=np.ones(len(stamps), dtype=np.bool_),
        imu=ImuBlock(stamps_ns=np.array(list(samples)), gyro=values[:, :3], accel=values[:, 3:]),
        camera=camera,
        gravity=recording.rig.gravity,
        truth=run.truth,
        vo=PairAnswers(
            T_prev_cur=np.stack([pose.T_prev_cur for pose in poses]),
            covariance=np.stack([zero if pose.covariance is None else pose.covariance for pose in poses]),
            valid=np.array([pose.valid for pose in poses]),
        ),
    )


def batch_of(sequence: StoredSequence, pairs: int, *starts: int) -> WindowBatch:
    """Windows that begin at these images."""
    return collate([cut_window(sequence, start, pairs) for start in starts]).as_float()


def upstream_of(batch: WindowBatch) -> dict:
    """What the VO of a batch says to the parts after it."""
    return {"T_prev_cur": batch.vo.T_prev_cur, "covariance": batch.vo.covariance, "valid": batch.vo.valid}
