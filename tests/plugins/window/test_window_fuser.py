"""The fixed-lag smoother on points seen without images: what it recovers, survives and admits."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from filter_runs import simulated
from point_runs import PointCamera, play_points, points_around
from vioframe.errors import ConfigError, PluginError
from vioframe.geometry import se3, so3
from vioframe.initialisation import initial_covariance
from vioframe.tight.options import CalibrationOptions, FailureOptions
from vioframe.types import Frame
from vioframe_window import LandmarkOptions, WindowFuser, WindowOptions, library

FIXED = CalibrationOptions(extrinsics="fixed", time_offset=False)


def keep(state):
    return replace(state, covariance=initial_covariance(state.T_world_body[:3, :3]))


def disturbed(rng):
    def initial(state):
        covariance = initial_covariance(state.T_world_body[:3, :3])
        error = rng.multivariate_normal(np.zeros(15), covariance)
        T = state.T_world_body.copy()
        T[:3, :3] = T[:3, :3] @ so3.exp(-error[:3])
        T[:3, 3] -= error[3:6]
        return replace(state, T_world_body=T, v_world_body=state.v_world_body - error[6:9], covariance=covariance)

    return initial


def run(fuser, *, seed=0, seconds=6.0, stereo=False, true=lambda rig: rig, initial=keep, change=None, **eyes):
    """Play a simulated walk; ``true`` makes the true rig of the one that the fuser is told."""
    recording = simulated("walk", seconds, seed=seed, standstill_s=1.0)
    rig = replace(recording.rig, cameras=recording.rig.cameras[: 2 if stereo else 1])
    sees = PointCamera(
        rig=true(rig),
        truth=recording.ground_truth(),
        points=points_around(recording.ground_truth(), seed),
        seed=seed,
        **eyes,
    )
    late_ns = sees.rig.camera_delay_ns - rig.camera_delay_ns
    packets = [
        Frame(stamp_ns=packet.stamp_ns - late_ns) if isinstance(packet, Frame) else packet
        for packet in recording.packets()
    ]
    changes = {} if change is None else {"change": change}
    return play_points(fuser, packets, rig, sees, initial=initial, **changes)


def end_error(played):
    return float(np.linalg.norm(played.errors()[-1, 3:6]))


def test_follows_a_walk_and_gives_a_state_at_every_image():
    fuser = WindowFuser()
    played = run(fuser)
    stamps = [state.stamp_ns for state in played.states]
    assert np.diff(stamps).max() < 60_000_000
    assert end_error(played) < 0.08
    assert all(state.covariance is not None for state in played.states)
    assert {state.status for state in played.states} == {"tracking"}
    assert fuser.counters()["standstill updates"] > 5
    assert "windows solved again" not in fuser.counters()


def test_two_cameras_know_the_scale():
    errors = [np.linalg.norm(run(WindowFuser(), seed=4, stereo=stereo).errors()[-1, 6:9]) for stereo in (False, True)]
    assert errors[1] < max(errors[0], 0.02)


def test_second_camera_can_be_left_out():
    told = run(WindowFuser(stereo=False), stereo=True).states[-1].T_world_body
    alone = run(WindowFuser(), stereo=False).states[-1].T_world_body
    assert np.linalg.norm(told[:3, 3] - alone[:3, 3]) < 0.1


def test_errors_are_as_large_as_the_covariance_says():
    ratios = []
    for seed in range(4):
        played = run(WindowFuser(), seed=seed, initial=disturbed(np.random.default_rng(seed)), seconds=8.0)
        for error, state in list(zip(played.errors(), played.states, strict=True))[30::10]:
            ratios.append(error[:9] @ np.linalg.solve(state.covariance[:9, :9], error[:9]) / 9.0)
    # Four runs share their errors over time; a wrong model is off by tens.
    assert 0.25 < np.mean(ratios) < 2.5


@pytest.mark.parametrize("offset_ms", [-30, 30])
def test_finds_the_delay_of_the_camera(offset_ms):
    fuser = WindowFuser(calibration=CalibrationOptions(extrinsics="fixed", time_offset_sigma_s=0.03))
    played = run(
        fuser, seconds=10.0, true=lambda rig: replace(rig, camera_delay_ns=rig.camera_delay_ns + offset_ms * 1_000_000)
    )
    assert abs(played.delays_ns[-1] * 1e-6 - offset_ms) < 1.5


def test_finds_a_camera_that_is_turned():
    wrong = so3.exp(np.radians(3.0) * np.array([0.6, -0.6, 0.53]))

    def turned(rig):
        T = rig.cameras[0].T_body_cam.copy()
        T[:3, :3] = T[:3, :3] @ wrong
        return replace(rig, cameras=(replace(rig.cameras[0], T_body_cam=T),))

    fuser = WindowFuser(calibration=CalibrationOptions(rotation_sigma=0.05, time_offset=False))
    played = run(fuser, seconds=12.0, seed=2, true=turned)
    told = simulated("walk", 1.0, seed=2).rig.cameras[0].T_body_cam
    assert np.degrees(so3.angle((told[:3, :3] @ wrong).T @ fuser.T_body_cam()[:3, :3])) < 0.5
    assert len(played.states) > 200


def test_fixed_calibration_stays():
    fuser = WindowFuser(calibration=FIXED)
    played = run(fuser)
    np.testing.assert_allclose(fuser.T_body_cam(), simulated("walk", 1.0).rig.cameras[0].T_body_cam, atol=1e-12)
    assert fuser.camera_delay_ns() is None
    assert end_error(played) < 0.08


def test_survives_a_second_without_points():
    played = run(WindowFuser(), seconds=8.0, blind=((4.0, 5.0),))
    assert end_error(played) < 0.3
    assert all(np.isfinite(state.T_world_body).all() for state in played.states)


def test_survives_wrong_matches():
    assert end_error(run(WindowFuser(), outliers=0.1)) < 0.2


def test_a_system_without_solution_is_built_again(monkeypatch):
    update = gtsam.IncrementalFixedLagSmoother.update
    calls = []

    def failing(self, *arguments):
        calls.append(1)
        if len(calls) == 22:
            raise RuntimeError("Indeterminate linear system")
        return update(self, *arguments)

    monkeypatch.setattr(gtsam.IncrementalFixedLagSmoother, "update", failing)
    fuser = WindowFuser()
    played = run(fuser)
    assert fuser.counters()["windows solved again"] == 1
    assert end_error(played) < 0.1


def test_a_window_that_never_has_a_solution_is_a_failure_and_no_crash(monkeypatch):
    update = gtsam.IncrementalFixedLagSmoother.update
    calls = []

    def failing(self, *arguments):
        calls.append(1)
        if len(calls) > 15:
            raise RuntimeError("Indeterminate linear system")
        return update(self, *arguments)

    monkeypatch.setattr(gtsam.IncrementalFixedLagSmoother, "update", failing)
    fuser = WindowFuser(failure=FailureOptions(restart=False))
    played = run(fuser, seconds=4.0)
    assert played.states[-1].status == "lost"
    assert sum(count for name, count in fuser.counters().items() if name.startswith("failures")) == 1


def test_smoothed_keyframes_are_no_worse_and_not_causal():
    fuser = WindowFuser()
    played = run(fuser)
    smoothed = fuser.smoothed()
    assert not smoothed.causal
    truth = {int(s): T for s, T in zip(played.truth.stamps_ns, played.truth.T_world_body, strict=True)}
    common = [
        (T, truth[int(s)]) for s, T in zip(smoothed.stamps_ns, smoothed.T_world_body, strict=True) if int(s) in truth
    ]
    errors = [np.linalg.norm(se3.log(se3.inverse(T) @ true)[3:]) for T, true in common]
    assert len(smoothed) > 20
    assert not errors or np.mean(errors) < 0.08


def test_without_gtsam_it_says_what_to_install(monkeypatch):
    monkeypatch.setattr(library, "find_spec", lambda name: None)
    with pytest.raises(PluginError, match=r"pip install 'gtsam"):
        WindowFuser()


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: WindowOptions(lag_s=0.0), "lag_s must be positive"),
        (lambda: WindowOptions(lag_s=0.3), "at least two keyframes"),
        (lambda: WindowOptions(sparse_below=1.0), "sparse_below"),
        (lambda: WindowOptions(iterations=0), "iterations must be at least 1"),
        (lambda: LandmarkOptions(min_views=1), "min_views"),
        (lambda: LandmarkOptions(max_depth=0.1), "max_depth must be above"),
        (lambda: LandmarkOptions(sigma_px=0.0), "sigma_px must be positive"),
        (lambda: WindowFuser(loop={"wrong": 1}), "fuser.loop must be a loop closer"),
    ],
)
def test_wrong_options_are_refused(make, says):
    with pytest.raises(ConfigError, match=says):
        make()
