"""VINet in use: the contract, streams that answer as batches do, sensors that are missing, and what is refused."""

import dataclasses

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs torch: pip install 'vioframe[learn]'")
pytest.importorskip("safetensors", reason="needs safetensors: pip install 'vioframe[learn]'")

import torch

from composing import composed, offered
from learned_scenes import stored
from vioframe.build import build_pipeline
from vioframe.data.windows import cut_window
from vioframe.errors import ConfigError, DataError, StateError
from vioframe.geometry import se3, so3
from vioframe.interfaces import Trainable
from vioframe.learning.batch import collate
from vioframe.learning.weights import save_weights
from vioframe.testing import check_component, make_scene
from vioframe.types import Frame, ImuBlock, Measurement, NavState, SyncedWindow, VisualFeatures
from vioframe_vinet import PairEncoder, VinetFuser

WINDOW = 3
SMALL = {"embedding": 8, "window": WINDOW, "imu_hidden": 6, "hidden": 16, "joined": 8, "device": "cpu"}


def encoder(**options):
    torch.manual_seed(7)
    small = {"size_px": (320, 240), "features": 8, "width": 0.1, "batch_norm": False, "device": "cpu"}
    return PairEncoder(**{**small, **options})


def vinet(lively=True, **options):
    """A small fuser; lively: with answers that depend on what is seen, as after a training."""
    torch.manual_seed(7)
    part = VinetFuser(**{**SMALL, **options})
    if lively:
        with torch.no_grad():
            part.net.get_submodule("core.answer").weight.normal_(std=0.3)
    return part


@pytest.fixture(scope="module")
def scene():
    return make_scene()


def given(scene, index=0):
    return NavState(
        stamp_ns=scene.frames[index].stamp_ns,
        T_world_body=scene.truth.T_world_body[index],
        v_world_body=np.asarray(scene.truth.v_world_body)[index],
    )


def stream(front, fuser, scene, windows, start=True):
    """States of these windows, each seen by the front end as a pipeline would have it."""
    front.setup(scene.rig)
    fuser.setup(scene.rig)
    if start:
        fuser.start_from(given(scene))
    states, seen = [], None
    for window in windows:
        if seen is None or seen.frame is not window.previous:
            front.process(window.previous)
        seen = front.process(window.current)
        states += fuser.update(Measurement(window=window, features=seen))
    return states


def blind(window, previous=True, current=True):
    """The window without its images."""
    first = Frame(stamp_ns=window.previous.stamp_ns, images=()) if previous else window.previous
    last = Frame(stamp_ns=window.current.stamp_ns, images=()) if current else window.current
    return dataclasses.replace(window, previous=first, current=last)


def deaf(window):
    """The window without its inertial samples."""
    none = ImuBlock(stamps_ns=np.zeros(0, np.int64), gyro=np.zeros((0, 3)), accel=np.zeros((0, 3)))
    return SyncedWindow(previous=window.previous, current=window.current, imu=none, gap_ns=0)


def chain_of(windows):
    """Windows whose frames are the same objects where they meet, as a synchronizer gives them."""
    met = [windows[0]]
    for window in windows[1:]:
        same = window.previous.stamp_ns == met[-1].current.stamp_ns
        met.append(dataclasses.replace(window, previous=met[-1].current) if same else window)
    return met


@pytest.mark.parametrize("options", [{}, {"feedback": "pose"}, {"loss": "learned", "axes": "body"}], ids=str)
def test_contract(options):
    front, fuser = encoder(), vinet(**options)
    check_component(front)
    check_component(fuser)
    assert isinstance(front, Trainable) and isinstance(fuser, Trainable)


