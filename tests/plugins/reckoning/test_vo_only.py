"""Composed camera motions: the lever arm, the start, lost windows, and the covariance."""

from dataclasses import replace

import numpy as np
import pytest

from inertial_truth import NOISE, even_stamps, motion, samples, windows_of
from vioframe.conventions import NANOSECONDS
from vioframe.errors import ConfigError, StateError
from vioframe.geometry import se3, so3
from vioframe.testing import check_component
from vioframe.types import Camera, ImuBlock, Measurement, NavState, RelativePose, SensorRig
from vioframe_reckoning import VoOnlyFuser

T_BODY_CAM = se3.from_parts(so3.exp(np.array([1.2, -1.1, 1.3])), np.array([0.4, -0.2, 0.3]))
RIG = SensorRig(
    cameras=(
        Camera(
            model="pinhole",
            intrinsics_px=np.array([400.0, 400.0, 320.0, 240.0]),
            size_px=(640, 480),
            T_body_cam=T_BODY_CAM,
        ),
    ),
    imu=NOISE,
)
WINDOWS = windows_of(samples(even_stamps(0.0, 5.0, 1000)), 20)
POSES = motion(np.linspace(0.0, 5.0, 51)).T_world_body


def relative(k: int, unit: float = 1.0, **fields: object) -> RelativePose:
    """True motion of the camera over window ``k``, in units of ``unit`` metres."""
    T = se3.inverse(POSES[k] @ T_BODY_CAM) @ POSES[k + 1] @ T_BODY_CAM
    T[:3, 3] /= unit
    return RelativePose(T_prev_cur=T, **fields)


def start() -> NavState:
    truth = motion(np.array([0.0]))
    return NavState(stamp_ns=0, T_world_body=truth.T_world_body[0], v_world_body=truth.velocity[0])


def fuser_with(**options: object) -> VoOnlyFuser:
    fuser = VoOnlyFuser(**options)
    fuser.setup(RIG)
    return fuser


def follow(fuser: VoOnlyFuser, poses: list[RelativePose]) -> list[NavState]:
    states: list[NavState] = []
    for window, pose in zip(WINDOWS, poses, strict=False):
        states += fuser.update(Measurement(window=window, relative_pose=pose))
    return states


@pytest.mark.parametrize(
    "option",
    [
        {"scale": 0.0},
        {"on_invalid": "guess"},
        {"tilt_sigma": 0.0},
        {"coast_rate_sigma": -1.0},
        {"coast_accel_sigma": -1.0},
    ],
)
def test_wrong_options_are_refused_by_name(option: dict) -> None:
    with pytest.raises(ConfigError, match=f"fuser.{next(iter(option))}"):
        VoOnlyFuser(**option)


def test_a_rig_without_a_camera_is_refused() -> None:
    with pytest.raises(ConfigError, match="no camera"):
        VoOnlyFuser().setup(SensorRig(cameras=(), imu=NOISE))


def test_calls_out_of_order_are_refused() -> None:
    with pytest.raises(StateError, match="setup"):
        VoOnlyFuser().update(Measurement(window=WINDOWS[0], relative_pose=relative(0)))
    with pytest.raises(StateError, match="choose a vo"):
        fuser_with().update(Measurement(window=WINDOWS[0]))


@pytest.mark.parametrize("on_invalid", ["constant_velocity", "hold"])
def test_keeps_the_contract(on_invalid: str) -> None:
    check_component(VoOnlyFuser(on_invalid=on_invalid))


@pytest.mark.parametrize("unit", [1.0, 0.37, 12.0])
def test_true_motions_of_the_camera_give_the_true_poses_of_the_body(unit: float) -> None:
    fuser = fuser_with(scale=unit)
    fuser.start_from(start())
    states = follow(fuser, [relative(k, unit) for k in range(50)])
    assert [state.stamp_ns for state in states] == [0, *(window.current.stamp_ns for window in WINDOWS)]
    np.testing.assert_allclose([state.T_world_body for state in states], POSES, atol=1e-10)
    assert all(state.status == "tracking" for state in states)
    # The difference quotient is the velocity in the middle of the window.
    middle = motion(np.array([2.55])).velocity[0]
    np.testing.assert_allclose(states[26].v_world_body, middle, atol=5e-3)


def test_starts_level_at_the_origin_by_itself() -> None:
    states = follow(fuser_with(), [relative(k) for k in range(3)])
    R = states[0].T_world_body[:3, :3]
    up = WINDOWS[0].imu.accel.mean(axis=0)
    np.testing.assert_allclose(R @ (up / np.linalg.norm(up)), [0, 0, 1], atol=1e-12)
    assert not states[0].T_world_body[:3, 3].any()
    plain = follow(fuser_with(level=False), [relative(0)])
    np.testing.assert_array_equal(plain[0].T_world_body, np.eye(4))


