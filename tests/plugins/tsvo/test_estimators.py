"""The estimators: the contract, streams that answer as batches do, weights on disk, and what is refused."""

import dataclasses
import itertools

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs torch: pip install 'vioframe[learn]'")
pytest.importorskip("safetensors", reason="needs safetensors: pip install 'vioframe[learn]'")

import torch

from composing import composed, offered
from learned_scenes import stored
from vioframe.build import build
from vioframe.data.windows import cut_window
from vioframe.errors import ConfigError, DataError, StateError
from vioframe.geometry import se3
from vioframe.interfaces import FLOW, METRIC_SCALE, Trainable, VOEstimator
from vioframe.learning.batch import collate
from vioframe.learning.weights import save_weights
from vioframe.testing import check_component, make_scene
from vioframe.types import Frame, VisualFeatures
from vioframe_tsvo import Backbone, DeepVo, Tsvo

STACK = 3


def tsvo(**options):
    torch.manual_seed(7)
    small = {"stack": STACK, "size_px": (320, 240), "flow_size_px": (96, 96), "width": 0.1, "hidden": 32}
    return Tsvo(**{"backbone": Backbone(name="googlenet"), **small, "device": "cpu", **options})


def deepvo(**options):
    torch.manual_seed(7)
    small = {"window": STACK, "size_px": (320, 240), "width": 0.1, "hidden": 32, "device": "cpu"}
    return DeepVo(**{**small, **options})


MAKERS = pytest.mark.parametrize("make", [tsvo, deepvo], ids=["tsvo", "deepvo"])


@pytest.fixture(scope="module")
def scene():
    """The conformance scene with some flow, which is zero at its first image."""
    found = make_scene()
    rng = np.random.default_rng(0)
    flows = [20.0 * rng.standard_normal((240, 320, 2)).astype(np.float32) for _ in found.features]
    flows[0][:] = 0.0
    features = [dataclasses.replace(one, flow=flow) for one, flow in zip(found.features, flows, strict=True)]
    return dataclasses.replace(found, features=features)


@pytest.fixture(scope="module")
def batch(scene):
    """Two windows of five pairs: images 0 to 5 and 4 to 9; and the flows over their pairs, right and down first."""
    sequence = stored(scene)
    flows = torch.from_numpy(np.stack([features.flow for features in scene.features])).permute(0, 3, 1, 2)
    upstream = {FLOW: torch.stack([flows[1:6], flows[5:10]])}
    return collate([cut_window(sequence, start, 5) for start in (0, 4)]).as_float(), upstream


def enliven(part):
    """Statistics and answers that depend on what is seen, as after a training."""
    torch.manual_seed(8)
    for module in part.net.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            torch.nn.init.uniform_(module.running_mean, -0.1, 0.1)
            torch.nn.init.uniform_(module.running_var, 0.5, 1.5)
    return part


@MAKERS
def test_contract(make):
    part = make()
    check_component(part)
    assert METRIC_SCALE in part.provides
    assert isinstance(part, Trainable)


@MAKERS
def test_a_stream_answers_as_a_batch_does(make, scene, batch):
    part = enliven(make())
    part.setup(scene.rig)
    windows, upstream = batch
    with torch.no_grad():
        expected = part.forward_batch(windows, upstream)["T_prev_cur"].numpy()
    assert expected.shape == (2, 5 - STACK + 1, 4, 4)
    for row, first in enumerate((0, 4)):
        part.setup(scene.rig)
        features = scene.features[first : first + 6]
        answers = [part.estimate(a, b).T_prev_cur for a, b in itertools.pairwise(features)]
        np.testing.assert_allclose(answers[STACK - 1 :], expected[row], rtol=1e-5, atol=1e-5)
    assert not np.allclose(expected[0, -1], expected[1, -1], atol=1e-4), "it answers the same, whatever it sees"