@pytest.mark.parametrize("feedback", ["none", "pose"])
@pytest.mark.parametrize("axes", ["camera", "body"])
@pytest.mark.parametrize("rotation", ["gyro", "learned"])
def test_a_stream_answers_as_a_batch_does(scene, feedback, axes, rotation):
    front, fuser = encoder(), vinet(feedback=feedback, axes=axes, rotation=rotation)
    windows = collate([cut_window(stored(scene), start, 5) for start in (0, 4)]).as_float()
    with torch.no_grad():
        outputs = fuser.forward_batch(windows, front.forward_batch(windows, {}))
    expected = outputs["T_prev_cur"].double().numpy()
    assert expected.shape == (2, 5, 4, 4)
    T_body_cam = scene.rig.cameras[0].T_body_cam
    for row, first in enumerate((0, 4)):
        states = stream(front, fuser, scene, scene.windows[first : first + 5], start=False)
        poses = np.array([state.T_world_body for state in states]) @ T_body_cam
        found = se3.inverse(poses[:-1]) @ poses[1:]
        np.testing.assert_allclose(found, expected[row], atol=2e-6)
    assert not np.allclose(expected[0, -1], expected[1, -1], atol=1e-4), "it answers the same, whatever it sees"


def test_a_batch_of_images_is_encoded_as_they_come_one_by_one(scene):
    front = encoder(batch=4)
    front.setup(scene.rig)
    one = [front.process(frame).embedding for frame in scene.frames]
    front.setup(scene.rig)
    many = [features.embedding for features in front.process_many(scene.frames)]
    np.testing.assert_allclose(one, many, atol=1e-6)
    assert not np.any(one[0]) and np.any(one[1])
    assert front.process(Frame(stamp_ns=10**12, images=())).embedding is None


def test_gyro_alone_turns_a_net_that_has_learned_nothing(scene):
    """Its first answers are the rotation of the gyro, which here is exact, and no translation."""
    front, fuser = encoder(), vinet(lively=False, gyro_bias_sigma=1e-5)
    with torch.no_grad():
        fuser.net.get_submodule("core.answer").weight.zero_()
    states = stream(front, fuser, scene, scene.windows)
    for state, truth in zip(states, scene.truth.T_world_body, strict=True):
        assert np.linalg.norm(so3.log(state.T_world_body[:3, :3].T @ truth[:3, :3])) < 1e-5
        # The camera stays, so the body moves only as far as the lever arm turns.
        assert np.linalg.norm(state.T_world_body[:3, 3] - scene.truth.T_world_body[0, :3, 3]) < 0.02


@pytest.mark.parametrize("rate", [0.5, 4], ids=["half as fast", "four times as fast"])
def test_another_inertial_rate_gives_the_same_motion_and_is_told_once(scene, rate, caplog):
    caplog.set_level("INFO")
    front, fuser = encoder(), vinet()

    def at(window, count):
        stamps = np.linspace(window.imu.stamps_ns[0], window.imu.stamps_ns[-1], count + 1).round().astype(np.int64)
        known = window.imu.stamps_ns
        gyro, accel = (
            np.stack([np.interp(stamps, known, values[:, axis]) for axis in range(3)], axis=1)
            for values in (window.imu.gyro, window.imu.accel)
        )
        return dataclasses.replace(window, imu=ImuBlock(stamps_ns=stamps, gyro=gyro, accel=accel))

    plain = stream(front, fuser, scene, scene.windows)
    caplog.clear()
    other = stream(front, fuser, scene, [at(window, round(20 * rate)) for window in scene.windows])
    assert caplog.text.count("inertial intervals") == (rate == 4)
    for one, two in zip(plain, other, strict=True):
        np.testing.assert_allclose(one.T_world_body, two.T_world_body, atol=2e-3)


@pytest.mark.parametrize("first", [0, 4], ids=["from the start", "later"])
@pytest.mark.parametrize("sensor", ["camera", "imu", "both"])
def test_it_goes_on_without_a_sensor_and_says_so(scene, sensor, first):
    front, fuser = encoder(), vinet(lost_after_s=0.25)
    windows = list(scene.windows)
    for k in range(first, first + 4):
        if sensor != "imu":
            windows[k] = blind(windows[k], previous=k > first or first == 0)
        if sensor != "camera":
            windows[k] = deaf(windows[k])
    if sensor != "imu":
        windows[first + 4] = blind(windows[first + 4], current=False)
    states = stream(front, fuser, scene, chain_of(windows))
    assert [state.stamp_ns for state in states] == [frame.stamp_ns for frame in scene.frames]
    counts = fuser.counters()
    assert counts.get("windows without images", 0) == (5 if sensor != "imu" else 0)
    assert counts.get("windows without inertial samples", 0) == (4 if sensor != "camera" else 0)
    told = [state.status for state in states]
    assert ("lost" in told) == (sensor != "imu") and told[-1] == "tracking"
    if sensor != "imu":
        assert told[first + 4] == "lost"
    assert all(np.isfinite(state.T_world_body).all() for state in states)


