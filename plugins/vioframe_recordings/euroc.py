"""EuRoC MAV: an ASL folder per sequence, VI-Sensor with two global-shutter cameras and an ADIS16448.

Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR 2016.
"""

import numpy as np

from vioframe.types import Camera, ImuNoise
from vioframe_recordings.asl import AslDataset, Profile

# cam0/sensor.yaml, cam1/sensor.yaml and imu0/sensor.yaml of V1_01_easy; the same in all sequences.
VI_SENSOR_CAMERAS = (
    Camera(
        model="radtan",
        intrinsics_px=np.array([458.654, 457.296, 367.215, 248.375]),
        distortion=np.array([-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]),
        size_px=(752, 480),
        T_body_cam=np.array(
            [
                [0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975],
                [0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768],
                [-0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949],
                [0.0, 0.0, 0.0, 1.0],
            ]
        ),
    ),
    Camera(
        model="radtan",
        intrinsics_px=np.array([457.587, 456.134, 379.999, 255.238]),
        distortion=np.array([-0.28368365, 0.07451284, -0.00010473, -3.55590700e-05]),
        size_px=(752, 480),
        T_body_cam=np.array(
            [
                [0.0125552670891, -0.999755099723, 0.0182237714554, -0.0198435579556],
                [0.999598781151, 0.0130119051815, 0.0251588363115, 0.0453689425024],
                [-0.0253898008918, 0.0179005838253, 0.999517347078, 0.00786212447038],
                [0.0, 0.0, 0.0, 1.0],
            ]
        ),
    ),
)

VI_SENSOR_IMU = ImuNoise(
    gyro_noise=1.6968e-4, gyro_walk=1.9393e-5, accel_noise=2.0e-3, accel_walk=3.0e-3, rate_hz=200.0
)


class EurocDataset(AslDataset):
    """Sequences of EuRoC, or any other recording in its layout with its own ``sensor.yaml``.

    The ground truth is that of ``state_groundtruth_estimate0`` (Vicon or laser tracker fused with the IMU, with
    velocities). For V1_01, whose orientation is off by 1.8°, a corrected file may lie beside it:
    ``ground_truth: corrected``.
    """

    profile = Profile(
        key="euroc",
        title="EuRoC",
        truth_files={
            "default": ("state_groundtruth_estimate0/data.csv",),
            "corrected": ("gt_openvins_*_corrected.csv", "*corrected*.csv"),
        },
        imu=VI_SENSOR_IMU,
        cameras=VI_SENSOR_CAMERAS,
        source="sensor.yaml of V1_01_easy",
    )