@MAKERS
def test_a_hole_makes_it_begin_anew(make, scene):
    part = enliven(make())

    def answers(numbers, calls):
        part.setup(scene.rig)
        return [part.estimate(scene.features[a], scene.features[b]).T_prev_cur for a, b in calls][numbers]

    fresh = answers(-1, [(6, 7)])
    np.testing.assert_array_equal(answers(-1, [(0, 1), (1, 2), (2, 3), (6, 7)]), fresh)
    assert not np.allclose(answers(-1, [(4, 5), (5, 6), (6, 7)]), fresh, atol=1e-6)


def test_answers_from_a_short_stack_are_counted(scene):
    part = tsvo()
    part.setup(scene.rig)
    for previous, current in zip(scene.features[:6], scene.features[1:6], strict=False):
        part.estimate(previous, current)
    assert part.counters() == {"answers from a short stack": STACK - 1}


@MAKERS
def test_training_reaches_every_parameter(make, batch):
    part = make(loss="learned")
    part.net.train()
    windows, upstream = batch
    losses = part.loss(part.forward_batch(windows, upstream), windows)
    losses["loss"].backward()
    for name, parameter in part.net.named_parameters():
        assert parameter.grad is not None and torch.isfinite(parameter.grad).all(), name


@MAKERS
@pytest.mark.parametrize("rotation", ["log", "euler"])
def test_the_loss_of_the_truth_is_nothing(make, rotation, batch):
    """With the true motions as vectors, in rad and metres, nothing is left to pay for."""
    from vioframe.learning.motion import vector_from_motion

    part = make(loss="fixed", rotation=rotation)
    windows, _ = batch
    truth = vector_from_motion(windows.T_prev_cur, rotation)
    assert part.loss({"motion": truth[:, -2:]}, windows)["loss"].item() < 1e-10
    wrong = truth + torch.tensor([0.0, 0.01, 0.0, 0.0, 0.0, 0.1])
    assert part.loss({"motion": wrong}, windows)["loss"].item() == pytest.approx(100 * 0.01**2 + 0.1**2, rel=1e-4)


@MAKERS
def test_units_are_what_an_output_of_one_means(make, scene, batch):
    windows, upstream = batch
    outputs = []
    for rotation_unit, translation_unit in ((1.0, 1.0), (0.1, 5.0)):
        part = make(rotation_unit_rad=rotation_unit, translation_unit_m=translation_unit)
        part.net.eval()
        with torch.no_grad():
            outputs.append(part.forward_batch(windows, upstream)["motion"])
    torch.testing.assert_close(outputs[1], outputs[0] * torch.tensor([0.1] * 3 + [5.0] * 3))


@MAKERS
def test_likelihood_states_a_covariance(make, scene):
    part = make(loss="likelihood", rotation_unit_rad=0.1, translation_unit_m=2.0)
    part.setup(scene.rig)
    head = part.net.get_submodule("motion.head.linear")
    with torch.no_grad():
        head.weight.zero_()
        head.bias[6:] = torch.tensor([2.0, 2.0, 2.0, -1.0, -1.0, -1.0])
    relative = part.estimate(scene.features[0], scene.features[1])
    np.testing.assert_allclose(relative.T_prev_cur, np.eye(4), atol=1e-12)
    expected = np.diag([np.exp(2.0) * 0.1**2] * 3 + [np.exp(-1.0) * 2.0**2] * 3)
    np.testing.assert_allclose(relative.covariance, expected, rtol=1e-6, atol=1e-12)
    plain = make()
    plain.setup(scene.rig)
    assert plain.estimate(scene.features[0], scene.features[1]).covariance is None


def test_flow_of_another_size_is_brought_to_that_of_the_net(scene):
    """Twice the pixels, twice the vectors: the same motion of the image."""
    part = enliven(tsvo())
    answers = []
    for factor in (1, 2):
        flow = factor * np.full((240 * factor, 320 * factor, 2), (6.0, -3.0), np.float32)
        part.setup(scene.rig)
        current = dataclasses.replace(scene.features[1], flow=flow)
        answers.append(part.estimate(scene.features[0], current).T_prev_cur)
    np.testing.assert_allclose(answers[0], answers[1], atol=1e-6)