def test_starts_along_its_own_axes_where_there_are_no_samples() -> None:
    window = replace(WINDOWS[0], imu=ImuBlock.none())
    first, second = fuser_with().update(Measurement(window=window, relative_pose=relative(0)))
    np.testing.assert_array_equal(first.T_world_body, np.eye(4))
    np.testing.assert_allclose(second.T_world_body, se3.inverse(POSES[0]) @ POSES[1], atol=1e-9)


def test_a_given_velocity_carries_the_body_until_the_first_motion() -> None:
    fuser = fuser_with()
    fuser.start_from(start())
    states = follow(fuser, [RelativePose.invalid(), relative(1)])
    moved = states[1].T_world_body[:3, 3] - POSES[0, :3, 3]
    np.testing.assert_allclose(moved, 0.1 * start().v_world_body, atol=1e-12)
    assert [state.status for state in states] == ["tracking", "lost", "tracking"]


@pytest.mark.parametrize("on_invalid", ["constant_velocity", "hold"])
def test_lost_windows_are_bridged_said_and_counted(on_invalid: str) -> None:
    covariance = np.diag([1e-8] * 3 + [1e-6] * 3)
    fuser = fuser_with(on_invalid=on_invalid)
    fuser.start_from(start())
    poses = [RelativePose.invalid() if k in (20, 21) else relative(k, covariance=covariance) for k in range(50)]
    states = follow(fuser, poses)
    assert [k for k, state in enumerate(states) if state.status == "lost"] == [21, 22]
    assert fuser.counters()["missing VO updates"] == 2
    error = np.array([np.linalg.norm(s.T_world_body[:3, 3] - POSES[k, :3, 3]) for k, s in enumerate(states)])
    if on_invalid == "hold":
        np.testing.assert_allclose(states[22].T_world_body, states[20].T_world_body, atol=1e-12)
        assert not states[22].v_world_body.any()
    else:
        assert error[22] < 0.15
    sigmas = np.array([np.sqrt(np.trace(s.covariance[3:6, 3:6])) for s in states if s.covariance is not None])
    assert len(sigmas) == 51 and sigmas[22] > 5 * sigmas[20]
    assert error[22] < 3 * sigmas[22] and error[-1] < 3 * sigmas[-1]


def test_without_a_covariance_of_the_motion_there_is_none_of_the_state() -> None:
    states = follow(fuser_with(), [relative(0, covariance=1e-6 * np.eye(6)), relative(1), relative(2)])
    assert [state.covariance is None for state in states] == [False, False, True, True]


@pytest.mark.parametrize("unit", [1.0, 4.0])
def test_covariance_is_that_of_the_errors(unit: float) -> None:
    """NEES of the final pose over seeded runs of noisy motions."""
    sigmas = np.array([1e-3, 2e-3, 1e-3, 5e-3 / unit, 3e-3 / unit, 8e-3 / unit])
    random = np.random.default_rng(9)
    runs, total = 100, np.zeros(2)
    exact = [relative(k, unit).T_prev_cur for k in range(25)]
    for _ in range(runs):
        fuser = fuser_with(scale=unit)
        # A start that is known but for rounding.
        fuser.start_from(NavState(stamp_ns=0, T_world_body=POSES[0], covariance=1e-12 * np.eye(15)))
        draws = se3.exp(-random.normal(0.0, sigmas, (len(exact), 6)))
        noisy = [
            RelativePose(T_prev_cur=T @ draw, covariance=np.diag(sigmas**2))
            for T, draw in zip(exact, draws, strict=True)
        ]
        last = follow(fuser, noisy)[-1]
        assert last.covariance is not None
        error = np.concatenate(
            [so3.log(last.T_world_body[:3, :3].T @ POSES[25, :3, :3]), POSES[25, :3, 3] - last.T_world_body[:3, 3]]
        )
        for k in range(2):
            part = slice(3 * k, 3 * k + 3)
            total[k] += error[part] @ np.linalg.solve(last.covariance[part, part], error[part]) / 3
    # χ² with 300 degrees of freedom over 300: 99.9 % bounds 0.75 and 1.29.
    anees = total / runs
    assert np.all((anees > 0.75) & (anees < 1.29)), anees


def test_a_window_that_never_came_is_crossed() -> None:
    fuser = fuser_with()
    fuser.start_from(start())
    states = follow(fuser, [relative(k) for k in range(20)])
    for k in range(21, 30):
        states += fuser.update(Measurement(window=WINDOWS[k], relative_pose=relative(k)))
    assert fuser.counters()["missing windows"] == 1
    assert states[-1].stamp_ns == 3 * NANOSECONDS
    assert np.linalg.norm(states[-1].T_world_body[:3, 3] - POSES[30, :3, 3]) < 0.15
