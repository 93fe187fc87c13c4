"""Methods that know the truth get full marks, and those that break the protocol are refused."""

import cv2
import numpy as np
import pytest

from vioframe.errors import ConfigError
from vioframe.features import EPSILONS_PX, evaluate_pairs, score_pair, summarise
from vioframe.pictures.homographies import warp_picture, warp_points
from vioframe.pictures.pairs import PicturePair
from vioframe.vision.keypoints import Keypoints

SIZE = (320, 240)
TRUE = np.array([[0.95, -0.12, 21.0], [0.1, 1.02, -14.0], [1e-4, -6e-5, 1.0]])


def picture(seed=4):
    rng = np.random.default_rng(seed)
    image = np.full((240, 320), 110, np.uint8)
    for _ in range(120):
        box = cv2.boxPoints((rng.uniform([0, 0], SIZE), rng.uniform(6, 30, 2), rng.uniform(0, 90)))
        cv2.fillConvexPoly(image, box.astype(int), int(rng.integers(20, 236)))
    return image


def pair_of(H, name="pair", split="viewpoint"):
    first = picture()
    return PicturePair(first=first, second=warp_picture(first, H), H_second_first=H, name=name, split=split)


class Oracle:
    """Gives the same points of the scene in both pictures of a pair, in turn, with a number of each as descriptor."""

    def __init__(self, H, count=100, noise_px=0.0, described=True, kind=np.float32):
        grid = np.stack(np.meshgrid(np.arange(60.0, 270, 14), np.arange(60.0, 190, 14)), axis=-1).reshape(-1, 2)
        rng = np.random.default_rng(0)
        self.points = rng.permutation(grid)[:count]
        width = (16 if kind is np.uint8 else 8) if described else 0
        numbers = rng.integers(0, 256, (count, width)) if kind is np.uint8 else rng.normal(size=(count, width))
        self.descriptors = numbers.astype(kind)
        self.views = [self.points, warp_points(self.points, H) + np.array([noise_px, 0.0])]
        self.calls = 0

    def extract(self, gray, allowed):
        pixels = self.views[self.calls % 2]
        self.calls += 1
        return Keypoints(pixels=pixels, scores=np.ones(len(pixels)), descriptors=self.descriptors)


@pytest.mark.parametrize("kind", [np.float32, np.uint8])
@pytest.mark.parametrize("H", [np.eye(3), TRUE], ids=["identity", "homography"])
def test_full_marks(make_protocol, H, kind):
    scores = score_pair("oracle", Oracle(H, kind=kind), pair_of(H), make_protocol()).scores
    assert scores.points == (100, 100)
    assert (scores.repeatability, scores.localisation_px) == (1.0, pytest.approx(0.0, abs=1e-9))
    one = scores.descriptors
    assert (one.average_precision, one.matching_score, one.matches, one.correct) == (1.0, 1.0, 100, 100)
    assert one.corner_error_px < 1e-2


def test_a_shift_of_two_pixels_is_told(make_protocol):
    scores = score_pair("oracle", Oracle(TRUE, noise_px=2.0), pair_of(TRUE), make_protocol()).scores
    assert (scores.repeatability, scores.localisation_px) == (1.0, pytest.approx(2.0))
    assert scores.descriptors.corner_error_px == pytest.approx(2.0, abs=1e-2)
    strict = score_pair("oracle", Oracle(TRUE, noise_px=2.0), pair_of(TRUE), make_protocol(correct_px=1.5)).scores
    assert (strict.repeatability, strict.descriptors.correct, strict.descriptors.average_precision) == (0.0, 0, 0.0)


def test_without_descriptors_their_numbers_are_absent(make_protocol):
    scores = score_pair("bare", Oracle(TRUE, described=False), pair_of(TRUE), make_protocol()).scores
    assert scores.descriptors is None and scores.repeatability == 1.0
    (summary,) = summarise("bare", [scores])
    assert summary.mean_average_precision is None and summary.homography_accuracy is None
    assert "matching_score" not in summary.numbers() and "homography_3px" not in summary.numbers()


def test_a_blind_method_scores_zero_and_not_nothing(make_protocol):
    scores = score_pair("blind", Oracle(TRUE, count=0), pair_of(TRUE), make_protocol()).scores
    assert (scores.points, scores.repeatability, scores.localisation_px) == ((0, 0), 0.0, None)
    assert scores.descriptors.average_precision == scores.descriptors.matching_score == 0.0
    assert scores.descriptors.corner_error_px == float("inf")
    (summary,) = summarise("blind", [scores])
    assert summary.homography_accuracy == (0.0,) * len(EPSILONS_PX)


def test_points_outside_the_shared_area_count_in_no_share_but_are_matched(make_protocol):
    away = np.array([[1.0, 0.0, 150.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    oracle = Oracle(np.eye(3))
    with pytest.raises(ConfigError, match="must heed"):
        score_pair("oracle", oracle, pair_of(away), make_protocol())
    oracle.calls = 0
    scores = score_pair("oracle", oracle, pair_of(away), make_protocol(shared_only=False)).scores
    inside = (oracle.points[:, 0] < 320 - 150 - 4).sum(), (oracle.points[:, 0] > 150 + 4).sum()
    assert scores.points == pytest.approx(inside, abs=10)
    assert scores.descriptors.matches == 100


def test_more_points_than_allowed_are_refused(make_protocol):
    with pytest.raises(ConfigError, match=r"task\.methods\.many returned 100 points where protocol\.points=50"):
        score_pair("many", Oracle(TRUE), pair_of(TRUE), make_protocol(points=50))


def test_means_by_split_and_over_all(make_protocol):
    pairs = [pair_of(TRUE, "a", "viewpoint"), pair_of(TRUE, "b", "illumination"), pair_of(TRUE, "c", "illumination")]
    methods = {"good": Oracle(TRUE), "off": Oracle(TRUE, noise_px=2.0)}
    seen = [one for _, one in evaluate_pairs(methods, pairs, make_protocol())]
    summaries = summarise("off", [one["off"].scores for one in seen])
    assert [(one.split, one.pairs) for one in summaries] == [("viewpoint", 1), ("illumination", 2), ("all", 3)]
    assert summaries[0].repeatability_error is None and summaries[2].repeatability_error == 0.0
    assert (summaries[2].accuracy_at(1), summaries[2].accuracy_at(3)) == (0.0, 1.0)
    assert summaries[2].numbers()["homography_3px"] == 1.0
    assert summaries[2].milliseconds > 0.0
    (good,) = summarise("good", [seen[0]["good"].scores])
    assert good.accuracy_at(1) == 1.0


def test_pictures_without_anything_in_common_are_left_out(make_protocol, caplog):
    away = np.array([[1.0, 0.0, 316.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    pairs = [pair_of(away, "apart"), pair_of(TRUE, "together")]
    seen = list(evaluate_pairs({"oracle": Oracle(TRUE)}, pairs, make_protocol()))
    assert [pair.name for pair, _ in seen] == ["together"]
    assert "apart is left out" in caplog.text


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"points": 0}, "protocol.points must be positive, got 0"),
        ({"suppression_px": -1}, "protocol.suppression_px must not be negative"),
        ({"width": 31}, "protocol.width must be at least 32"),
        ({"ransac_confidence": 1.0}, "protocol.ransac_confidence"),
        ({"max_distance": 0.0}, "protocol.max_distance"),
    ],
)
def test_protocols_that_cannot_work(make_protocol, changes, words):
    with pytest.raises(ConfigError, match=words):
        make_protocol(**changes)
