"""SuperPoint's training: options, labels, pairs, adaptation, and stages that can be stopped and gone on with."""

import json
import re
import shutil
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs torch (extra learn)")

from filelock import FileLock  # noqa: E402
from omegaconf import OmegaConf  # noqa: E402

import vioframe_superpoint  # noqa: E402
from vioframe.errors import ConfigError, DataError  # noqa: E402
from vioframe.interfaces import TrainsItself  # noqa: E402
from vioframe.learning.weights import read_card  # noqa: E402
from vioframe.pictures import HomographyOptions, LightingOptions, warp_points  # noqa: E402
from vioframe.tasks.train import check_own_training, folder_to_resume  # noqa: E402
from vioframe.tracking import NullTracker  # noqa: E402
from vioframe_superpoint.net.superpoint import make_net  # noqa: E402
from vioframe_superpoint.options import Encoder  # noqa: E402
from vioframe_superpoint.training import (  # noqa: E402
    AdaptationOptions,
    PairOptions,
    PictureOptions,
    ShapesOptions,
    SparseTripletLoss,
    TrainingOptions,
    stages,
)
from vioframe_superpoint.training.adaptation import adapted_heat, points_of, refined  # noqa: E402
from vioframe_superpoint.training.labels import LabelStore, cell_classes, whole_cells  # noqa: E402
from vioframe_superpoint.training.pairs import make_pair  # noqa: E402
from vioframe_superpoint.training.schedule import RateOptions, rate_factor  # noqa: E402
from vioframe_superpoint.training.steps import ShapesLoss  # noqa: E402

STILL = LightingOptions(**{name: 0.0 for name in LightingOptions.__dataclass_fields__})
ENCODER = Encoder(name="mobilenetv2", width=0.25)
ARCHITECTURE = {"part": "superpoint", "encoder": "mobilenetv2", "width": 0.25}
PAIRS = PairOptions(
    size_px=[64, 48], scale=[0.7, 1.2], homographies=HomographyOptions(), lighting=STILL, matches=24, labelled=0.5
)
OPTIONS = TrainingOptions(
    seed=3,
    iterations=6,
    batch_size=2,
    learning_rate=1e-3,
    schedule="cosine",
    warmup=2,
    weight_decay=0.0,
    gradient_clip=10.0,
    save_every=2,
    validate_every=4,
    max_minutes=None,
    precision="32",
    workers=0,
    labels=None,
    detector=None,
    descriptor_loss=SparseTripletLoss(weight=1.2, margin=1.0, negatives=16, radius_px=8.0, both_ways=True),
    pictures=PictureOptions(count=4, size_px=[96, 64], folder=None, places=0.0, held_out=2),
    shapes=ShapesOptions(iterations=4, batch_size=2, size_px=[64, 48], learning_rate=1e-3, corner_weight=8.0),
    adaptation=AdaptationOptions(
        homographies=4,
        threshold=0.001,
        nms_radius_px=4,
        border_px=3,
        max_points=50,
        least_views=0.1,
        batch_size=2,
        ranges=HomographyOptions(),
    ),
    pairs=PAIRS,
)