def test_covariance_grows_faster_without_images_and_recovers(scene):
    front, fuser = encoder(), vinet(lively=False, blind_accel_sigma=20.0)
    windows = list(scene.windows)
    windows[3:8] = [blind(window, previous=k > 0, current=k < 4) for k, window in enumerate(windows[3:8])]
    states = stream(front, fuser, scene, chain_of(windows))
    placed = np.array([np.trace(state.covariance[3:6, 3:6]) for state in states])
    speed = np.array([np.trace(state.covariance[6:9, 6:9]) for state in states])
    assert (np.diff(placed) > 0).all()
    assert np.diff(placed)[6] > 1.1 * np.diff(placed)[2]
    assert speed[7] > 1.1 * speed[3] and speed[9] < 1.1 * speed[3]


def test_a_hole_makes_it_begin_anew(scene):
    front, fuser = encoder(), vinet(rotation="learned")
    states = stream(front, fuser, scene, [*scene.windows[:3], *scene.windows[6:8]])
    again = stream(front, fuser, scene, scene.windows[6:8], start=False)
    assert fuser.counters() == {} and len(states) == 6
    found, fresh = (
        se3.inverse(before.T_world_body) @ after.T_world_body for before, after in (states[-2:], again[-2:])
    )
    np.testing.assert_allclose(found, fresh, atol=1e-9)


def test_what_images_say_of_the_gyro_survives_a_hole(scene):
    """Images show no rotation, with little doubt: the gyro is taken to lack what it said, sooner after five pairs."""
    sizes = []
    for windows in (scene.windows[6:8], [*scene.windows[:3], *scene.windows[6:8]]):
        front, fuser = encoder(), vinet(lively=False, gyro_bias_sigma=1.0)
        with torch.no_grad():
            for name in ("sight", "doubt"):
                layer = fuser.net.get_submodule(f"core.gyro.{name}")
                layer.weight.zero_()
                layer.bias.zero_()
        states = stream(front, fuser, scene, windows, start=False)
        turn = so3.log(states[-2].T_world_body[:3, :3].T @ states[-1].T_world_body[:3, :3])
        sizes.append(np.linalg.norm(turn))
    truth = np.linalg.norm(so3.log(scene.truth.T_world_body[7, :3, :3].T @ scene.truth.T_world_body[8, :3, :3]))
    assert sizes[1] < 0.8 * sizes[0] < truth


def test_answers_that_are_no_numbers_are_counted_and_forgotten(scene):
    front, fuser = encoder(), vinet()
    front.setup(scene.rig)
    fuser.setup(scene.rig)
    fuser.start_from(given(scene))
    states = []
    for number, window in enumerate(scene.windows):
        embedding = np.full(8, np.nan if number == 4 else 0.1)
        states += fuser.update(
            Measurement(window=window, features=VisualFeatures(frame=window.current, embedding=embedding))
        )
    assert fuser.counters() == {"answers that are no numbers": 1}
    assert [state.status for state in states].count("lost") == 1
    assert all(np.isfinite(state.T_world_body).all() for state in states)


def test_a_window_that_is_missing_is_coasted_over(scene):
    fuser = vinet()
    fuser.setup(scene.rig)
    fuser.start_from(given(scene))
    features = [VisualFeatures(frame=frame, embedding=np.zeros(8)) for frame in scene.frames]
    for number in (0, 1, 5):
        states = fuser.update(Measurement(window=scene.windows[number], features=features[number + 1]))
    assert fuser.counters() == {"missing windows": 1}
    assert states[-1].stamp_ns == scene.windows[5].current.stamp_ns


