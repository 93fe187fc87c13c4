"""The pipeline: wiring, order of calls, one path for streams and recordings, honest timers."""

import time
from dataclasses import replace

import numpy as np
import pytest

from vioframe.errors import PluginError, StateError, WiringError
from vioframe.interfaces import (
    INERTIAL_DELTA,
    METRIC_SCALE,
    RELATIVE_POSE,
    STEREO,
    Frontend,
    Fuser,
    InertialIntegrator,
    Synchronizer,
    VOEstimator,
)
from vioframe.pipeline import Pipeline
from vioframe.testing import make_scene
from vioframe.types import ImuBlock, NavState, RelativePose, SensorRig, SyncedWindow, VisualFeatures

SCENE = make_scene()


class Replay(Synchronizer):
    """Gives the scene's windows as their current frames come in."""

    def setup(self, rig):
        self.windows = {window.current.stamp_ns: window for window in SCENE.windows}

    def push(self, packet) -> list[SyncedWindow]:
        window = self.windows.get(getattr(packet, "stamp_ns", None))
        return [] if window is None else [window]

    def flush(self) -> list[SyncedWindow]:
        return []


class Sight(Frontend):
    provides = frozenset({"depth"})

    def setup(self, rig):
        self.seen = []

    def process(self, frame, R_prev_cur=None):
        self.seen.append((frame.stamp_ns, R_prev_cur))
        return VisualFeatures(frame=frame, extras={"depth": np.ones((2, 2))})


class Steps(VOEstimator):
    provides = frozenset({RELATIVE_POSE, METRIC_SCALE})

    def estimate(self, previous, current):
        assert previous.frame.stamp_ns < current.frame.stamp_ns
        return RelativePose(T_prev_cur=np.eye(4))


class Keep(Fuser):
    def setup(self, rig):
        self.measurements = []
        self.started = None

    def start_from(self, state):
        self.started = state

    def update(self, measurement):
        self.measurements.append(measurement)
        return [NavState(stamp_ns=measurement.window.current.stamp_ns, T_world_body=np.eye(4))]


class NeedsDepth(Keep):
    requires = frozenset({"depth"})


class NeedsMetric(Keep):
    requires = frozenset({RELATIVE_POSE, METRIC_SCALE})


class NeedsStereo(Frontend):
    requires = frozenset({STEREO})

    def process(self, frame, R_prev_cur=None):
        return VisualFeatures(frame=frame)


def test_unmet_need_names_the_physics_and_all_choices():
    with pytest.raises(WiringError) as caught:
        Pipeline(
            synchronizer=Replay(),
            frontend=Sight(),
            fuser=NeedsMetric(),
            choices={"synchronizer": "interpolate", "frontend": "klt", "fuser": "ekf"},
        )
    message = str(caught.value)
    assert message.startswith("fuser=ekf needs metric_scale and relative_pose, which nothing before it provides")
    assert "frontend=klt" in message and "vo=none" in message and "integrator=none" in message


def test_delay_that_the_fuser_finds_reaches_the_synchronizer():
    class Told(Replay):
        told = ()

        def assume_camera_delay(self, delay_ns):
            self.told = (*self.told, delay_ns)

    class Finds(Keep):
        def camera_delay_ns(self):
            return len(self.measurements) * 1000

    for fuser, expected in ((Finds(), tuple(range(1000, 1000 * len(SCENE.windows) + 1, 1000))), (Keep(), ())):
        synchronizer = Told()
        pipeline = Pipeline(synchronizer=synchronizer, fuser=fuser)
        pipeline.setup(SCENE.rig)
        list(pipeline.run(SCENE.packets()))
        assert synchronizer.told == expected


def test_strangers_name_is_exchanged_without_the_core_knowing_it():
    pipeline = Pipeline(synchronizer=Replay(), frontend=Sight(), fuser=NeedsDepth())
    pipeline.setup(SCENE.rig)
    list(pipeline.run(SCENE.packets()))
    assert pipeline.fuser.measurements[0].features.extras["depth"].shape == (2, 2)
    with pytest.raises(WiringError, match="depth"):
        Pipeline(synchronizer=Replay(), fuser=NeedsDepth())


def test_what_comes_after_does_not_count():
    class BackwardSight(Sight):
        requires = frozenset({RELATIVE_POSE})

    with pytest.raises(WiringError, match="frontend"):
        Pipeline(synchronizer=Replay(), frontend=BackwardSight(), vo=Steps(), fuser=Keep())


def test_recording_without_the_cameras_is_refused_at_setup():
    pipeline = Pipeline(synchronizer=Replay(), frontend=NeedsStereo(), fuser=Keep(), choices={"frontend": "pair"})
    mono = SensorRig(cameras=SCENE.rig.cameras[:1], imu=SCENE.rig.imu)
    with pytest.raises(WiringError, match=r"frontend=pair needs the images of 2 cameras, but the recording gives 1"):
        pipeline.setup(mono)
    blind = SensorRig(cameras=SCENE.rig.cameras, imu=SCENE.rig.imu, has_images=False)
    with pytest.raises(WiringError, match="gives 0"):
        pipeline.setup(blind)


class Counts(InertialIntegrator):
    def integrate(self, imu, bias):
        raise NotImplementedError


def test_recording_without_inertial_samples_is_refused_by_who_integrates():
    bare = replace(SCENE.rig, has_imu=False)
    pipeline = Pipeline(synchronizer=Replay(), integrator=Counts(), fuser=Keep(), choices={"integrator": "paper"})
    with pytest.raises(WiringError, match=r"integrator=paper needs inertial samples.*integrator=none"):
        pipeline.setup(bare)
    Pipeline(synchronizer=Replay(), vo=Steps(), fuser=Keep()).setup(bare)


