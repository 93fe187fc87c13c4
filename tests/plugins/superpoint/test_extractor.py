"""Which points an extractor finds, and how exactly; with nets of random weights, and with heat that is known."""

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs torch: pip install 'vioframe[learn]'")
pytest.importorskip("safetensors", reason="needs safetensors: pip install 'vioframe[learn]'")

import torch

from vioframe.errors import ConfigError, DataError
from vioframe.interfaces import HasNet
from vioframe.learning.weights import save_weights
from vioframe_superpoint import Encoder, SuperPointExtractor, extractor
from vioframe_superpoint.net.inference import InferenceNet
from vioframe_superpoint.net.keypoints import heatmap, sample_descriptors
from vioframe_superpoint.net.superpoint import ENCODERS, make_net

ENCODER = pytest.mark.parametrize("encoder", ENCODERS)


def untrained(encoder="ghostnet", **options):
    torch.manual_seed(5)
    return SuperPointExtractor(
        encoder=Encoder(name=encoder, width=0.25), **{"weights": None, "device": "cpu", **options}
    )


class KnownHeat:
    """Stands for the net: heat as it was given, and a descriptor that says the place."""

    def __init__(self, heat):
        self.heat = torch.from_numpy(heat.astype(np.float32))[None]

    def detect(self, images):
        heat = torch.zeros(1, *images.shape[2:])
        heat[:, : self.heat.shape[1], : self.heat.shape[2]] = self.heat
        return heat, torch.zeros(1, 1, 1, 1)

    def describe(self, features, pixels):
        return torch.cat([pixels, torch.zeros(len(pixels), 254)], dim=1)


def found_in(heat, allowed=None, **options):
    made = untrained(**options)
    made._inference = KnownHeat(heat)
    gray = np.zeros(heat.shape, np.uint8)
    return made.extract(gray, np.full(heat.shape, 255, np.uint8) if allowed is None else allowed)


def peaks(values, shape=(120, 160), spacing=10):
    """Heat with one peak of each value, so many pixels apart."""
    heat = np.zeros(shape)
    rows, columns = np.meshgrid(np.arange(5, shape[0] - 5, spacing), np.arange(5, shape[1] - 5, spacing), indexing="ij")
    heat[rows.ravel()[: len(values)], columns.ravel()[: len(values)]] = values
    return heat


@ENCODER
def test_net_for_use_says_what_the_net_says(encoder):
    """With statistics and weights that a fold could get wrong, in an image whose map is not square."""
    torch.manual_seed(0)
    net = make_net(Encoder(name=encoder, width=0.5))
    for module in net.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            torch.nn.init.uniform_(module.weight, 0.5, 1.5)
            torch.nn.init.normal_(module.bias, std=0.3)
            torch.nn.init.normal_(module.running_mean, std=0.3)
            torch.nn.init.uniform_(module.running_var, 0.5, 1.5)
    net.eval()
    images = torch.rand(2, 1, 48, 72)
    pixels = torch.rand(2, 60, 2) * torch.tensor([71.0, 47.0])
    with torch.inference_mode():
        logits, maps = net(images)
        known = sample_descriptors(maps, pixels)
        quick = InferenceNet(net, half=False)
        heat, features = quick.detect(images)
        found = torch.stack([quick.describe(map_, where) for map_, where in zip(features, pixels, strict=True)])
    torch.testing.assert_close(heat, heatmap(logits))
    # Descriptors of a random net are much alike: what tells them apart must agree.
    apart = known - known.mean(dim=1, keepdim=True)
    assert float((found - known).norm()) < 1e-4 * float(apart.norm())


@pytest.mark.parametrize(
    ("values", "count"),
    [
        ([0.5] * 60 + [0.02] * 60, 120),
        ([0.5] * 60 + [0.0145] * 60, 120),
        ([0.5] * 120 + [0.0145] * 20, 120),
        ([0.5] * 60 + [0.0085] * 60, 120),
        ([0.5] * 60 + [0.0075] * 60, 60),
        ([0.5] * 60 + [0.0125] * 40 + [0.009] * 40, 100),
        ([], 0),
    ],
)
def test_threshold_is_lowered_until_there_are_enough(values, count):
    assert len(found_in(peaks(values), suppression_px=4)) == count


def test_points_are_spread_or_the_strongest():
    heat = peaks(np.linspace(0.9, 0.1, 150))
    strongest = found_in(heat, keypoints=40, spread=False)
    assert len(strongest) == 40
    assert strongest.scores.min() > 0.69 and strongest.pixels[:, 1].max() < 50
    spread = found_in(heat, keypoints=40, spread=True)
    assert len(spread) == 40
    assert spread.pixels[:, 1].max() > 70


