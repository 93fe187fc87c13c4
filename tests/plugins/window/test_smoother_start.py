"""A window begins from any first state that is known at all."""

import numpy as np
import pytest

from synthetic_tracks import R_BODY_CAM
from vioframe.fusion_options import StandstillOptions
from vioframe.geometry import se3
from vioframe.types import Camera, ImuBias, NavState
from vioframe_window.graph_writer import Calibration
from vioframe_window.keyframes import Keyframe
from vioframe_window.options import LandmarkOptions, WindowOptions
from vioframe_window.smoother import Smoother

T_BODY_CAM = se3.from_parts(R_BODY_CAM, np.array([0.1, 0.0, 0.05]))


@pytest.mark.parametrize("position_sigma", [1e-4, 0.1, 1.0, 10.0, 100.0])
def test_place_may_be_known_badly(position_sigma):
    """After long dead reckoning a window starts again where it believes to be, which may be metres off."""
    camera = Camera(
        model="pinhole",
        intrinsics_px=np.array([460.0, 460.0, 320.0, 240.0]),
        distortion=np.zeros(0),
        size_px=(640, 480),
        T_body_cam=T_BODY_CAM,
    )
    smoother = Smoother((camera,), WindowOptions(), LandmarkOptions(), StandstillOptions())
    state = NavState(
        stamp_ns=0,
        T_world_body=np.eye(4),
        v_world_body=np.array([0.3, 0.0, 0.0]),
        bias=ImuBias(gyro=np.zeros(3), accel=np.zeros(3)),
        status="tracking",
    )
    sigmas = np.repeat([0.01, position_sigma, 0.05, 0.003, 0.1], 3)
    keyframe = Keyframe(
        index=0,
        stamp_ns=0,
        views=(),
        increment=None,
        at_rest=False,
        delay_s=0.0,
        rate=np.zeros(3),
        T_world_body=state.T_world_body,
        v_world_body=state.v_world_body,
        bias=state.bias,
    )
    keyframe.T_world_cam = T_BODY_CAM
    calibration = Calibration(
        T_body_cam=T_BODY_CAM, sigmas=np.full(6, 0.01), delay_s=0.0, delay_sigma=0.01, is_estimated=True
    )
    smoother.begin(keyframe, state, np.diag(sigmas**2), calibration)
    np.testing.assert_allclose(smoother.newest.T_world_body, np.eye(4), atol=1e-9)
