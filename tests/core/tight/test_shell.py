"""The shell of tightly coupled estimators, around a method that only dead-reckons and can be told to fail."""

from dataclasses import replace

import numpy as np
import pytest

from filter_runs import FilterRun, play, record, simulated
from synthetic_tracks import make_rig
from vioframe.error_state import InertialFilter
from vioframe.errors import ConfigError, StateError
from vioframe.fusion_options import StandstillOptions
from vioframe.geometry import se3, so3
from vioframe.interfaces import STEREO_TRACKS
from vioframe.tight.failure import FailureMonitor
from vioframe.tight.fuser import TightFuser
from vioframe.tight.options import CalibrationOptions, FailureOptions, InertialTrust
from vioframe.tight.restart import DeadReckoning, coast_across
from vioframe.tight.step import Start, Step, Support
from vioframe.types import (
    Frame,
    ImuBias,
    ImuBlock,
    Measurement,
    NavState,
    SyncedWindow,
    Tracks,
    VisualFeatures,
)


class Reckoner(TightFuser):
    """Dead reckons; the tests decide how much support it claims and when its state breaks."""

    def __init__(self, **options):
        super().__init__(standstill=StandstillOptions(enabled=False), **options)
        self.used = 30
        self.spoil = None
        self.begun = []

    def _begin(self, start: Start) -> None:
        self.begun.append(start)
        self.filter = InertialFilter(extra=0, noise=self._noise, gravity=self._rig.gravity)
        self.filter.start(start.state, start.state.covariance)
        self.now_ns = start.state.stamp_ns

    def _advance(self, step: Step) -> Support:
        self.filter.propagate(step.delta)
        self.now_ns = step.stamp_ns
        if self.spoil is not None:
            self.filter.body = self.spoil(self.filter.body)
            self.spoil = None
        return Support(used=self.used)

    def _estimate(self) -> NavState:
        return self.filter.nav_state(self.now_ns, "tracking")


def some_tracks(count=30):
    rays = np.tile([0.0, 0.0, 1.0], (count, 1))
    return Tracks(ids=np.arange(count), pixels=np.zeros((count, 2)), bearings=rays, scores=np.ones(count))


def with_tracks(count=30):
    def change(index: int, measurement: Measurement) -> Measurement:
        return replace(
            measurement, features=VisualFeatures(frame=measurement.window.current, tracks=some_tracks(count))
        )

    return change


@pytest.fixture(scope="module")
def walk():
    recording = simulated("walk", 8.0, imu=None)
    return recording, record(recording)


def run(fuser, walk, change=None, **kwargs) -> FilterRun:
    recording, recorded = walk
    return play(fuser, recording, recorded, change=change or with_tracks(), **kwargs)


def test_update_before_setup_is_refused(walk):
    with pytest.raises(StateError, match="setup"):
        Reckoner().update(walk[1].measurements[0])


def test_rig_without_camera_is_refused(walk):
    with pytest.raises(ConfigError, match="calibrated camera"):
        Reckoner().setup(replace(walk[0].rig, cameras=()))


def test_window_without_increment_is_refused(walk):
    fuser = Reckoner()
    fuser.setup(walk[0].rig)
    fuser.start_from(walk[1].true_state(walk[1].measurements[0].window.previous.stamp_ns))
    with pytest.raises(StateError, match="integrator=preintegration"):
        fuser.update(replace(walk[1].measurements[0], inertial_delta=None))


def test_given_start_gives_every_stamp_once_from_the_first_on(walk):
    out = run(Reckoner(), walk)
    stamps = [state.stamp_ns for state in out.states]
    windows = [m.window for m in out.measurements]
    assert stamps == [windows[0].previous.stamp_ns, *(w.current.stamp_ns for w in windows)]
    assert {state.status for state in out.states} == {"tracking"}