def test_without_a_given_state_it_begins_level(scene):
    front, fuser = encoder(), vinet()
    states = stream(front, fuser, scene, scene.windows[:1], start=False)
    up = states[0].T_world_body[2, :3] @ scene.windows[0].imu.accel.mean(axis=0)
    assert up == pytest.approx(np.linalg.norm(scene.windows[0].imu.accel.mean(axis=0)), rel=1e-9)


@pytest.mark.parametrize("make", [encoder, vinet], ids=["encoder", "vinet"])
def test_weights_survive_the_disk_and_others_are_refused(make, tmp_path, scene):
    path = tmp_path / "w.safetensors"
    part = make()
    save_weights(path, part, {})
    again = make(weights=str(path))
    assert part.needs_training and not again.needs_training
    for name, tensor in part.net.state_dict().items():
        torch.testing.assert_close(again.net.state_dict()[name], tensor)
    other = {"features": 9} if make is encoder else {"imu_intervals": 5}
    key, value = next(iter(other.items()))
    with pytest.raises(DataError, match=f"{key}={8 if make is encoder else 10} where {value} is needed"):
        make(**other, weights=str(path)).setup(scene.rig)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"window": 0}, "fuser.window must be a whole number of 1 or more, got 0"),
        ({"settling": 0}, "fuser.settling must be a whole number of 1 or more, got 0"),
        ({"horizons": []}, "fuser.horizons must be whole numbers of 1 or more"),
        ({"imu_intervals": 2.5}, "fuser.imu_intervals must be a whole number"),
        ({"dropout": 1.0}, "fuser.dropout must be from 0 to below 1"),
        ({"lost_imu": 1.5}, r"fuser.lost_imu must lie in \[0, 1\], got 1.5"),
        ({"axes": "world"}, "fuser.axes must be one of camera, body, got 'world'"),
        ({"loss": "fixed"}, "fuser.loss must be one of learned, likelihood"),
        ({"rotation_unit_rad": 0.0}, "fuser.rotation_unit_rad must be positive"),
        ({"pose_weight": -1.0}, "fuser.pose_weight must not be negative"),
        ({"device": "tpu"}, "fuser.device must be one of"),
    ],
    ids=str,
)
def test_bad_options_are_refused(options, sentence):
    with pytest.raises(ConfigError, match=sentence):
        vinet(lively=False, **options)


def test_calls_and_data_that_cannot_work_are_refused(scene):
    front, fuser = encoder(), vinet()
    with pytest.raises(StateError, match="before setup"):
        front.process(scene.frames[0])
    with pytest.raises(StateError, match="before setup"):
        fuser.update(Measurement(window=scene.windows[0]))
    for part in (front, fuser):
        with pytest.raises((ConfigError, DataError), match="camera"):
            part.setup(dataclasses.replace(scene.rig, cameras=()))
    fuser.setup(scene.rig)
    wrong = VisualFeatures(frame=scene.frames[1], embedding=np.zeros(9))
    with pytest.raises(ConfigError, match="fuser.embedding=8, but the front end gives 9"):
        fuser.update(Measurement(window=scene.windows[0], features=wrong))
    windows = collate([cut_window(stored(scene), 0, 2)]).as_float()
    with pytest.raises(ConfigError, match="use frontend=pair_encoder"):
        fuser.forward_batch(windows, {})
    with pytest.raises(ConfigError, match="trainer.size_px makes training see 320×240"):
        encoder(size_px=(96, 64)).forward_batch(windows, {})


def test_one_word_makes_the_system():
    assert "vinet" in offered("system") and "vinet" in offered("fuser")
    for config in (composed("system=vinet"), composed("fuser=vinet")):
        assert not config.vo and not config.integrator
        pipeline = build_pipeline(config, {})
        assert isinstance(pipeline.frontend, PairEncoder) and isinstance(pipeline.fuser, VinetFuser)
        assert pipeline.fuser.architecture["embedding"] == pipeline.frontend.architecture["features"]
    assert composed("system=vinet", "frontend.features=64").fuser.embedding == 64
    assert list(composed("system=vinet", "trainer.size_px=[96,64]").frontend.size_px) == [96, 64]