class Blocks:
    """Pictures of grey blocks, each a pure function of its index."""

    def __init__(self, count, size_px=(96, 64)):
        self._count = count
        self._size_px = size_px

    def __len__(self):
        return self._count

    def picture(self, index):
        """(H, W) uint8."""
        rng = np.random.default_rng(index)
        width, height = self._size_px
        coarse = rng.integers(0, 256, (height // 8, width // 8), dtype=np.uint8)
        return np.kron(coarse, np.ones((8, 8), dtype=np.uint8))


@pytest.fixture(autouse=True)
def _blocks(monkeypatch):
    monkeypatch.setattr(stages, "picture_source", lambda options, seed: Blocks(options.count + options.held_out))


def train(folder, options=OPTIONS, *, resume=False):
    training = stages.Training(
        ENCODER,
        ARCHITECTURE,
        options,
        device=torch.device("cpu"),
        folder=folder,
        tracker=NullTracker(),
        shown=False,
        resume=resume,
    )
    return training.run()


def final_state(folder):
    return torch.load(folder / "resume.ckpt", map_location="cpu", weights_only=True)


def assert_same_training(one, other):
    first, second = final_state(one), final_state(other)
    assert first["iteration"] == second["iteration"] == OPTIONS.iterations
    assert first["net"].keys() == second["net"].keys()
    for name, value in first["net"].items():
        assert torch.equal(value, second["net"][name]), name


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A training from nothing to its end."""
    folder = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stages, "picture_source", lambda options, seed: Blocks(options.count + options.held_out))
        return folder, train(folder)


def test_training_leaves_weights_with_a_card_that_tells_of_it(whole):
    folder, weights = whole
    card = read_card(weights)
    assert card["architecture"] == ARCHITECTURE
    assert card["iteration"] in (4, 6) and card["iterations"] == 6
    assert card["hours"] > 0.0
    assert card["training"]["descriptor_loss"]["kind"] == "SparseTripletLoss"
    assert card["labels"]["told"]["pictures"] == 6
    assert card["labels"]["detector"]["training"]["iterations"] == 4
    assert 0.0 <= card["validation"]["rep"] <= 1.0
    assert {"shapes.csv", "joint.csv", "labels", "pictures"} <= {path.name for path in folder.iterdir()}
    assert (folder / "joint.csv").read_text().splitlines()[-1].startswith("6,")
    assert list((folder / "pictures").glob("joint-*.png"))
    assert json.loads((folder / "labels" / "labels.json").read_text())["told"]["points_median"] > 0


@pytest.mark.parametrize("at", [("shapes", 1), ("shapes", 3), ("joint", 1), ("joint", 5)], ids=str)
def test_a_training_that_was_stopped_goes_on_to_the_same_weights(whole, tmp_path, monkeypatch, at):
    stage, iteration = at
    name = {"shapes": "ShapeBatches", "joint": "PairBatches"}[stage]
    original = getattr(stages, name)

    class Stopping(original):
        """Stops like Ctrl-C at one iteration."""

        def __call__(self, number):
            if number == iteration:
                raise KeyboardInterrupt
            return super().__call__(number)

    monkeypatch.setattr(stages, name, Stopping)
    with pytest.raises(KeyboardInterrupt):
        train(tmp_path)
    monkeypatch.setattr(stages, name, original)
    train(tmp_path, resume=(tmp_path / "resume.ckpt").exists())
    assert_same_training(whole[0], tmp_path)


def test_labelling_goes_on_where_it_was_stopped(whole, tmp_path, monkeypatch):
    monkeypatch.setattr("vioframe_superpoint.training.labelling.CHUNK", 2)
    asked = []

    class Stopping(Blocks):
        """Stops like a kill within the second chunk."""

        def picture(self, index):
            asked.append(index)
            if index == 3 and asked.count(3) == 1:
                raise KeyboardInterrupt
            return super().picture(index)

    monkeypatch.setattr(stages, "picture_source", lambda options, seed: Stopping(options.count + options.held_out))
    with pytest.raises(KeyboardInterrupt):
        train(tmp_path)
    train(tmp_path, resume=True)
    assert asked.count(0) == 1 and asked.count(2) == 2
    assert_same_training(whole[0], tmp_path)


def test_complete_labels_serve_another_training(whole, tmp_path, monkeypatch):
    def refuse(*arguments):
        raise AssertionError("labels were made again")

    monkeypatch.setattr(stages, "picture_source", refuse)
    weights = train(tmp_path, replace(OPTIONS, labels=str(whole[0] / "labels"), iterations=2, validate_every=2))
    assert read_card(weights)["start"].startswith("detector")
    assert not (tmp_path / "labels").exists()


def test_labels_that_are_there_are_what_the_card_tells_of(whole, tmp_path, caplog):
    labels = str(whole[0] / "labels")
    other = replace(OPTIONS, labels=labels, iterations=2, validate_every=2, seed=4)
    other = replace(
        other,
        adaptation=replace(OPTIONS.adaptation, threshold=0.5),
        shapes=replace(OPTIONS.shapes, iterations=9),
    )
    card = read_card(train(tmp_path, other))
    (told,) = [record.getMessage() for record in caplog.records if "stay as they were made" in record.getMessage()]
    assert "adaptation" in told and "seed (3, not 4)" in told and "shapes" in told and "pictures" not in told
    assert card["training"]["adaptation"]["threshold"] == 0.001
    assert card["training"]["shapes"]["iterations"] == 4
    assert card["licence"] == "Apache-2.0; learned from generated pictures alone"
    caplog.clear()
    train(tmp_path, replace(OPTIONS, labels=labels, iterations=2, validate_every=2))
    assert "stay as they were made" not in caplog.text


def test_detector_that_is_given_labels_and_is_where_the_third_stage_begins(whole, tmp_path):
    given = replace(OPTIONS, detector=str(whole[0] / "labels" / "detector.safetensors"))
    weights = train(tmp_path, given)
    assert read_card(weights)["start"] == "detector.safetensors of the labels"
    assert not (tmp_path / "shapes.csv").exists()
    assert_same_training(whole[0], tmp_path)


def test_detector_to_which_corners_are_too_likely_is_refused(whole, tmp_path):
    raw = whole[0] / "weights" / "shapes.safetensors"
    assert read_card(raw)["corner_weight"] == 8.0
    with pytest.raises(ConfigError, match=r"frontend\.training\.detector=.* weighing 8\.0.*detector\.safetensors"):
        train(tmp_path, replace(OPTIONS, detector=str(raw)))


def test_only_one_training_at_a_time_makes_labels(whole, tmp_path, monkeypatch):
    labels = tmp_path / "labels"
    labels.mkdir()
    with FileLock(labels / "lock"):
        hurried = replace(OPTIONS, labels=str(labels), max_minutes=1e-9)
        assert train(tmp_path / "run", hurried) is None
    assert {path.name for path in labels.iterdir()} <= {"lock"}


def test_resuming_with_other_options_is_refused(whole, tmp_path):
    shutil.copy(whole[0] / "resume.ckpt", tmp_path)
    labels = str(whole[0] / "labels")
    with pytest.raises(ConfigError, match=r"frontend\.training\.batch_size=4 \(it was 2\)"):
        train(tmp_path, replace(OPTIONS, labels=labels, batch_size=4), resume=True)
    other = replace(OPTIONS, labels=labels, pairs=replace(PAIRS, matches=12))
    with pytest.raises(ConfigError, match=r"frontend\.training\.pairs\.matches=12 \(it was 24\)"):
        train(tmp_path, other, resume=True)
    more = replace(OPTIONS, labels=labels, iterations=8, save_every=1, workers=0)
    train(tmp_path, more, resume=True)
    assert final_state(tmp_path)["iteration"] == 8


def test_no_labels_are_mixed_with_others(whole, tmp_path):
    store = LabelStore(whole[0] / "labels")
    about = {name: value for name, value in store.about().items() if name not in ("format", "told")}
    store.begin(about)
    with pytest.raises(DataError, match=r"other seed .*frontend\.training\.labels"):
        store.begin({**about, "seed": 99})


def test_a_session_ends_with_its_time_and_can_be_gone_on_with(whole, tmp_path):
    hurried = replace(OPTIONS, max_minutes=1e-9)
    assert train(tmp_path, hurried) is None
    for _ in range(12):
        if train(tmp_path, hurried, resume=True) and final_state(tmp_path)["iteration"] == OPTIONS.iterations:
            break
    assert_same_training(whole[0], tmp_path)


def test_resume_file_of_something_else_is_refused(tmp_path):
    (tmp_path / "resume.ckpt").write_bytes(b"nothing of the kind")
    with pytest.raises(DataError, match="not a whole resume file of frontend=superpoint"):
        train(tmp_path, resume=True)


def test_damaged_labels_are_told(whole, tmp_path):
    store = LabelStore(tmp_path)
    store.begin({"seed": 0})
    store.write(0, [np.zeros((16, 16), dtype=np.uint8)], [np.zeros((3, 2))], [np.ones((16, 16), dtype=bool)])
    (tmp_path / "points-0000.npz").write_bytes(b"PK")
    with pytest.raises(DataError, match="chunk 0 of .* is damaged"):
        store.read()


def test_options_name_what_is_wrong():
    with pytest.raises(ConfigError, match=r"frontend\.training\.validate_every=5 must be a multiple"):
        replace(OPTIONS, validate_every=5)
    with pytest.raises(ConfigError, match=r"frontend\.training\.schedule must be one of .*'linear'"):
        replace(OPTIONS, schedule="linear")
    with pytest.raises(ConfigError, match=r"pairs\.size_px must be .* multiples of 8"):
        replace(PAIRS, size_px=[100, 48])
    with pytest.raises(ConfigError, match=r"descriptor_loss\.negatives must be 1 or more, got 0"):
        replace(OPTIONS.descriptor_loss, negatives=0)
    with pytest.raises(ConfigError, match=r"patch_ratio=1\.5 of HomographyOptions must lie in \(0, 1\]"):
        HomographyOptions(patch_ratio=1.5)
    with pytest.raises(ConfigError, match=r"shadow=2 of LightingOptions is a probability"):
        LightingOptions(shadow=2)
    with pytest.raises(ConfigError, match=r"frontend\.training\.iterations must be positive"):
        replace(OPTIONS, iterations=0)


def test_classes_say_where_in_the_cell_a_point_lies():
    rng = np.random.default_rng(0)
    points = np.array([[0.0, 0.0], [15.4, 1.6], [7.0, 15.0], [np.nan, 1.0], [16.0, 3.0], [-1.0, 2.0]])
    classes = cell_classes(points, (16, 16), rng)
    assert classes.tolist() == [[0, 2 * 8 + 7], [7 * 8 + 7, 64]]


def test_ties_in_a_cell_are_broken_either_way():
    points = np.array([[1.0, 0.0], [2.0, 0.0]])
    seen = {int(cell_classes(points, (8, 8), np.random.default_rng(seed))[0, 0]) for seed in range(20)}
    assert seen == {1, 2}


def test_a_cell_is_whole_where_all_its_pixels_are():
    mask = np.ones((16, 24), dtype=bool)
    mask[9, 20] = False
    assert whole_cells(mask).tolist() == [[True, True, True], [True, True, False]]


def test_points_of_a_pair_correspond_and_views_show_the_same():
    rng = np.random.default_rng(5)
    x, y = np.meshgrid(np.arange(160), np.arange(120))
    # A smooth picture, so that an interpolated value is near the true one.
    picture = np.rint(127 + 60 * np.sin(x / 9.0) + 60 * np.cos(y / 7.0)).astype(np.uint8)
    labels = rng.uniform(5, [155, 115], (40, 2))
    for seed in range(8):
        pair = make_pair(picture, labels, np.random.default_rng(seed), PAIRS)
        matched = pair["matched"]
        assert matched.sum() > 8
        first, second = pair["points"][:, matched]
        np.testing.assert_allclose(warp_points(first, pair["H"].astype(np.float64)), second, atol=2e-2)
        values = [
            pair["images"][view][np.rint(p[:, 1]).astype(int), np.rint(p[:, 0]).astype(int)].astype(float)
            for view, p in enumerate((first, second))
        ]
        assert np.abs(values[0] - values[1]).mean() < 12
        assert np.corrcoef(*values)[0, 1] > 0.9


def test_labels_of_a_pair_are_where_the_picture_shows_them():
    # One white pixel, labelled, on black: wherever the class is, it is bright.
    for seed in range(6):
        picture = np.zeros((120, 160), dtype=np.uint8)
        labels = np.random.default_rng(seed).integers(30, 90, (4, 2)).astype(float)
        for x, y in labels.astype(int):
            picture[y - 1 : y + 2, x - 1 : x + 2] = 255
        pair = make_pair(picture, labels, np.random.default_rng(seed), PAIRS)
        for view in range(2):
            for row, column in np.argwhere(pair["classes"][view] < 64):
                place = int(pair["classes"][view][row, column])
                assert pair["images"][view][row * 8 + place // 8, column * 8 + place % 8] > 60


def test_no_cell_teaches_where_labels_were_not_looked_for():
    picture = Blocks(1, (160, 120)).picture(0)
    labels = np.array([[40.0, 40.0], [80.0, 60.0]])
    seen = np.zeros((120, 160), dtype=bool)
    seen[:, :100] = True
    for seed in range(6):
        usual, partly = (make_pair(picture, labels, np.random.default_rng(seed), PAIRS, each) for each in (None, seen))
        assert not (partly["known"] & ~usual["known"]).any()
        # Of the picture with the part that was not seen in white, no cell that teaches shows any of it.
        marked = np.where(seen, 0, 255).astype(np.uint8)
        shown = make_pair(marked, labels, np.random.default_rng(seed), PAIRS)["images"]
        cells = shown.reshape(2, 6, 8, 8, 8).max(axis=(2, 4))
        assert not cells[partly["known"]].any()
        # Descriptors may learn there all the same.
        np.testing.assert_array_equal(partly["overlap"], usual["overlap"])
        np.testing.assert_array_equal(partly["points"], usual["points"])


def test_what_was_seen_is_kept_with_the_labels(whole, tmp_path, caplog):
    labelled = LabelStore(whole[0] / "labels").read()
    seen = labelled.seen_in(0)
    assert seen.shape == (64, 96) and not seen[0].any() and seen[32, 48]
    store = LabelStore(tmp_path)
    store.begin({"seed": 0})
    mask = np.random.default_rng(0).random((16, 24)) < 0.5
    store.write(0, [np.zeros((16, 24), dtype=np.uint8)], [np.zeros((3, 2))], [mask])
    np.testing.assert_array_equal(store.read().seen_in(0), mask)
    # Labels of a release that did not keep it are read, with a warning, but not added to.
    about = tmp_path / "labels.json"
    about.write_text(about.read_text().replace("labels-2", "labels-1"))
    store.read()
    assert "where no label could be" in caplog.text
    with pytest.raises(DataError, match="other format"):
        store.begin({"seed": 0})


def test_pairs_are_a_pure_function_of_the_generator():
    picture = Blocks(1, (160, 120)).picture(0)
    labels = np.array([[40.0, 40.0], [80.0, 60.0]])
    lit = replace(PAIRS, lighting=LightingOptions())
    one, other = (make_pair(picture, labels, np.random.default_rng(9), lit) for _ in range(2))
    for name in one:
        np.testing.assert_array_equal(one[name], other[name])


def test_what_corners_weigh_is_taken_back():
    # To a net that learned with a weight w a share p of corners looks like w p / (w p + 1 - p).
    net = make_net(ENCODER).eval()
    images = torch.from_numpy(Blocks(1, (64, 48)).picture(0)[None, None]).float() / 255.0
    with torch.no_grad():
        biased = net(images)[0].softmax(dim=1)[:, -1]
        ShapesLoss(8.0).take_back(net)
        true = net(images)[0].softmax(dim=1)[:, -1]
    corner = 1.0 - true
    torch.testing.assert_close(1.0 - biased, 8.0 * corner / (8.0 * corner + true))


def test_adaptation_of_one_view_is_the_detector():
    net = make_net(ENCODER).eval()
    picture = Blocks(1, (64, 48)).picture(0)
    options = replace(OPTIONS.adaptation, homographies=1, border_px=0)
    heat, seen = adapted_heat(net, picture, np.random.default_rng(0), options)
    assert seen.all()
    from vioframe_superpoint.training.adaptation import heat_of

    np.testing.assert_allclose(heat, heat_of(net, picture[None])[0], atol=1e-6)


def test_adaptation_brings_answers_back_to_where_they_are(monkeypatch):
    # A detector that answers with the brightness itself: its mean over views is the picture, blurred by interpolation.
    monkeypatch.setattr(
        "vioframe_superpoint.training.adaptation.heat_of", lambda net, pictures, precision: pictures / 255.0
    )
    x, y = np.meshgrid(np.arange(128), np.arange(96))
    true = np.array([[40, 30], [90, 60], [64, 48]])
    spots = sum(np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / 4.5) for at in true)
    picture = np.rint(255 * spots).astype(np.uint8)
    options = replace(OPTIONS.adaptation, homographies=30, threshold=0.3)
    heat, seen = adapted_heat(None, picture, np.random.default_rng(1), options)
    assert not seen[0].any() and seen[48, 64] and not heat[~seen].any()
    points = points_of(heat, options)
    assert len(points) == 3
    apart = np.linalg.norm(points[:, None] - true[None], axis=2)
    assert apart.min(axis=0).max() < 0.3


def test_refined_points_follow_the_centre_of_heat():
    x, y = np.meshgrid(np.arange(20), np.arange(20))
    heat = np.exp(-((x - 8.3) ** 2 + (y - 11.2) ** 2) / 2.0)
    placed = refined(heat, np.array([[8, 11]]))[0]
    assert abs(placed[0] - 8.3) < 0.1 and abs(placed[1] - 11.2) < 0.1


def test_rates_rise_hold_and_fall():
    for schedule, last in (("constant", 1.0), ("cosine", 0.0), ("trapezoid", 0.0)):
        options = RateOptions(iterations=1000, learning_rate=1.0, schedule=schedule, warmup=10, weight_decay=0.0)
        factor = rate_factor(options)
        assert factor(0) < 0.1 and factor(10) == pytest.approx(1.0)
        assert factor(1000) == pytest.approx(last, abs=1e-6)
    assert factor(700) == 1.0 and factor(900) == pytest.approx(0.5)


def test_front_end_has_a_training_of_its_own():
    from vioframe_superpoint import SuperPointFrontend

    front = SuperPointFrontend(encoder=ENCODER, weights=None, training=OPTIONS)
    assert isinstance(front, TrainsItself)
    with pytest.raises(ConfigError, match=r"frontend\.training is null"):
        SuperPointFrontend(encoder=ENCODER, weights=None).train_itself(
            Path("nowhere"), NullTracker(), shown=False, resume=False
        )


def test_time_is_that_of_all_sessions(whole):
    state = final_state(whole[0])
    assert 0.0 < state["seconds"] < time.monotonic()


SMALL = [
    "task=train",
    "frontend=superpoint",
    "encoder=mobilenetv2",
    "encoder.width=0.25",
    "descriptor_loss=sparse_triplet",
    "tracker=none",
    "progress=false",
    "frontend.training.iterations=4",
    "frontend.training.batch_size=2",
    "frontend.training.save_every=2",
    "frontend.training.validate_every=2",
    "frontend.training.pairs.size_px=[64,48]",
    "frontend.training.shapes.iterations=2",
    "frontend.training.shapes.batch_size=2",
    "frontend.training.shapes.size_px=[64,48]",
    "frontend.training.pictures.count=2",
    "frontend.training.pictures.held_out=1",
    "frontend.training.pictures.folder=images",
    "frontend.training.pictures.size_px=[96,64]",
    "frontend.training.adaptation.homographies=2",
]


def test_a_user_trains_stops_and_goes_on(cli, tmp_path):
    # Of a folder: textures take seconds to paint.
    (tmp_path / "images").mkdir()
    for number in range(3):
        cv2.imwrite(str(tmp_path / "images" / f"{number}.png"), Blocks(3).picture(number))
    done = cli(*SMALL, "hydra.run.dir=one", "frontend.training.max_minutes=1e-9")
    assert done.returncode == 0, done.stderr
    assert "go on with trainer.resume=" in done.stdout + done.stderr
    resumed = cli(*SMALL, "hydra.run.dir=two", "trainer.resume=one/resume.ckpt")
    assert resumed.returncode == 0, resumed.stderr
    assert "frontend.weights=" in resumed.stdout + resumed.stderr
    weights = tmp_path / "one" / "weights" / "superpoint-mobilenetv2.safetensors"
    card = read_card(weights)
    assert card["iterations"] == 4
    assert card["licence"] == "what the pictures of images, from which it learned, allow"


def test_what_to_resume_is_a_file_of_that_name_that_is_there(tmp_path):
    with pytest.raises(DataError, match=r"nowhere/resume\.ckpt: there is no resume\.ckpt in nowhere"):
        folder_to_resume("nowhere/resume.ckpt")
    (tmp_path / "resume.ckpt").touch()
    (tmp_path / "other.ckpt").touch()
    assert folder_to_resume(str(tmp_path / "resume.ckpt")) == tmp_path
    with pytest.raises(DataError, match=r"other\.ckpt: give the resume\.ckpt"):
        folder_to_resume(str(tmp_path / "other.ckpt"))


def test_options_of_another_training_are_refused():
    parts = {"frontend": "superpoint"}
    check_own_training([*SMALL, "trainer.resume=one/resume.ckpt", "++trainer.train=[frontend]"], parts)
    for override in ("trainer.max_minutes=60", "+trainer.max_epochs=3", "trainer=cpu", "training_data=kitti"):
        with pytest.raises(ConfigError, match=f"{re.escape(override)} would do nothing: frontend=superpoint has a"):
            check_own_training([*SMALL, override], parts)


def test_options_spelled_out_for_lack_of_a_choice_are_those_of_the_choice():
    # encoder= and descriptor_loss= stand earlier in the configuration than the front end, so it cannot bring them: they
    # are also accepted beside a system that has another.
    conf = Path(vioframe_superpoint.__file__).parent / "conf"
    front = OmegaConf.create({"frontend": OmegaConf.load(conf / "frontend" / "superpoint.yaml")}).frontend
    for group, option, value in (
        ("encoder", "mobilenetv2", front.encoder),
        ("descriptor_loss", "sparse_triplet", front.training.descriptor_loss),
    ):
        chosen = OmegaConf.to_container(OmegaConf.load(conf / group / f"{option}.yaml"))
        chosen.pop("defaults", None)
        assert OmegaConf.to_container(value) == chosen