def test_windows_seen_before_the_start_are_gone_through_again(walk):
    """The state after a replayed start is that of going on window by window."""
    recording, recorded = walk
    first, second = recorded.measurements[:2]
    true_state = recorded.true_state(first.window.previous.stamp_ns)
    state = replace(true_state, covariance=1e-4 * np.eye(15))

    class Late:
        attempts = ()

        def push(self, measurement):
            return Start(state=state, method="motion", replay=(first, second)) if measurement is second else None

    late = Reckoner()
    late.setup(recording.rig)
    late._starter = Late()
    assert late.update(first) == []
    (after,) = late.update(second)

    ordinary = Reckoner()
    ordinary.setup(recording.rig)
    ordinary.start_from(state)
    ordinary.update(first)
    (expected,) = ordinary.update(second)
    np.testing.assert_allclose(after.T_world_body, expected.T_world_body, atol=1e-12)
    np.testing.assert_allclose(after.covariance, expected.covariance, atol=1e-15)


def test_calibration_is_told_as_the_change_from_the_rigs(walk):
    class Turned(Reckoner):
        def camera_delay_ns(self):
            return self._rig.camera_delay_ns - 1_500_000

        def T_body_cam(self):
            return super().T_body_cam() @ se3.exp(np.array([0.0, np.radians(2.0), 0.0, 0.003, 0.0, 0.004]))

    fuser = Turned()
    assert fuser.calibration() == {}
    run(fuser, walk)
    found = {name: (change.value, change.unit) for name, change in fuser.calibration().items()}
    assert found["camera delay"] == (pytest.approx(-1.5), "ms")
    assert found["camera turned by"] == (pytest.approx(2.0), "°")
    assert found["camera moved by"] == (pytest.approx(5.0, rel=1e-3), "mm")
    fixed = Reckoner(calibration=CalibrationOptions(extrinsics="fixed", time_offset=False))
    run(fixed, walk)
    assert fixed.calibration() == {}


def test_status_follows_support(walk):
    fuser = Reckoner(failure=FailureOptions(lost_after_s=0.5, restart_after_s=100.0))

    def change(index, measurement):
        fuser.used = 0 if 20 <= index < 60 else 30
        return with_tracks()(index, measurement)

    out = run(fuser, walk, change)
    # The first state belongs to the start of window 0, so that of window i is i + 1; 0.5 s are 10 windows.
    lost = [i - 1 for i, state in enumerate(out.states) if state.status == "lost"]
    assert lost == list(range(30, 60))


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda b: replace(b, bias=ImuBias(accel=np.array([3.0, 0, 0]))), "accelerometer bias"),
        (lambda b: replace(b, bias=ImuBias(gyro=np.array([0, 1.2, 0]))), "gyro bias"),
        (lambda b: replace(b, p=b.p + np.array([0, 0, 9.0])), "jump"),
        (lambda b: replace(b, v=b.v + np.array([90.0, 0, 0])), "speed"),
        (lambda b: replace(b, v=b.v * np.nan), "the estimate is not finite"),
    ],
)
def test_failure_goes_on_from_before_it(walk, spoil, reason):
    """Dead reckoning leaves out the window that broke: it stays near the truth, and its status says lost."""
    fuser = Reckoner()

    def change(index, measurement):
        if index == 60:
            fuser.spoil = spoil
        return with_tracks()(index, measurement)

    out = run(fuser, walk, change)
    assert out.counters[f"failures: {reason}"] == 1
    assert all(state.status == "lost" for state in out.states[62:])
    reckoned = run(Reckoner(), walk)
    difference = out.position_errors()[61:] - reckoned.position_errors()[61:]
    assert np.abs(difference).max() < 0.02
    assert np.isfinite(out.position_errors()).all()


def test_refused_images_end_in_a_restart_but_a_blind_camera_does_not(walk):
    for count, restarts in ((30, True), (0, False)):
        fuser = Reckoner(failure=FailureOptions(lost_after_s=0.5, restart_after_s=1.0))

        def change(index, measurement, fuser=fuser, count=count):
            fuser.used = 30 if index < 40 else 0
            return with_tracks(count)(index, measurement)

        counters = run(fuser, walk, change).counters
        assert ("failures: no support from the images" in counters) is restarts


def test_without_restart_it_stays_lost(walk):
    fuser = Reckoner(failure=FailureOptions(restart=False))

    def change(index, measurement):
        if index == 60:
            fuser.spoil = lambda b: replace(b, p=b.p + np.array([0, 0, 9.0]))
        return with_tracks()(index, measurement)

    out = run(fuser, walk, change)
    assert len(fuser.begun) == 1
    assert out.counters["failures: jump"] == 1
    assert {state.status for state in out.states[62:]} == {"lost"}


