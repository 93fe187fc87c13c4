"""``task=evaluate_features`` as a user runs it, on sequences whose answer is known, and its options."""

import inspect
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from composing import composed, offered
from shared_data import shared_data
from vioframe.build import build, resolve_class
from vioframe.errors import ConfigError
from vioframe.features import FeatureProtocol
from vioframe.pictures.homographies import warp_picture
from vioframe.vision.keypoints import Extractor

QUICK = ("task=evaluate_features", "progress=false", "protocol.points=100")
METHODS = ("shi_tomasi", "fast", "orb", "sift")
CLASSICAL = f"task.chosen=[{','.join(METHODS)}]"


def write_sequence(folder: Path, homographies, size=(320, 240)) -> None:
    """A sequence in the layout of HPatches, of a picture and what the homographies make of it."""
    rng = np.random.default_rng(7)
    picture = np.full((size[1] + 80, size[0] + 80), 120, np.uint8)
    for _ in range(260):
        box = cv2.boxPoints((rng.uniform([0, 0], picture.shape[::-1]), rng.uniform(5, 26, 2), rng.uniform(0, 90)))
        cv2.fillConvexPoly(picture, box.astype(int), int(rng.integers(20, 236)))
    picture = cv2.GaussianBlur(picture, (0, 0), 0.7)
    inner = np.array([[1.0, 0.0, -40.0], [0.0, 1.0, -40.0], [0.0, 0.0, 1.0]])
    folder.mkdir(parents=True)
    cv2.imwrite(str(folder / "1.png"), warp_picture(picture, inner, size))
    for number, H in enumerate(homographies, start=2):
        cv2.imwrite(str(folder / f"{number}.png"), warp_picture(picture, H @ inner, size))
        np.savetxt(folder / f"H_1_{number}", H)


def test_known_sequences_from_the_command_line(cli, tmp_path):
    turn = np.array([[0.97, -0.16, 24.0], [0.16, 0.97, -20.0], [1e-4, 0.0, 1.0]])
    write_sequence(tmp_path / "pictures" / "i_same", [np.eye(3)] * 5)
    write_sequence(tmp_path / "pictures" / "v_turned", [turn] * 5)
    done = cli(
        *QUICK, CLASSICAL, "tracker=none", "task.hpatches=pictures", "task.match_pictures=2", "hydra.run.dir=out"
    )
    assert done.returncode == 0, done.stderr
    assert "illumination, 5 pairs" in done.stdout and "viewpoint, 5 pairs" in done.stdout
    folder = tmp_path / "out"
    document = json.loads((folder / "features.json").read_text())
    assert document["protocol"]["points"] == 100
    rows = {(row["method"], row["split"]): row for row in document["summaries"]}
    assert len(rows) == 3 * len(METHODS)
    for method in METHODS:
        same, turned = rows[method, "illumination"], rows[method, "viewpoint"]
        assert same["points"] == 100 and min(same["milliseconds"], same["cpu_milliseconds"]) > 0
        assert (same["repeatability"], same["localisation_px"]) == (1.0, pytest.approx(0.0, abs=1e-9))
        assert 0.4 < turned["repeatability"] < 1.0 and 0.0 < turned["localisation_px"] < 2.0
        described = method in ("orb", "sift")
        for row in (same, turned):
            assert (row["mean_average_precision"] is not None) == described
            assert (row["homography_accuracy"] is not None) == described
        if described:
            assert same["mean_average_precision"] == same["matching_score"] == 1.0
            assert same["homography_accuracy"] == [1.0] * 12
            assert turned["homography_accuracy"][4] == 1.0
    assert "–" in done.stdout, "what a detector does not have is no number"
    assert {path.name for path in (folder / "matches").iterdir()} == {"i_same_2.jpg", "v_turned_6.jpg"}
    assert (folder / "features.png").stat().st_size > 10_000
    page = (folder / "features.html").read_text()
    assert "i_same" in page and page.count("<img") == 1 + 2
    assert document["pairs"]["fast"][0]["descriptors"] is None
    assert len(document["pairs"]["sift"]) == 10