class Holed(Replay):
    """The scene's windows, of which some images and some samples never came."""

    unseen = (3, 4, 9)
    silent = (5, 6)

    def setup(self, rig):
        frames = [replace(f, images=(), missing=True) if k in self.unseen else f for k, f in enumerate(SCENE.frames)]
        self.windows = {
            frames[k + 1].stamp_ns: replace(
                window,
                previous=frames[k],
                current=frames[k + 1],
                imu=ImuBlock.none() if k in self.silent else window.imu,
            )
            for k, window in enumerate(SCENE.windows)
        }


class Sums(InertialIntegrator):
    def setup(self, rig):
        self.integrated = []

    def integrate(self, imu, bias):
        self.integrated.append(int(imu.stamps_ns[0]))


@pytest.mark.parametrize("frontend", [None, Sight])
def test_images_and_samples_that_never_came_are_not_asked_for(frontend):
    sight, sums, fuser = frontend and frontend(), Sums(), Keep()
    pipeline = Pipeline(synchronizer=Holed(), frontend=sight, vo=Steps(), integrator=sums, fuser=fuser)
    pipeline.setup(SCENE.rig)
    list(pipeline.run(SCENE.packets()))
    count = len(SCENE.windows)
    assert len(fuser.measurements) == count
    blind = {k for k in range(count) if {k, k + 1} & set(Holed.unseen)}
    for k, measurement in enumerate(fuser.measurements):
        assert measurement.relative_pose.valid == (k not in blind)
        assert (measurement.features is None) == (k + 1 in Holed.unseen)
    silent = {SCENE.frames[k].stamp_ns for k in Holed.silent}
    assert not silent & set(sums.integrated) and len(sums.integrated) == count - len(silent)
    if sight is not None:
        seen = [frame.stamp_ns for k, frame in enumerate(SCENE.frames) if k not in Holed.unseen]
        assert [stamp for stamp, _ in sight.seen] == seen


def test_calls_out_of_order_are_refused():
    pipeline = Pipeline(synchronizer=Replay(), fuser=Keep())
    with pytest.raises(StateError, match="setup"):
        pipeline.push(SCENE.frames[0])
    with pytest.raises(StateError, match="setup"):
        pipeline.flush()


def test_running_a_recording_is_pushing_its_packets():
    pushed = Pipeline(synchronizer=Replay(), frontend=Sight(), vo=Steps(), fuser=Keep())
    pushed.setup(SCENE.rig)
    one_by_one = [state for packet in SCENE.packets() for state in pushed.push(packet)] + pushed.flush()
    run = Pipeline(synchronizer=Replay(), frontend=Sight(), vo=Steps(), fuser=Keep())
    run.setup(SCENE.rig)
    assert [s.stamp_ns for s in run.run(SCENE.packets())] == [s.stamp_ns for s in one_by_one]
    assert len(one_by_one) == len(SCENE.windows)


def test_every_frame_is_seen_once_and_in_order():
    sight = Sight()
    pipeline = Pipeline(synchronizer=Replay(), frontend=sight, vo=Steps(), fuser=Keep())
    pipeline.setup(SCENE.rig)
    list(pipeline.run(SCENE.packets()))
    assert [stamp for stamp, _ in sight.seen] == [frame.stamp_ns for frame in SCENE.frames]


def test_given_state_reaches_the_fuser_at_the_first_window_where_it_is_known():
    fuser = Keep()
    pipeline = Pipeline(synchronizer=Replay(), fuser=fuser)
    known_from = SCENE.frames[4].stamp_ns

    def look_up(stamp_ns: int) -> NavState | None:
        return NavState(stamp_ns=stamp_ns, T_world_body=np.eye(4)) if stamp_ns >= known_from else None

    pipeline.setup(SCENE.rig, look_up)
    list(pipeline.run(SCENE.packets()))
    assert fuser.started.stamp_ns == known_from
    assert fuser.measurements[0].window.previous.stamp_ns == known_from


def test_timers_hold_the_parts_time_and_an_observers_time_is_nobodys():
    class Slow(Keep):
        def update(self, measurement):
            time.sleep(0.005)
            return super().update(measurement)

    pipeline = Pipeline(synchronizer=Replay(), fuser=Slow())
    pipeline.setup(SCENE.rig)
    pipeline.observe(lambda measurement, states: time.sleep(0.02))
    list(pipeline.run(SCENE.packets()))
    windows = len(SCENE.windows)
    assert pipeline.timers["fuser"].seconds >= 0.005 * windows
    assert pipeline.seconds < 0.015 * windows
    assert pipeline.seconds >= sum(timer.seconds for timer in pipeline.timers.values())


def test_override_with_other_parameters_is_refused_when_the_class_is_made():
    with pytest.raises(PluginError, match=r"update must take the parameters \(self, measurement"):

        class Wrong(Fuser):
            def update(self, window):
                return []

    with pytest.raises(PluginError, match="process"):

        class WithoutDefault(Frontend):
            def process(self, frame, R_prev_cur):
                return VisualFeatures(frame=frame)


def test_further_parameters_with_a_default_are_allowed():
    class Wide(Fuser):
        def update(self, measurement, gain: float = 1.0):
            return []

    assert Wide().update(None) == []


def test_needing_the_integrator():
    class NeedsDelta(Keep):
        requires = frozenset({INERTIAL_DELTA})

    with pytest.raises(WiringError, match="inertial_delta"):
        Pipeline(synchronizer=Replay(), fuser=NeedsDelta())