def test_new_start_continues_the_trajectory():
    """Brought into the frame of the dead reckoning: same position and heading, own tilt, velocity turned along."""
    rng = np.random.default_rng(2)
    R_reached = so3.rotation_z(1.1) @ so3.exp(np.array([0.05, -0.03, 0.0]))
    reached = NavState(
        stamp_ns=10,
        T_world_body=se3.from_parts(R_reached, np.array([4.0, -2.0, 1.0])),
        covariance=np.diag([1e-4] * 3 + [0.04] * 3 + [1e-2] * 3 + [1e-6] * 6),
    )
    past = DeadReckoning(reached, make_rig().imu, 9.81)
    R_new = so3.exp(np.array([0.02, 0.04, 0.0]))
    new = NavState(
        stamp_ns=10,
        T_world_body=se3.from_parts(R_new, rng.normal(size=3)),
        v_world_body=np.array([1.0, 0.5, 0.2]),
        covariance=1e-6 * np.eye(15),
    )
    joined = past.brought_into_frame(new)
    np.testing.assert_allclose(joined.T_world_body[:3, 3], reached.T_world_body[:3, 3])
    # Gravity and velocity in the body are the new start's own.
    np.testing.assert_allclose(joined.T_world_body[2, :3], R_new[2], atol=1e-12)
    np.testing.assert_allclose(
        joined.T_world_body[:3, :3].T @ joined.v_world_body, R_new.T @ new.v_world_body, atol=1e-12
    )
    # The remaining rotation between the two has no part about the vertical.
    rest = joined.T_world_body[:3, :3] @ R_reached.T
    assert abs(rest[1, 0] - rest[0, 1]) < 1e-12
    np.testing.assert_allclose(joined.covariance[3:6, 3:6], 0.04 * np.eye(3), atol=1e-5)
    axis = joined.T_world_body[:3, :3].T @ [0, 0, 1]
    assert axis @ joined.covariance[:3, :3] @ axis == pytest.approx(1e-4 + 1e-6, rel=1e-3)


def test_missing_window_is_crossed_with_little_trust(walk):
    """Where no window came for half a second, the state coasts and its covariance says so."""
    recording, recorded = walk
    fuser = Reckoner()
    fuser.setup(recording.rig)
    fuser.start_from(recorded.true_state(recorded.measurements[0].window.previous.stamp_ns))
    states = []
    for index, measurement in enumerate(recorded.measurements):
        if not 60 <= index < 70:
            states += fuser.update(with_tracks()(index, measurement))
    stamps = np.array([s.stamp_ns for s in states])
    before, after = states[60], states[61]
    assert fuser.counters()["missing windows"] == 1
    assert (np.diff(stamps) > 0).all()
    assert np.trace(after.covariance[6:9, 6:9]) > 10 * np.trace(before.covariance[6:9, 6:9])
    # Half a second at constant velocity, against the walk's two steps a second.
    error_before = recorded.true_pose(before.stamp_ns)[:3, 3] - before.T_world_body[:3, 3]
    error_after = recorded.true_pose(after.stamp_ns)[:3, 3] - after.T_world_body[:3, 3]
    moved = np.linalg.norm(after.T_world_body[:3, 3] - before.T_world_body[:3, 3])
    assert moved > 0.2
    assert np.linalg.norm(error_after - error_before) < 1.0


def test_windows_without_samples_are_coasted_through_with_what_is_seen(walk):
    """Every window gives its state, the images still count as support, and the covariance grows."""
    recording, recorded = walk
    fuser = Reckoner()
    fuser.setup(recording.rig)
    fuser.start_from(recorded.true_state(recorded.measurements[0].window.previous.stamp_ns))
    states, seen = [], []
    advance = fuser._advance

    def watch(step):
        seen.append(len(step.tracks))
        return advance(step)

    fuser._advance = watch
    for index, measurement in enumerate(recorded.measurements[:80]):
        if 60 <= index < 70:
            silent = replace(measurement.window, imu=ImuBlock.none(), gap_ns=50_000_000)
            measurement = replace(measurement, window=silent, inertial_delta=None)
        states += fuser.update(with_tracks()(index, measurement))
    assert fuser.counters() == {"windows without inertial samples": 10}
    assert len(states) == 81 and (np.diff([s.stamp_ns for s in states]) > 0).all()
    assert seen == [30] * 80
    before, after = states[60], states[70]
    assert np.trace(after.covariance[6:9, 6:9]) > 1.5 * np.trace(before.covariance[6:9, 6:9])
    np.testing.assert_allclose(after.v_world_body, before.v_world_body, atol=1e-9)
    assert {s.status for s in states} == {"tracking"}


