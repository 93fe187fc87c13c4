"""The simulated odometer errs by exactly what it states."""

from itertools import pairwise

import numpy as np
import pytest

from vioframe.checks import Array
from vioframe.conventions import NANOSECONDS
from vioframe.data.simulated_vo import SimulatedVO
from vioframe.data.simulator import CameraSettings, SimulatedDataset
from vioframe.errors import ConfigError, StateError
from vioframe.geometry import se3
from vioframe.interfaces import CONSISTENT_SCALE, METRIC_SCALE, UsesGroundTruth
from vioframe.types import Frame, RelativePose, SensorRig, Trajectory, VisualFeatures

RECORDING = SimulatedDataset(duration_s=20.0, camera=CameraSettings(images=False)).open("walk-0")


def run(vo: SimulatedVO, repeats: int = 1, every: int = 1) -> tuple[list[RelativePose], Array]:
    """Estimates from frame to frame, and the true motions (N, 4, 4) of the camera."""
    vo.setup(RECORDING.rig)
    vo.take_ground_truth(RECORDING.ground_truth())
    stamps = RECORDING.frame_stamps_ns[::every]
    features = [VisualFeatures(frame=Frame(stamp_ns=int(stamp))) for stamp in stamps]
    estimates = [vo.estimate(a, b) for _ in range(repeats) for a, b in pairwise(features)]
    poses = RECORDING.motion.evaluate(RECORDING.elapsed_s(stamps)).T_world_body @ RECORDING.rig.cameras[0].T_body_cam
    return estimates, np.tile(se3.inverse(poses[:-1]) @ poses[1:], (repeats, 1, 1))


@pytest.mark.parametrize(
    "options", [{"rotation_noise": -1.0}, {"translation_noise": np.nan}, {"scale": 0.0}, {"lost_share": 2.0}]
)
def test_wrong_options_are_refused_by_name(options: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=next(iter(options))):
        SimulatedVO(**options)  # type: ignore[arg-type]


def test_without_the_truth_it_says_so() -> None:
    vo = SimulatedVO()
    vo.setup(RECORDING.rig)
    with pytest.raises(StateError, match="ground truth"):
        vo.estimate(VisualFeatures(frame=Frame(stamp_ns=0)), VisualFeatures(frame=Frame(stamp_ns=1)))


def test_it_is_known_to_use_the_truth_and_says_what_its_scale_is() -> None:
    assert isinstance(SimulatedVO(), UsesGroundTruth)
    assert METRIC_SCALE in SimulatedVO().provides
    for vo in (SimulatedVO(scale=2.0), SimulatedVO(scale_drift=0.01)):
        assert METRIC_SCALE not in vo.provides
        assert CONSISTENT_SCALE in vo.provides


def test_without_noise_it_is_exact() -> None:
    estimates, true = run(SimulatedVO(rotation_noise=0.0, translation_noise=0.0))
    np.testing.assert_allclose([e.T_prev_cur for e in estimates], true, atol=1e-9)


@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_its_errors_have_the_covariance_it_states(scale: float) -> None:
    estimates, true = run(SimulatedVO(rotation_noise=0.01, translation_noise=0.05, scale=scale), repeats=5)
    in_metres = np.array([e.T_prev_cur for e in estimates])
    in_metres[:, :3, 3] *= scale
    error = se3.log(se3.inverse(in_metres) @ true)
    stated = np.array([e.covariance for e in estimates])
    np.testing.assert_allclose(stated, stated[0][None].repeat(len(stated), 0), rtol=1e-9)
    stated_in_metres = stated[0] * np.outer(np.repeat([1.0, scale], 3), np.repeat([1.0, scale], 3))
    measured = error.T @ error / len(error)
    deviation = np.sqrt(np.diag(stated_in_metres))
    # 2000 draws: variances are known to 3 %, correlations to 0.022.
    np.testing.assert_allclose(measured / np.outer(deviation, deviation), np.eye(6), atol=0.12)
    expected = np.repeat([0.01, 0.05], 3) * np.sqrt(0.05)
    np.testing.assert_allclose(deviation, expected, rtol=1e-6)


def test_scale_drifts_as_stated() -> None:
    walked = []
    for seed in range(80):
        vo = SimulatedVO(rotation_noise=0.0, translation_noise=0.0, scale_drift=0.05, seed=seed)
        estimates, true = run(vo, every=20)
        # Twenty seconds in steps of one.
        ratio = np.linalg.norm(true[-1, :3, 3]) / np.linalg.norm(estimates[-1].T_prev_cur[:3, 3])
        walked.append(np.log(ratio) / np.sqrt(len(true)))
    assert np.std(walked) == pytest.approx(0.05, rel=0.25)


def test_setup_begins_the_same_noise_anew() -> None:
    vo = SimulatedVO()
    first, second = run(vo)[0], run(vo)[0]
    np.testing.assert_array_equal(first[7].T_prev_cur, second[7].T_prev_cur)
    other = run(SimulatedVO(seed=1))[0]
    assert np.abs(first[7].T_prev_cur - other[7].T_prev_cur).max() > 0.0


def test_lost_motions_are_invalid_and_leave_the_others_alone() -> None:
    whole = run(SimulatedVO())[0]
    holed = run(SimulatedVO(lost_share=0.3))[0]
    valid = [e.valid for e in holed]
    assert 0.6 < np.mean(valid) < 0.8
    for a, b in zip(whole, holed, strict=True):
        if b.valid:
            np.testing.assert_array_equal(a.T_prev_cur, b.T_prev_cur)


def test_beyond_the_truth_it_is_invalid() -> None:
    vo = SimulatedVO()
    vo.setup(RECORDING.rig)
    truth = RECORDING.ground_truth()
    vo.take_ground_truth(Trajectory(stamps_ns=truth.stamps_ns[:100], T_world_body=truth.T_world_body[:100]))
    end = int(truth.stamps_ns[99])
    features = [VisualFeatures(frame=Frame(stamp_ns=s)) for s in (end, end + NANOSECONDS)]
    assert not vo.estimate(*features).valid


def test_without_a_camera_it_gives_the_motion_of_the_body() -> None:
    vo = SimulatedVO(rotation_noise=0.0, translation_noise=0.0)
    vo.setup(SensorRig(cameras=(), imu=RECORDING.rig.imu))
    vo.take_ground_truth(RECORDING.ground_truth())
    a, b = RECORDING.frame_stamps_ns[[100, 101]]
    estimate = vo.estimate(*(VisualFeatures(frame=Frame(stamp_ns=int(s))) for s in (a, b)))
    poses = RECORDING.motion.evaluate(RECORDING.elapsed_s(np.array([a, b]))).T_world_body
    np.testing.assert_allclose(estimate.T_prev_cur, se3.inverse(poses[0]) @ poses[1], atol=1e-9)
