"""The whole filter on simulated motion and exact points with noise: consistency, calibration, holes, bad input."""

from dataclasses import replace

import numpy as np
import pytest

from filter_runs import assert_honest, simulated
from point_runs import PointCamera, play_points, points_around
from vioframe.error_state import Body, local_from_invariant
from vioframe.errors import ConfigError, StateError
from vioframe.fusion_options import StandstillOptions
from vioframe.geometry import se3, so3
from vioframe.tight.options import CalibrationOptions, InertialTrust
from vioframe.types import Measurement, Tracks, VisualFeatures
from vioframe_msckf import MsckfFuser, PointOptions

SIGMA_PX = 0.5
SHARP = CalibrationOptions(extrinsics="fixed", time_offset=False)


def make_fuser(calibration=None, **points):
    # The simulated noise is white and as stated, so the filter may believe it.
    points.setdefault("landmark_sigma_px", SIGMA_PX)
    return MsckfFuser(
        points=PointOptions(sigma_px=SIGMA_PX, **points),
        inertial=InertialTrust(),
        calibration=calibration or CalibrationOptions(),
    )


def run(
    fuser,
    family="drone",
    seconds=6.0,
    seed=0,
    believed=None,
    delay_ns=0,
    own_start=False,
    change=None,
    initial=None,
    **eyes,
):
    recording = simulated(family, seconds, seed=seed, **({"standstill_s": 1.5} if own_start else {"standstill_s": 0.0}))
    true_rig = replace(recording.rig, camera_delay_ns=delay_ns)
    truth = recording.ground_truth()
    sight = PointCamera(
        rig=true_rig, truth=truth, points=points_around(truth, seed, 1500), sigma_px=SIGMA_PX, seed=seed, **eyes
    )
    packets = (replace(p, stamp_ns=p.stamp_ns - delay_ns) if hasattr(p, "images") else p for p in recording.packets())
    options = {} if change is None else {"change": change}
    rig = recording.rig if believed is None else believed(recording.rig)
    return play_points(
        fuser, packets, rig, sight, initial=None if own_start else initial or draw_start(seed), **options
    )


def draw_start(seed):
    """A first state whose error is drawn from the covariance that it states."""

    def draw(state):
        rng = np.random.default_rng(1000 + seed)
        sigmas = np.repeat([2e-3, 1e-3, 0.02, 0.01, 0.05], 3)
        error = rng.normal(0, sigmas)
        # The biases of the recording are drawn by the simulator around zero with this spread.
        T = state.T_world_body.copy()
        T[:3, :3] = T[:3, :3] @ so3.exp(-error[:3])
        T[:3, 3] -= error[3:6]
        return replace(
            state, T_world_body=T, v_world_body=state.v_world_body - error[6:9], covariance=np.diag(sigmas**2)
        )

    return draw


def test_errors_are_as_large_as_the_covariance_says():
    squares = []
    for seed in range(5):
        out = run(make_fuser(landmarks=20), seconds=3.0, seed=seed)
        errors = out.errors()
        assert_honest(out.states)
        for index in range(20, len(errors), 20):
            e, P = errors[index, :9], out.states[index].covariance[:9, :9]
            squares.append(e @ np.linalg.solve(P, e) / 9)
    # Six runs of correlated errors: about ten times the spread of as many independent ones.
    assert 0.6 < np.mean(squares) < 1.6


def test_heading_and_position_are_never_learned():
    def unsure(state):
        # In the invariant error: the velocity's direction is as unknown as the heading.
        sigmas = np.array([1e-3, 1e-3, 0.1, 1.0, 1.0, 1.0, *np.full(9, 1e-3)])
        into = local_from_invariant(Body.of(state))
        return replace(state, covariance=into @ np.diag(sigmas**2) @ into.T)

    out = run(make_fuser(SHARP), seconds=4.0, initial=unsure)
    for state in out.states:
        up = state.T_world_body[2, :3]
        assert up @ state.covariance[:3, :3] @ up > 0.1**2 * (1.0 - 1e-6)
        assert np.linalg.eigvalsh(state.covariance[3:6, 3:6])[0] > 1.0 - 1e-6


@pytest.mark.parametrize("delay_ms", [-50, 30])
def test_time_offset_is_found(delay_ms):
    fuser = make_fuser(CalibrationOptions(time_offset_sigma_s=0.03))
    out = run(fuser, seconds=7.0, delay_ns=round(delay_ms * 1e6), seed=1, own_start=True)
    assert out.delays_ns[-1] / 1e6 == pytest.approx(delay_ms, abs=1.0)
    assert fuser.camera_delay_ns() == out.delays_ns[-1]