def test_coasting_keeps_velocity_and_attitude():
    rng = np.random.default_rng(0)
    state = NavState(
        stamp_ns=0,
        T_world_body=se3.from_parts(so3.exp(rng.normal(size=3)), rng.normal(size=3)),
        v_world_body=rng.normal(size=3),
        bias=ImuBias(gyro=0.1 * rng.normal(size=3), accel=rng.normal(size=3)),
        covariance=1e-6 * np.eye(15),
    )
    stamps_ns = np.array([500_000_000, 550_000_000])
    following = SyncedWindow(
        previous=Frame(stamp_ns=500_000_000),
        current=Frame(stamp_ns=550_000_000),
        imu=ImuBlock(stamps_ns=stamps_ns, gyro=np.zeros((2, 3)), accel=np.zeros((2, 3))),
        gap_ns=0,
    )
    made_up = coast_across(state, following, 9.81, InertialTrust())
    reckoning = DeadReckoning(state, make_rig().imu, 9.81)
    reckoning.move_on(
        Step(
            window=made_up.window,
            delta=made_up.inertial_delta,
            noise=make_rig().imu,
            tracks=Tracks.none(),
            stereo=None,
            at_rest=False,
        )
    )
    reached = reckoning.state(500_000_000)
    np.testing.assert_allclose(reached.v_world_body, state.v_world_body, atol=1e-12)
    np.testing.assert_allclose(reached.T_world_body[:3, :3], state.T_world_body[:3, :3], atol=1e-12)
    np.testing.assert_allclose(
        reached.T_world_body[:3, 3], state.T_world_body[:3, 3] + 0.5 * state.v_world_body, atol=1e-12
    )
    # The raw samples say the same: bias and gravity's reaction.
    np.testing.assert_allclose(made_up.window.imu.gyro[0], state.bias.gyro)
    lift = state.T_world_body[:3, :3].T @ [0, 0, 9.81] + state.bias.accel
    np.testing.assert_allclose(made_up.window.imu.accel[0], lift, atol=1e-12)


def test_memory_of_the_monitor_is_bounded(walk):
    fuser = Reckoner(failure=FailureOptions(lost_after_s=0.5, restart_after_s=0.5))
    run(fuser, walk)
    monitor: FailureMonitor = fuser._monitor
    assert len(monitor._supported) < 25 and len(monitor._steps) < 25


@pytest.mark.parametrize(
    "make",
    [
        lambda: InertialTrust(gyro_noise_scale=0.0),
        lambda: InertialTrust(gap_rate_sigma=-1.0),
        lambda: CalibrationOptions(extrinsics="guess"),
        lambda: CalibrationOptions(time_offset_sigma_s=0.0),
        lambda: FailureOptions(min_used=0),
        lambda: FailureOptions(max_speed=-1.0),
    ],
)
def test_options_outside_their_range_are_refused(make):
    with pytest.raises(ConfigError, match=r"fuser\."):
        make()


def test_stereo_points_are_needed_taken_or_left_out_as_asked(walk):
    class Looker(Reckoner):
        def _advance(self, step: Step) -> Support:
            self.seen = step.stereo
            return super()._advance(step)

    pair = replace(some_tracks(), camera=1)

    def change(index, measurement):
        frame = measurement.window.current
        return replace(measurement, features=VisualFeatures(frame=frame, tracks=some_tracks(), stereo=pair))

    for stereo, needed, taken in ((True, True, True), (False, False, False), (None, False, True)):
        fuser = Looker(stereo=stereo)
        assert (STEREO_TRACKS in fuser.requires) is needed
        run(fuser, walk, change)
        assert (fuser.seen is pair) is taken
    assert STEREO_TRACKS not in Looker.requires
