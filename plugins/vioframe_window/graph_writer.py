"""Writes the factors and first guesses of keyframes, points and calibration into a graph."""

from dataclasses import dataclass

import gtsam
import numpy as np

from vioframe.checks import Array
from vioframe.fusion_options import StandstillOptions
from vioframe.geometry import se3
from vioframe.types import Camera
from vioframe_window import factors
from vioframe_window.keyframes import Keyframe, focal_length
from vioframe_window.options import LandmarkOptions

# Observations are normalised coordinates, so that any lens is a pinhole of focal length 1.
_PINHOLE = gtsam.Cal3_S2()
# Sigma, m, of the part of a relative pose that was not measured.
_NO_MEASUREMENT = 1e3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Calibration:
    """What is assumed of the cameras' place and delay before the first image.

    Attributes:
        T_body_cam: (4, 4) of camera 0.
        sigmas: (6,) of it, tangent order; below a microradian and micrometre it is taken as fixed.
        delay_s: of the camera.
        delay_sigma: s, or None where the delay is not estimated.
        is_estimated: whether extrinsics or delay are variables.
    """

    T_body_cam: Array
    sigmas: Array
    delay_s: float
    delay_sigma: float | None
    is_estimated: bool


class GraphWriter:
    """Knows the noise of every factor, and the calibration that the next ones are written for.

    Args:
        cameras: of the rig; the place of camera 1 relative to camera 0 is taken as calibrated.
        landmarks: noise of observations.
        standstill: sigmas of no motion.
    """

    def __init__(self, cameras: tuple[Camera, ...], landmarks: LandmarkOptions, standstill: StandstillOptions) -> None:
        self.T_cam0_camera = [se3.inverse(cameras[0].T_body_cam) @ camera.T_body_cam for camera in cameras]
        self.calibration = Calibration(
            T_body_cam=cameras[0].T_body_cam, sigmas=np.zeros(6), delay_s=0.0, delay_sigma=None, is_estimated=False
        )
        pixel = gtsam.noiseModel.Isotropic.Sigma(2, landmarks.sigma_px / focal_length(cameras[0]))
        self._pixel = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(landmarks.huber), pixel)
        self._no_motion = gtsam.noiseModel.Diagonal.Sigmas(
            np.repeat([standstill.rotation_sigma, standstill.position_sigma], 3)
        )
        self._no_speed = gtsam.noiseModel.Isotropic.Sigma(3, standstill.velocity_sigma)

    @property
    def has_delay(self) -> bool:
        """Whether the camera's delay is a variable."""
        return self.calibration.delay_sigma is not None

    def add_calibration(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
        """Extrinsics and delay with their priors, where they are variables."""
        calibration = self.calibration
        if not calibration.is_estimated:
            return
        T_body_cam = gtsam.Pose3(calibration.T_body_cam)
        values.insert(factors.EXTRINSICS, T_body_cam)
        sigmas = gtsam.noiseModel.Diagonal.Sigmas(np.maximum(calibration.sigmas, 1e-6))
        graph.push_back(gtsam.PriorFactorPose3(factors.EXTRINSICS, T_body_cam, sigmas))
        if calibration.delay_sigma is not None:
            delay = np.array([calibration.delay_s])
            values.insert(factors.DELAY, delay)
            sigma = gtsam.noiseModel.Isotropic.Sigma(1, calibration.delay_sigma)
            graph.push_back(gtsam.PriorFactorVector(factors.DELAY, delay, sigma))

    def add_keyframe(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, keyframe: Keyframe) -> None:
        """A keyframe's variables, and its camera's tie to them."""
        index = keyframe.index
        values.insert(factors.body_key(index), gtsam.Pose3(keyframe.T_world_body))
        values.insert(factors.velocity_key(index), keyframe.v_world_body)
        values.insert(factors.bias_key(index), gtsam.imuBias.ConstantBias(keyframe.bias.accel, keyframe.bias.gyro))
        if self.calibration.is_estimated:
            values.insert(factors.camera_key(index), gtsam.Pose3(keyframe.T_world_cam))
            rate = keyframe.rate - keyframe.bias.gyro
            graph.push_back(factors.camera_tie(index, rate, keyframe.delay_s, with_delay=self.has_delay))

    def add_motion(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, keyframe: Keyframe, before: Keyframe
    ) -> None:
        """A keyframe, and what joins it to the one before."""
        self.add_keyframe(graph, values, keyframe)
        i, j = before.index, keyframe.index
        if keyframe.increment is not None:
            poses, velocities = ([key(i), key(j)] for key in (factors.body_key, factors.velocity_key))
            graph.push_back(
                gtsam.CombinedImuFactor(
                    poses[0],
                    velocities[0],
                    poses[1],
                    velocities[1],
                    factors.bias_key(i),
                    factors.bias_key(j),
                    keyframe.increment,
                )
            )
        if keyframe.at_rest:
            graph.push_back(
                gtsam.BetweenFactorPose3(factors.body_key(i), factors.body_key(j), gtsam.Pose3(), self._no_motion)
            )
            graph.push_back(gtsam.PriorFactorVector(factors.velocity_key(j), np.zeros(3), self._no_speed))
        if keyframe.turn is not None:
            R_body_cam = self.calibration.T_body_cam[:3, :3]
            turned = gtsam.Pose3(se3.from_parts(R_body_cam @ keyframe.turn.R_past_cam @ R_body_cam.T, np.zeros(3)))
            sigmas = np.repeat([keyframe.turn.sigma, _NO_MEASUREMENT], 3)
            noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
            graph.push_back(gtsam.BetweenFactorPose3(factors.body_key(i), factors.body_key(j), turned, noise))

    def observe_if_seen(self, graph: gtsam.NonlinearFactorGraph, keyframe: Keyframe, track_id: int) -> None:
        """All observations of a point at a keyframe."""
        for camera, view in enumerate(keyframe.views):
            row = int(np.searchsorted(view.ids, track_id))
            if row < len(view.ids) and view.ids[row] == track_id:
                self.observe(graph, keyframe, camera, track_id, view.points[row])

    def observe(
        self, graph: gtsam.NonlinearFactorGraph, keyframe: Keyframe, camera: int, track_id: int, point: Array
    ) -> None:
        """One observation of a point, in normalised coordinates (2,)."""
        if self.calibration.is_estimated:
            key, place = factors.camera_key(keyframe.index), self.T_cam0_camera[camera]
        else:
            key, place = factors.body_key(keyframe.index), self.calibration.T_body_cam @ self.T_cam0_camera[camera]
        graph.push_back(
            gtsam.GenericProjectionFactorCal3_S2(
                point, self._pixel, key, factors.point_key(track_id), _PINHOLE, gtsam.Pose3(place)
            )
        )

    def observe_from_loop(self, graph: gtsam.NonlinearFactorGraph, match_id: int, track_id: int, point: Array) -> None:
        """One observation of a point in an old image that was found again."""
        keys = factors.loop_key(match_id), factors.point_key(track_id)
        graph.push_back(gtsam.GenericProjectionFactorCal3_S2(point, self._pixel, *keys, _PINHOLE))