@MAKERS
def test_images_of_another_size_or_in_colour_are_taken(make, scene):
    part = enliven(make(gray=True))
    part.setup(scene.rig)
    gray = part.estimate(scene.features[0], scene.features[1]).T_prev_cur
    part.setup(scene.rig)
    coloured = [
        dataclasses.replace(each, frame=Frame(stamp_ns=each.frame.stamp_ns, images=(np.stack([image] * 3, axis=-1),)))
        for each in scene.features[:2]
        for image in (each.frame.images[0].repeat(2, axis=0).repeat(2, axis=1),)
    ]
    np.testing.assert_allclose(part.estimate(*coloured).T_prev_cur, gray, atol=1e-6)


@MAKERS
def test_numbers_that_are_not_finite_are_no_motion(make, scene):
    part = make()
    part.setup(scene.rig)
    with torch.no_grad():
        part.net.get_submodule("motion.head.linear").bias.fill_(float("nan"))
    assert not part.estimate(scene.features[0], scene.features[1]).valid


@MAKERS
def test_a_random_net_is_told_of_once_and_a_trained_one_never(make, scene, batch, caplog):
    part, trained = make(), make()
    for _ in range(2):
        part.setup(scene.rig)
    assert caplog.text.count("has no weights") == 1
    caplog.clear()
    trained.forward_batch(*batch)
    trained.setup(scene.rig)
    assert not caplog.text


@MAKERS
def test_weights_survive_the_disk(make, scene, tmp_path):
    part = enliven(make())
    part.setup(scene.rig)
    expected = part.estimate(scene.features[0], scene.features[1]).T_prev_cur
    save_weights(tmp_path / "w.safetensors", part, {})
    again = make(weights=str(tmp_path / "w.safetensors"))
    again.setup(scene.rig)
    np.testing.assert_array_equal(again.estimate(scene.features[0], scene.features[1]).T_prev_cur, expected)


def test_weights_of_another_net_are_refused(scene, tmp_path):
    path = tmp_path / "w.safetensors"
    save_weights(path, tsvo(), {})
    with pytest.raises(DataError, match="stack=3 where 4 is needed"):
        tsvo(stack=4, weights=str(path)).setup(scene.rig)
    with pytest.raises(DataError, match="backbone='googlenet' where 'resnet50' is needed"):
        tsvo(backbone=Backbone(name="resnet50"), weights=str(path)).setup(scene.rig)
    with pytest.raises(DataError, match="holds weights of 'tsvo', not of 'deepvo'"):
        deepvo(weights=str(path)).setup(scene.rig)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(DataError, match="not a whole safetensors file"):
        tsvo(weights=str(path)).setup(scene.rig)
    with pytest.raises(ConfigError, match="no such file"):
        tsvo(weights=str(tmp_path / "none.safetensors")).setup(scene.rig)


def test_trained_weights_need_no_imagenet_file(scene, tmp_path):
    path = tmp_path / "w.safetensors"
    save_weights(path, tsvo(), {})
    moved = Backbone(name="googlenet", weights=str(tmp_path / "not here.pth"))
    tsvo(backbone=moved, weights=str(path)).setup(scene.rig)
    with pytest.raises(DataError, match="backbone.weights: there is no file"):
        tsvo(backbone=moved).setup(scene.rig)


def test_a_refused_file_leaves_no_net_behind(tmp_path):
    save_weights(tmp_path / "w.safetensors", tsvo(), {})
    part = tsvo(stack=4, weights=str(tmp_path / "w.safetensors"))
    for _ in range(2):
        with pytest.raises(DataError, match="another architecture"):
            _ = part.net


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"stack": 0}, "vo.stack must be positive, got 0"),
        ({"size_px": (320,)}, r"vo.size_px must be \[width, height\]"),
        ({"flow_size_px": (8, 96)}, "vo.flow_size_px must be"),
        ({"dropout": 1.0}, "vo.dropout must be from 0 to below 1, got 1.0"),
        ({"rotation": "quaternion"}, "vo.rotation must be one of log, euler, got 'quaternion'"),
        ({"loss": "l3"}, "vo.loss must be one of learned, fixed, likelihood, got 'l3'"),
        ({"rotation_weight": 0.0}, "vo.rotation_weight must be positive"),
        ({"device": "tpu"}, "vo.device must be one of"),
    ],
    ids=str,
)
def test_bad_options_are_refused(options, sentence):
    with pytest.raises(ConfigError, match=sentence):
        tsvo(**options)


