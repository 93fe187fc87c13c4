"""TUM-VI in its ASL export at 512×512: two fisheye cameras and a BMI160.

Schubert et al., "The TUM VI benchmark for evaluating visual-inertial odometry", IROS 2018.
"""

import numpy as np

from vioframe.geometry import se3
from vioframe.types import Camera, ImuNoise
from vioframe_recordings.asl import AslDataset, Profile


def _camera(intrinsics_px: list[float], distortion: list[float], T_cam_imu: list[list[float]]) -> Camera:
    return Camera(
        model="equidistant",
        intrinsics_px=np.array(intrinsics_px),
        distortion=np.array(distortion),
        size_px=(512, 512),
        T_body_cam=se3.inverse(np.array([*T_cam_imu, [0.0, 0.0, 0.0, 1.0]])),
    )


# dso/camchain.yaml of the 512_16 export (Kalibr's T_cam_imu).
CAMERAS_512 = (
    _camera(
        [190.97847715128717, 190.9733070521226, 254.93170605935475, 256.8974428996504],
        [0.0034823894022493434, 0.0007150348452162257, -0.0020532361418706202, 0.00020293673591811182],
        [
            [-0.9995250378696743, 0.029615343885863205, -0.008522328211654736, 0.04727988224914392],
            [0.0075019185074052044, -0.03439736061393144, -0.9993800792498829, -0.047443232143367084],
            [-0.02989013031643309, -0.998969345370175, 0.03415885127385616, -0.0681999605066297],
        ],
    ),
    _camera(
        [190.44236969414825, 190.4344384721956, 252.59949716835982, 254.91723064636983],
        [0.0034003170790442797, 0.001766278153469831, -0.00266312569781606, 0.0003299517423931039],
        [
            [-0.9995110484978581, 0.030299116376600627, -0.0077218830287333565, -0.053697434688869734],
            [0.008104079263822521, 0.012511643720192351, -0.9998888851620987, -0.046131737923635924],
            [-0.030199136245891378, -0.9994625667418545, -0.012751072573940885, -0.07149261284195751],
        ],
    ),
)

# dso/imu_config.yaml of the export: twice the white noise and ten times the walk of the paper's Allan
# deviations (table II), which leaves room for what the model leaves out.
BMI160 = ImuNoise(gyro_noise=1.6e-4, gyro_walk=2.2e-5, accel_noise=2.8e-3, accel_walk=8.6e-4, rate_hz=200.0)


class TumviDataset(AslDataset):
    """Sequences of TUM-VI as exported at 512×512 in the ASL layout.

    ``mocap0`` holds poses of the *IMU* (the export has applied the hand-eye calibration) in a world with z up. It
    covers the whole of the room sequences, with drop-outs, and only the start and the end of the others. The
    exported IMU samples are calibrated (scale, axes, bias).
    """

    profile = Profile(
        key="tumvi",
        title="TUM-VI",
        truth_files={"default": ("mocap0/data.csv", "gt0/data.csv")},
        imu=BMI160,
        cameras=CAMERAS_512,
        source="dso/camchain.yaml and dso/imu_config.yaml of the 512_16 export",
    )
