"""The front end: batches as streams, what a bad image does, and which front end an encoder comes with."""

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs torch: pip install 'vioframe[learn]'")
pytest.importorskip("safetensors", reason="needs safetensors: pip install 'vioframe[learn]'")

import torch

from composing import composed
from vioframe.errors import ConfigError, DataError
from vioframe.interfaces import Trainable
from vioframe.learning.figures import model_figures
from vioframe.tasks.model_card import model_card
from vioframe.testing import make_scene
from vioframe.types import Frame
from vioframe_superpoint import Encoder, SuperPointFrontend


def frontend(encoder="ghostnet", **options):
    torch.manual_seed(5)
    return SuperPointFrontend(
        encoder=Encoder(name=encoder, width=0.25), **{"weights": None, "device": "cpu", **options}
    )


@pytest.fixture(scope="module")
def scene():
    return make_scene()


@pytest.mark.parametrize("stereo", [False, True])
def test_many_frames_are_the_same_as_one_by_one(scene, stereo):
    part, frames = frontend(stereo=stereo, batch=3), scene.frames[:7]
    part.setup(scene.rig)
    one_by_one = [part.process(frame) for frame in frames]
    part.setup(scene.rig)
    together = part.process_many(iter(frames))
    assert len(together) == len(one_by_one)
    assert any((found.tracks.scores > 1).sum() > 20 for found in together)
    for many, one in zip(together, one_by_one, strict=True):
        assert many.frame is one.frame
        for kind in ("tracks", "stereo", "untracked"):
            a, b = getattr(many, kind), getattr(one, kind)
            assert (a is None) == (b is None) == (kind == "stereo" and not stereo)
            for field in ("ids", "pixels", "bearings", "scores", "descriptors"):
                if a is not None and hasattr(a, field):
                    assert np.array_equal(getattr(a, field), getattr(b, field)), (kind, field)


def test_its_net_is_weighed(scene):
    part = frontend("vgg")
    card = model_card(part, "frontend=superpoint")
    assert model_figures({"frontend": part}) == {"frontend.parameters": card.parameters, "parameters": card.parameters}
    # Of a copy with normalisation folded in, which layers of the net itself do not see: the first layer alone costs
    # 9 multiplications for each of 16 channels of each pixel.
    height, width = scene.frames[0].images[0].shape[:2]
    assert card.macs > 9 * 16 * height * width
    assert not card.uncounted and 0.0 < card.answer_ms < 5000.0


def test_points_are_followed_or_not_but_never_both(scene):
    part = frontend(max_points=30, keypoints=200)
    part.setup(scene.rig)
    for frame in scene.frames[:3]:
        found = part.process(frame, np.eye(3))
        assert len(found.tracks.ids) <= 30 < len(found.tracks.ids) + len(found.untracked)
        assert found.untracked.descriptors.shape == (len(found.untracked), 256)
        places = np.concatenate([found.tracks.pixels, found.untracked.pixels])
        assert len(np.unique(places, axis=0)) == len(places)


def test_colour_is_seen_as_grey(scene):
    part = frontend()
    part.setup(scene.rig)
    gray = part.process(scene.frames[0])
    colour = tuple(np.repeat(image[..., None], 3, axis=2) for image in scene.frames[0].images)
    part.setup(scene.rig)
    seen = part.process(Frame(stamp_ns=scene.frames[0].stamp_ns, images=colour))
    assert np.array_equal(seen.tracks.pixels, gray.tracks.pixels)


@pytest.mark.parametrize("level", [0, 255])
def test_an_empty_image_has_no_points_and_the_next_one_has(scene, level, monkeypatch):
    """An untrained net sees points everywhere; that of a uniform image is made to see none, as a trained one does."""
    part = frontend(max_points=50)
    part.setup(scene.rig)
    part.process(scene.frames[0])
    detect = part._superpoint._inference.detect

    def blind(images):
        heat, features = detect(images)
        return heat * float(images.std() > 0.01), features

    monkeypatch.setattr(part._superpoint._inference, "detect", blind)
    blank = tuple(np.full_like(image, level) for image in scene.frames[1].images)
    nothing = part.process(Frame(stamp_ns=scene.frames[1].stamp_ns, images=blank))
    assert len(nothing.tracks) == 0 and nothing.tracks.descriptors.shape == (0, 256)
    assert part.counters() == {"lost all tracks": 1}
    assert len(part.process(scene.frames[2]).tracks)


def test_it_is_not_trained_on_windows_of_recordings():
    assert not isinstance(frontend(), Trainable)


def test_needs_a_camera_and_its_images(scene):
    part = frontend()
    part.setup(scene.rig)
    with pytest.raises(DataError, match="frontend=superpoint needs one"):
        part.process(Frame(stamp_ns=0))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_distance": 2.5}, "frontend.max_distance must be above 0 and at most 2, got 2.5"),
        ({"max_points": 400}, "frontend.keypoints must be at least max_points=400"),
        ({"border_px": 0}, "frontend.border_px must be at least 1"),
    ],
)
def test_refuses_options_outside_their_range(options, message):
    with pytest.raises(ConfigError, match=message):
        frontend(**options)


@pytest.mark.parametrize("encoder", ["vgg", "mobilenetv2", "ghostnet"])
def test_six_jobs_of_the_comparison_compose(encoder):
    learned = composed("system=cnn_vins", f"encoder={encoder}")
    assert "superpoint" in learned.frontend._target_ and learned.frontend.encoder.name == encoder
    assert "_target_" in learned.fuser.loop
    assert "klt" in composed("system=vins_mono", f"encoder={encoder}").frontend._target_


def test_an_encoder_alone_brings_its_front_end():
    assert composed("encoder=vgg").frontend.encoder.name == "vgg"
    assert composed("frontend=superpoint").frontend.encoder.name == "mobilenetv2"
    assert "klt" in composed("encoder=vgg", "frontend=klt").frontend._target_