def test_bad_options_that_only_the_net_knows_are_refused_at_setup(scene):
    with pytest.raises(ConfigError, match="backbone.name must be one of googlenet, resnet50, inceptionv3, got 'vgg'"):
        tsvo(backbone=Backbone(name="vgg")).setup(scene.rig)
    with pytest.raises(ConfigError, match="vo.window must be positive"):
        deepvo(window=0)
    with pytest.raises(ConfigError, match="vo.lstm_dropout must be from 0"):
        deepvo(lstm_dropout=-0.1)


def test_calls_and_data_that_cannot_work_are_refused(scene, batch):
    part = tsvo()
    with pytest.raises(StateError, match="before setup"):
        part.estimate(scene.features[0], scene.features[1])
    with pytest.raises(DataError, match="needs a camera"):
        part.setup(dataclasses.replace(scene.rig, cameras=()))
    part.setup(scene.rig)
    with pytest.raises(DataError, match="needs flow"):
        part.estimate(scene.features[0], VisualFeatures(frame=scene.frames[1]))
    with pytest.raises(DataError, match="has no image"):
        part.estimate(scene.features[0], VisualFeatures(frame=Frame(stamp_ns=1), flow=scene.features[1].flow))
    windows, upstream = batch
    with pytest.raises(ConfigError, match="use frontend=dis or frontend=tvnet"):
        part.forward_batch(windows, {})
    with pytest.raises(ConfigError, match="trainer.size_px makes training see 320×240 px, but vo.size_px is 96×64"):
        deepvo(size_px=(96, 64)).forward_batch(windows, {})
    with pytest.raises(ConfigError, match="frontend.size_px makes training see 160×240 px, but vo.size_px is 320×240"):
        part.forward_batch(windows, {FLOW: upstream[FLOW][..., ::2]})
    with pytest.raises(DataError, match="windows have 5 pairs of images, but vo.stack=6"):
        tsvo(stack=6).forward_batch(windows, upstream)
    with pytest.raises(DataError, match="vo.window=6"):
        deepvo(window=6).forward_batch(windows, {})


@pytest.mark.parametrize("backbone", ["googlenet", "resnet50", "inceptionv3"])
def test_one_word_chooses_the_backbone(backbone):
    config = composed("vo=tsvo", f"backbone={backbone}", "vo.stack=5")
    assert (config.vo.backbone.name, config.vo.stack) == (backbone, 5)
    assert "dis" in str(config.frontend._target_).lower()
    part = build(config, "vo", VOEstimator, "tsvo")
    assert (part.architecture["backbone"], part.architecture["stack"]) == (backbone, 5)


@pytest.mark.parametrize("backbone", offered("backbone"))
def test_every_field_of_a_backbone_is_in_its_yaml(backbone):
    fields = {each.name for each in dataclasses.fields(Backbone)}
    assert set(composed("vo=tsvo", f"backbone={backbone}").backbone) == fields | {"_target_"}


def test_what_the_user_writes_wins():
    assert "dis" in str(composed("vo=tsvo", "frontend=dis").frontend._target_).lower()
    assert not composed("vo=deepvo").frontend


def test_poses_are_rigid(scene):
    part = enliven(tsvo())
    part.setup(scene.rig)
    T = part.estimate(scene.features[0], scene.features[1]).T_prev_cur
    np.testing.assert_allclose(se3.inverse(T) @ T, np.eye(4), atol=1e-12)
