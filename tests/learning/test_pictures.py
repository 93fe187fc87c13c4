"""Pictures of a training: what they show, and that they come while it lasts."""

import math

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the extra learn")
pytest.importorskip("lightning", reason="needs the extra learn")

import torch

from learned_parts import TinyVo, options
from learned_scenes import stored
from vioframe.learning.flow_colours import colour_wheel, flow_colours, wheel_radius
from vioframe.learning.pictures import draw_curve, draw_flow
from vioframe.learning.scoring import Score
from vioframe.learning.seeding import seed_everything
from vioframe.learning.training import Split, train_parts
from vioframe.tracking import NullTracker

CONSTANT = Score(t_rel_percent=30.0, r_rel_deg_per_100m=9.0, segments=10)


class Flowing(TinyVo):
    """Puts flow upstream, as a front end would; with a weight of its own it changes in training."""

    def forward_batch(self, batch, upstream):
        outputs = super().forward_batch(batch, upstream)
        height, width = batch.images.shape[-2:]
        flow = outputs["tangent"][..., 3:5, None, None].expand(-1, -1, -1, height, width)
        return {**outputs, "flow": flow}


class Filed(NullTracker):
    def __init__(self):
        self.files = []

    def log_file(self, path, folder=""):
        assert path.read_bytes().startswith(b"\x89PNG")
        self.files.append((path.name, folder))


def train(folder, part, tracker=None, **changes):
    splits = [Split(sequences=(stored(name=name),), hashes=(name,)) for name in ("training", "validation")]
    chosen = options(folder, **changes)
    tracker = tracker or NullTracker()
    return train_parts({"vo": part}, *splits, chosen, folder=folder, tracker=tracker, about={}, shown=False)


def size_of_png(path):
    data = path.read_bytes()
    assert data.startswith(b"\x89PNG")
    return int.from_bytes(data[16:20]), int.from_bytes(data[20:24])


def test_pictures_come_while_it_trains_and_are_recorded(tmp_path):
    tracker = Filed()
    train(tmp_path, Flowing(), tracker, max_epochs=2)
    names = [name for name, folder in tracker.files if folder == "plots"]
    assert {"curve.png", "flow.png", "validation.png"} == set(names)
    # The curve once as it grows, and once whole.
    assert names.count("curve.png") == 2 and names[-1] == "curve.png"
    assert all((tmp_path / name).exists() for name in set(names))


def test_without_flow_there_is_no_picture_of_it(tmp_path):
    train(tmp_path, TinyVo(), max_epochs=1)
    assert (tmp_path / "curve.png").exists() and not (tmp_path / "flow.png").exists()


def test_flow_that_stays_is_drawn_once(tmp_path):
    class Still(TinyVo):
        def forward_batch(self, batch, upstream):
            flow = torch.zeros(len(batch), batch.pairs, 2, *batch.images.shape[-2:])
            return {**super().forward_batch(batch, upstream), "flow": flow}

    tracker = Filed()
    train(tmp_path, Still(), tracker, max_epochs=3)
    assert [name for name, _ in tracker.files].count("flow.png") == 1


def test_pictures_leave_the_training_as_it_is(tmp_path):
    seed_everything(0)
    plain = train(tmp_path / "a", TinyVo(), max_epochs=2)
    seed_everything(0)
    watched = train(tmp_path / "b", Flowing(), max_epochs=2)
    for one, two in zip(plain.curve, watched.curve, strict=True):
        for name in set(one) - {"images_per_s"}:
            assert one[name] == two[name], name


def test_a_training_that_breaks_off_leaves_its_curve(tmp_path):
    class Stop(RuntimeError):
        pass

    class Breaking(Filed):
        def log_metrics(self, metrics, step=None):
            if step == 1:
                raise Stop

    with pytest.raises(Stop):
        train(tmp_path, TinyVo(), Breaking(), max_epochs=3)
    assert (tmp_path / "curve.png").exists()


def test_direction_is_the_hue_and_length_the_strength():
    right, left, long, still = flow_colours(np.array([[[10.0, 0], [-10.0, 0], [40.0, 0], [0.0, 0]]]), 10.0)[0]
    assert right == pytest.approx([1.0, 0.0, 0.0])
    assert left == pytest.approx([0.0, 1.0, 1.0])
    assert still == pytest.approx([1.0, 1.0, 1.0])
    assert long == pytest.approx([0.5, 0.0, 0.0]), "beyond the legend it darkens"
    down = flow_colours(np.array([[[0.0, 5.0]]]), 10.0)
    assert colour_wheel(201)[150, 100] == pytest.approx(down[0, 0]), "the legend has y downwards, as the image"
    assert colour_wheel(11)[0, 0] == pytest.approx([1.0, 1.0, 1.0])


@pytest.mark.parametrize(("usual", "radius"), [(0.0, 0.1), (0.7, 1.0), (2.0, 2.0), (2.1, 3.0), (31.0, 50.0), (51, 100)])
def test_the_legend_ends_at_a_round_number(usual, radius):
    assert wheel_radius(np.full((4, 5, 2), usual / math.sqrt(2.0))) == pytest.approx(radius)


@pytest.mark.parametrize("shape", [(16, 64), (64, 16), (48, 48)])
@pytest.mark.parametrize("channels", [1, 3])
def test_flow_is_drawn_for_images_of_any_shape(tmp_path, shape, channels):
    draw_flow(tmp_path / "new" / "flow.png", np.full((2, *shape, channels), 0.5), np.ones((*shape, 2)), "caption")
    width, height = size_of_png(tmp_path / "new" / "flow.png")
    assert 200 < height < 900 and 300 < width < 1600


@pytest.mark.parametrize("losses", [[5.0], [3.0, math.nan], [900.0, 3.0, -8.0, -9.0], [900.0, 2.0, 1.0, 1.0]])
def test_a_curve_may_have_any_values(tmp_path, losses):
    rows = [{"epoch": float(i), "train/loss": loss, "learning_rate": 1e-3} for i, loss in enumerate(losses)]
    rows[0] |= {"validation/loss": 1.0, "validation/t_rel_percent": 20.0, "validation/r_rel_deg_per_100m": 5.0}
    rows[0]["validation/relative_to_reference"] = 0.6
    draw_curve(tmp_path / "curve.png", rows, CONSTANT, "constant motion")
    assert size_of_png(tmp_path / "curve.png")[0] > 800