def test_one_method_that_cannot_be_built_does_not_stop_the_others(cli, tmp_path):
    write_sequence(tmp_path / "one" / "i_same", [np.eye(3)] * 5)
    words = (*QUICK, "tracker=none", "task.hpatches=one", "task.match_pictures=0", "hydra.run.dir=out")
    done = cli(*words, "task.chosen=[fast,sift]", "task.methods.sift.edge=0.5")
    assert done.returncode == 1
    assert "sift: feature.edge must be above 1, got 0.5" in done.stderr + done.stdout
    assert "Traceback" not in done.stderr
    rows = json.loads((tmp_path / "out" / "features.json").read_text())["summaries"]
    assert [row["method"] for row in rows] == ["fast"]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("task.chosen=[sieve]",), "task.chosen has sieve, but the methods are"),
        (("task.chosen=[]",), "task.chosen is empty"),
        (("task.pairs=0",), "task.pairs must be at least 1, got 0"),
        (("task.hpatches=nowhere",), "nowhere"),
        (("task.chosen=[fast]", "task.methods.fast.threshold=0"), "no method is left"),
    ],
)
def test_mistakes_are_one_sentence(cli, words, told):
    done = cli("task=evaluate_features", "tracker=none", CLASSICAL, *words)
    assert done.returncode == 1
    assert told in done.stderr + done.stdout
    assert "Traceback" not in done.stderr


def test_churchill(cli, tmp_path):
    """Real pictures of one plane: what SIFT and ORB reach there is known well enough to notice a mistake."""
    folder = shared_data("homographies", "hpatches_v_churchill")
    done = cli("task=evaluate_features", "tracker=none", CLASSICAL, f"task.hpatches={folder}", "hydra.run.dir=out")
    assert done.returncode == 0, done.stderr
    rows = {row["method"]: row for row in json.loads((tmp_path / "out" / "features.json").read_text())["summaries"]}
    assert {row["split"] for row in rows.values()} == {"viewpoint"} and rows["sift"]["pairs"] == 5
    assert all(0.4 < row["repeatability"] < 0.8 for row in rows.values())
    assert rows["sift"]["mean_average_precision"] > rows["orb"]["mean_average_precision"] > 0.1
    assert rows["sift"]["homography_accuracy"][4] >= 0.8
    assert rows["sift"]["matching_score"] > rows["orb"]["matching_score"]


@pytest.mark.parametrize("name", offered("protocol"))
def test_every_protocol_builds(name):
    config = composed("task=evaluate_features", f"protocol={name}")
    protocol = build(config, "protocol", FeatureProtocol)
    assert set(inspect.signature(FeatureProtocol).parameters) == set(config.protocol) - {"_target_"}
    assert str(protocol.points) in protocol.name and protocol.suppression_px == 4


@pytest.mark.parametrize("name", offered("feature"))
def test_every_method_builds_and_has_all_its_options_in_its_file(name):
    config = composed("task=evaluate_features", f"+feature@task.methods.again={name}")
    node = config.task.methods.again
    cls = resolve_class(node._target_, "task.methods.again")
    parameters = list(inspect.signature(cls.__init__).parameters.values())[1:]
    assert not [p for p in parameters if p.kind in (p.VAR_KEYWORD, p.VAR_POSITIONAL)]
    assert {p.name for p in parameters} == set(node) - {"_target_"}
    try:
        build(config, "task.methods.again", Extractor)
    except ConfigError as error:
        if "vioframe[learn]" not in str(error):
            raise
        pytest.skip(str(error))


def test_all_methods_are_evaluated_unless_some_are_chosen():
    assert set(METHODS) <= set(composed("task=evaluate_features").task.methods)
