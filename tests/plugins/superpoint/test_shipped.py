"""The weights that come with the plugin: whole, small, told of on their cards, better than corners in other light."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs torch: pip install 'vioframe[learn]'")
pytest.importorskip("safetensors", reason="needs safetensors: pip install 'vioframe[learn]'")

import vioframe_superpoint
from vioframe.features import FeatureProtocol
from vioframe.features.scoring import score_pair
from vioframe.learning.weights import read_card
from vioframe.pictures.pairs import generated_pairs
from vioframe_opencv import ShiTomasiExtractor
from vioframe_superpoint.extractor import SuperPointExtractor
from vioframe_superpoint.options import WIDTHS, encoder_named

FOLDER = Path(vioframe_superpoint.__file__).parent / "weights"
SHIPPED = sorted(path.stem for path in FOLDER.glob("*.safetensors"))
PROTOCOL = FeatureProtocol(
    name="300 points",
    width=320,
    height=240,
    points=300,
    suppression_px=4,
    border_px=4,
    correct_px=3.0,
    shared_only=True,
    max_distance=None,
    ransac_px=3.0,
    ransac_iterations=2000,
    ransac_confidence=0.999,
)


@pytest.fixture(scope="module")
def pairs():
    return list(generated_pairs("illumination", 6, (320, 240), 3))


def scores_of(method, pairs):
    return [score_pair("one", method, pair, PROTOCOL).scores for pair in pairs]


def test_the_default_encoder_is_shipped():
    assert "mobilenetv2" in SHIPPED
    assert set(SHIPPED) <= set(WIDTHS)


@pytest.mark.parametrize("name", SHIPPED)
def test_a_card_says_what_the_weights_came_from(name):
    file = FOLDER / f"{name}.safetensors"
    card = read_card(file)
    assert file.stat().st_size < 8_000_000
    assert card["licence"].startswith("Apache-2.0") and card["labels"]["pictures"]["folder"] is None
    assert card["iteration"] > 0 and card["hours"] > 0.0 and card["machine"]["device"] in ("cpu", "cuda")
    assert {"repeatability", "homography_accuracy"} <= {key.rpartition("/")[2] for key in card["validation"]}


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_points_come_back_in_other_light(name, pairs):
    corners = scores_of(ShiTomasiExtractor(count=300, suppression_px=4, subpixel=True), pairs)
    learned = SuperPointExtractor(
        encoder=encoder_named(name), device="cpu", fewest=300, lowest_threshold=1e-4, spread=False
    )
    found = scores_of(learned, pairs)
    gain = np.mean([one.repeatability - other.repeatability for one, other in zip(found, corners, strict=True)])
    assert gain > 0.05
    assert np.mean([each.descriptors.average_precision for each in found]) > 0.4