def test_a_camera_turned_by_three_degrees_is_found():
    wrong = so3.exp(np.deg2rad(3.0) * np.array([0.6, -0.64, 0.48]))

    def believed(rig):
        turned = tuple(
            replace(c, T_body_cam=se3.from_parts(wrong @ c.T_body_cam[:3, :3], c.T_body_cam[:3, 3]))
            for c in rig.cameras
        )
        return replace(rig, cameras=turned)

    fuser = make_fuser()
    run(fuser, seconds=6.0, seed=2, believed=believed, own_start=True)
    true = simulated("drone", 1.0, seed=2).rig.cameras[0].T_body_cam
    assert np.rad2deg(so3.angle(true[:3, :3].T @ fuser.T_body_cam()[:3, :3])) < 0.3


def test_what_is_fixed_stays():
    fuser = make_fuser(SHARP)
    run(fuser, seconds=2.0)
    true = simulated("drone", 1.0, seed=0).rig.cameras[0].T_body_cam
    np.testing.assert_allclose(fuser.T_body_cam(), true, atol=1e-12)
    assert fuser.camera_delay_ns() is None


def test_a_second_camera_helps():
    from vioframe.data.simulator import CameraSettings, SimulatedDataset

    errors = {}
    for count in (1, 2):
        camera = CameraSettings(images=False, count=count)
        dataset = SimulatedDataset(sequence="drone", seed=5, duration_s=2.5, camera=camera)
        recording = dataset.open(dataset.sequences[0])
        truth = recording.ground_truth()
        sight = PointCamera(rig=recording.rig, truth=truth, points=points_around(truth, 5, 1500), sigma_px=SIGMA_PX)
        out = play_points(make_fuser(), recording.packets(), recording.rig, sight, initial=draw_start(5))
        states = out.states
        errors[count] = np.trace(states[-1].covariance[3:6, 3:6]), np.linalg.norm(out.errors()[-1, 3:6])
    assert errors[2][0] < errors[1][0]
    assert errors[2][1] < 0.1


def test_standing_still_moves_nothing_and_begins_again_with_the_motion():
    fuser = make_fuser()
    out = run(fuser, family="standing", seconds=4.0, own_start=True)
    p = np.array([s.T_world_body[:3, 3] for s in out.states])
    assert fuser.counters()["standstill updates"] > 10
    assert np.isfinite(p).all()


def test_a_blind_second_is_survived_and_told():
    out = run(make_fuser(), seconds=6.0, seed=3, blind=((2.0, 3.6),))
    assert_honest(out.states)
    start = out.truth.stamps_ns[0]
    told = [s.status for s in out.states if 3.2e9 < s.stamp_ns - start < 3.55e9]
    assert set(told) == {"lost"}
    assert out.states[-1].status == "tracking"
    assert np.linalg.norm(out.errors()[-1, 3:6]) < 0.5


def test_dropped_frames_outliers_and_an_inertial_hole_are_survived():
    rng = np.random.default_rng(0)

    def spoil(index, measurement):
        tracks = measurement.features.tracks
        if rng.random() < 0.1:
            tracks = Tracks.none()
        window = measurement.window
        if index == 40:
            window = replace(window, gap_ns=300_000_000)
        return replace(measurement, window=window, features=replace(measurement.features, tracks=tracks))

    out = run(make_fuser(), seconds=4.0, seed=4, change=spoil, outliers=0.05)
    assert_honest(out.states)
    assert np.linalg.norm(out.errors()[-1, 3:6]) < 0.3


def test_windows_that_never_came_are_crossed():
    out = run(make_fuser(), seconds=4.0, seed=4, change=lambda i, m: None if 50 <= i < 56 else m)
    assert_honest(out.states)
    assert out.states[-1].status == "tracking"
    assert np.linalg.norm(out.errors()[-1, 3:6]) < 0.5


def test_rubbish_points_do_not_break_it():
    rng = np.random.default_rng(0)

    def scramble(index, measurement):
        tracks = measurement.features.tracks
        bearings = rng.normal(0, 1, (len(tracks), 3))
        bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
        features = VisualFeatures(frame=measurement.window.current, tracks=replace(tracks, bearings=bearings))
        return replace(measurement, features=features) if index > 30 else measurement

    out = run(make_fuser(), seconds=4.0, seed=4, change=scramble)
    assert_honest(out.states)


def test_without_a_camera_or_a_setup_it_says_so():
    rig = simulated("drone", 1.0).rig
    with pytest.raises(ConfigError, match="camera"):
        MsckfFuser().setup(replace(rig, cameras=()))
    with pytest.raises(StateError, match="setup"):
        MsckfFuser().update(Measurement(window=None))


@pytest.mark.parametrize(
    ("option", "value"),
    [("sigma_px", 0.0), ("clones", 2), ("landmarks", -1), ("min_observations", 1), ("max_depth_m", 0.05)],
)
def test_options_that_mean_nothing_are_refused_by_name(option, value):
    with pytest.raises(ConfigError, match=option):
        PointOptions(**{option: value})


def test_standstill_can_be_left_out():
    fuser = MsckfFuser(standstill=StandstillOptions(enabled=False))
    run(fuser, seconds=2.5, own_start=True)
    assert "standstill updates" not in fuser.counters()