def test_masked_points_are_left_out():
    allowed = np.full((120, 160), 255, np.uint8)
    allowed[:, 80:] = 0
    found = found_in(peaks([0.5] * 150), allowed)
    assert len(found) and found.pixels[:, 0].max() < 80


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.3, -0.4), (-0.25, 0.1)])
def test_heat_places_a_point_within_its_pixel(shift):
    rows, columns = np.mgrid[0:40.0, 0:48.0]
    centre = np.array([21.0 + shift[0], 17.0 + shift[1]])
    heat = 0.5 * np.exp(-((columns - centre[0]) ** 2 + (rows - centre[1]) ** 2) / (2 * 0.7**2))
    found = found_in(heat, refinement="heat", refinement_px=2, fewest=1)
    assert np.linalg.norm(found.pixels[0] - centre) < 0.05
    np.testing.assert_allclose(found.descriptors[0, :2], found.pixels[0], atol=1e-5)
    assert found_in(heat, refinement="none", fewest=1).pixels.tolist() == [[21.0, 17.0]]


def test_a_point_at_the_edge_stays_in_the_image():
    heat = np.zeros((16, 16))
    heat[0, 15] = 0.9
    assert found_in(heat, fewest=1).pixels.tolist() == [[15.0, 0.0]]


@ENCODER
@pytest.mark.parametrize("size", [(1, 1), (20, 28), (32, 31), (45, 61)])
@pytest.mark.parametrize("level", [0, 255, None])
def test_any_image_gives_points_within_it(encoder, size, level):
    rng = np.random.default_rng(0)
    gray = rng.integers(0, 256, size).astype(np.uint8) if level is None else np.full(size, level, np.uint8)
    found = untrained(encoder).extract(gray, np.full(size, 255, np.uint8))
    assert found.descriptors.dtype == np.float32 and found.descriptors.shape == (len(found), 256)
    assert ((found.pixels >= 0) & (found.pixels <= np.array(size[::-1]) - 1)).all()
    if level != 0:  # of nothing but zeros an untrained net makes zeros
        np.testing.assert_allclose(np.linalg.norm(found.descriptors, axis=1), 1.0, atol=1e-5)


@ENCODER
def test_many_images_are_the_same_as_one_by_one(encoder):
    rng = np.random.default_rng(1)
    grays = [rng.integers(0, 256, (60, 84)).astype(np.uint8) for _ in range(5)]
    made, allowed = untrained(encoder, batch=3), np.full((60, 84), 255, np.uint8)
    for many, gray in zip(made.extract_many(grays, allowed), grays, strict=True):
        one = made.extract(gray, allowed)
        for field in ("pixels", "scores", "descriptors"):
            assert np.array_equal(getattr(many, field), getattr(one, field)), field


def test_weights_come_back_and_those_of_another_encoder_are_refused(tmp_path):
    path = tmp_path / "ghostnet.safetensors"
    first = untrained("ghostnet")
    assert isinstance(first, HasNet)
    save_weights(path, first, {})
    gray = np.random.default_rng(2).integers(0, 256, (48, 64)).astype(np.uint8)
    allowed = np.full(gray.shape, 255, np.uint8)
    torch.manual_seed(99)
    again = SuperPointExtractor(encoder=Encoder(name="ghostnet", width=0.25), weights=str(path), device="cpu")
    assert np.array_equal(first.extract(gray, allowed).descriptors, again.extract(gray, allowed).descriptors)
    with pytest.raises(DataError, match="encoder='ghostnet' where 'vgg' is needed"):
        untrained("vgg", weights=str(path)).prepare()
    with pytest.raises(ConfigError, match=r"feature\.weights=.*no such file"):
        untrained(weights=str(tmp_path / "none.safetensors"), slot="feature").prepare()


def test_missing_shipped_weights_are_one_sentence(tmp_path, monkeypatch):
    monkeypatch.setattr(extractor, "_FOLDER", tmp_path)
    made = untrained("vgg", weights="shipped")
    with pytest.raises(ConfigError, match=r"frontend\.weights=shipped: no weights of encoder=vgg came with") as caught:
        made.prepare()
    assert "task=train frontend=superpoint encoder=vgg" in str(caught.value)
    save_weights(tmp_path / "vgg.safetensors", untrained("vgg"), {})
    untrained("vgg", weights="shipped").prepare()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"keypoints": 0}, "keypoints must be at least 1, got 0"),
        ({"threshold": 1.0}, "threshold must be between 0 and 1"),
        ({"lowest_threshold": 0.02}, "lowest_threshold must be above 0 and at most threshold"),
        ({"suppression_px": -1}, "suppression_px must be not negative"),
        ({"refinement": "parabola"}, "refinement must be one of heat, gradient, none"),
        ({"refinement_px": 0}, "refinement_px must be from 1 to 20"),
        ({"batch": 0}, "batch"),
        ({"device": "tpu"}, "device must be one of"),
    ],
)
def test_refuses_options_outside_their_range(options, message):
    with pytest.raises(ConfigError, match=message):
        untrained(**options)
