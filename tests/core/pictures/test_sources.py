"""Sources of pictures: the same from the same seed and index, folders with broken files, mixtures."""

import logging
import shutil
import time

import cv2
import numpy as np
import pytest

from vioframe.errors import ConfigError, DataError
from vioframe.pictures import Mixture, PictureFolder, RenderedPlaces, Textures
from vioframe.pictures.patches import PAINTERS, Patch, PatchPainter, TextureBank
from vioframe.pictures.sources import fit_picture, shows_something

SIZE = (96, 64)


class Numbers:
    """Pictures that tell which they are."""

    def __init__(self, first: int, count: int) -> None:
        self.first, self.count = first, count

    def __len__(self):
        return self.count

    def picture(self, index):
        assert 0 <= index < self.count
        return np.full((64, 96), self.first + index, np.uint8)


@pytest.mark.parametrize("size_px", [(31, 100), (100,), (100, 20)], ids=str)
def test_sizes_that_make_no_picture_are_refused(size_px):
    with pytest.raises(ConfigError, match="32 px"):
        Textures(size_px=size_px, count=3)


def test_no_pictures_at_all_are_refused():
    with pytest.raises(ConfigError, match="count"):
        Textures(size_px=SIZE, count=0)


@pytest.mark.parametrize("painter", PAINTERS, ids=lambda painter: painter.__name__)
@pytest.mark.parametrize("shape", [(64, 96), (37, 41)], ids=str)
def test_every_painter_fills_any_shape_by_its_generator_alone(painter, shape):
    first, again = painter(np.random.default_rng(3), shape), painter(np.random.default_rng(3), shape)
    assert first.shape == shape
    assert first.dtype == np.uint8
    np.testing.assert_array_equal(first, again)
    deviations = [painter(np.random.default_rng(seed), shape).std() for seed in range(3)]
    assert max(deviations) > 3.0


def test_textures_are_a_function_of_seed_and_index_in_any_order():
    first, again = (Textures(size_px=SIZE, count=9, seed=1) for _ in range(2))
    ahead = [first.picture(index) for index in range(4)]
    back = [again.picture(index) for index in (3, 2, 1, 0)][::-1]
    for one, other in zip(ahead, back, strict=True):
        assert one.shape == SIZE[::-1]
        np.testing.assert_array_equal(one, other)
    assert not any(np.array_equal(ahead[0], other) for other in ahead[1:])


@pytest.mark.parametrize("purpose", ["validation", "held_out"])
def test_textures_of_another_purpose_are_others(purpose):
    usual, held_out = (Textures(size_px=SIZE, count=4, seed=1, purpose=each) for each in ("training", purpose))
    for index in range(4):
        assert not np.array_equal(usual.picture(index), held_out.picture(index))


def test_textures_are_varied_and_few_are_empty():
    source = Textures(size_px=SIZE, count=40, seed=2)
    pictures = [source.picture(index).astype(float) for index in range(40)]
    means, deviations = [p.mean() for p in pictures], np.array([p.std() for p in pictures])
    assert np.ptp(means) > 120.0
    assert np.mean(deviations < 8.0) < 0.1
    assert np.median(deviations) > 25.0


def test_a_blank_wall_shows_nothing_and_a_board_does():
    assert not shows_something(np.full((64, 96), 90, np.uint8))
    ramp = np.tile(np.linspace(50, 120, 96).astype(np.uint8), (64, 1))
    assert not shows_something(ramp)
    board = np.kron(np.indices((8, 12)).sum(axis=0) % 2, np.ones((8, 8))).astype(np.uint8)
    assert shows_something(100 * board)
    half = 100 * board
    half[:, 16:] = 40
    assert not shows_something(half)


def test_textures_come_fast_enough():
    source = Textures(size_px=(320, 240), count=1000, seed=0)
    for _ in range(2):
        # The second time all textures have been painted.
        start = time.process_time()
        for index in range(12):
            source.picture(index)
        each_s = (time.process_time() - start) / 12
    # Forty a second on one core are asked for; a loaded machine is given some grace.
    assert each_s < 0.05


def test_a_piece_is_seen_where_a_pinhole_camera_sees_it():
    bank = TextureBank((0,), len(PAINTERS))
    painter = PatchPainter((160, 120), 100.0, bank, np.random.default_rng(0))
    painter.canvas[:] = 0.0
    painter._ambient = 1.0
    half = np.array([[-0.5, -0.25], [0.5, -0.25], [0.5, 0.25], [-0.5, 0.25]])
    right, down = np.eye(3)[:2]
    flat = {"u": right, "v": down, "outline": half, "pixels_per_metre": None, "contrast": 1.0}
    painter.draw(Patch(origin=np.array([0.1, 0.0, 2.0]), texture=None, grey=200.0, **flat))
    y, x = np.mgrid[:120, :160]
    share = painter.canvas / 200.0
    assert share.sum() == pytest.approx(50 * 25, rel=0.1)
    centre = (share * x).sum() / share.sum(), (share * y).sum() / share.sum()
    np.testing.assert_allclose(centre, [79.5 + 100 * 0.1 / 2.0, 59.5], atol=0.1)


def test_a_fitted_texture_covers_its_piece_once():
    bank = TextureBank((0,), len(PAINTERS), side_px=64)
    ramp = np.tile(np.linspace(0, 252, 64).astype(np.uint8), (64, 1))
    bank._textures[0] = (ramp, ramp[::2, ::2], ramp[::4, ::4], ramp[::8, ::8])
    painter = PatchPainter((160, 120), 100.0, bank, np.random.default_rng(0))
    painter._ambient = 1.0
    square = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    right, down = np.eye(3)[:2]
    painter.draw(
        Patch(
            origin=np.array([0.0, 0.0, 1.0]),
            u=right,
            v=down,
            outline=square,
            texture=0,
            pixels_per_metre=None,
            grey=128.0,
            contrast=1.0,
        )
    )
    row = painter.canvas[60, 31:129]
    np.testing.assert_allclose(row, np.linspace(2, 250, len(row)), atol=5.0)


def test_behind_the_camera_nothing_is_drawn():
    painter = PatchPainter((160, 120), 100.0, TextureBank((0,), len(PAINTERS)), np.random.default_rng(0))
    before = painter.canvas.copy()
    square = np.array([[-9.0, -9.0], [9.0, -9.0], [9.0, 9.0], [-9.0, 9.0]])
    right, down = np.eye(3)[:2]
    behind = np.array([0.0, 0.0, -1.0])
    painter.draw(
        Patch(origin=behind, u=right, v=down, outline=square, texture=1, pixels_per_metre=9.0, grey=9.0, contrast=1.0)
    )
    np.testing.assert_array_equal(painter.canvas, before)


def test_places_are_a_function_of_seed_and_index_and_places_differ():
    source = RenderedPlaces(size_px=SIZE, count=6, seed=0, each=2)
    pictures = [source.picture(index) for index in (2, 3, 2)]
    np.testing.assert_array_equal(pictures[0], pictures[2])
    assert pictures[0].shape == SIZE[::-1]
    assert np.abs(pictures[0].astype(float) - pictures[1]).mean() > 3.0
    held_out = RenderedPlaces(size_px=SIZE, count=6, seed=0, each=2, purpose="held_out")
    assert np.abs(pictures[0].astype(float) - held_out.picture(2)).mean() > 3.0


def test_a_folder_gives_grey_pictures_of_one_size_and_skips_what_is_broken(tmp_path, caplog):
    ramp = np.tile(np.arange(200, dtype=np.uint8), (300, 1))
    cv2.imwrite(str(tmp_path / "a.png"), ramp)
    (tmp_path / "b.jpg").write_bytes(b"\xff\xd8 no picture")
    (tmp_path / "c.jpg").write_bytes(b"")
    (tmp_path / "deeper").mkdir()
    cv2.imwrite(str(tmp_path / "deeper" / "d.png"), np.full((80, 120, 3), (0, 0, 255), np.uint8))
    (tmp_path / "notes.txt").write_text("not a picture")
    source = PictureFolder(tmp_path, size_px=SIZE)
    assert len(source) == 4
    with caplog.at_level(logging.WARNING):
        pictures = [source.picture(index) for index in (0, 1, 2, 3, 1)]
    assert all(p.shape == SIZE[::-1] and p.dtype == np.uint8 for p in pictures)
    # Red is 0.299 of white.
    for picture in pictures[1:]:
        np.testing.assert_array_equal(picture, 76)
    assert {path.name for path in source.unreadable} == {"b.jpg", "c.jpg"}
    assert [record.getMessage().count("b.jpg") for record in caplog.records] == [1]


def test_folders_without_pictures_are_refused(tmp_path):
    with pytest.raises(DataError, match="no folder"):
        PictureFolder(tmp_path / "nowhere", size_px=SIZE)
    with pytest.raises(DataError, match="holds no picture"):
        PictureFolder(tmp_path, size_px=SIZE)
    (tmp_path / "only.png").write_bytes(b"broken")
    source = PictureFolder(tmp_path, size_px=SIZE)
    with pytest.raises(DataError, match="none of its 1 pictures"):
        source.picture(0)
    shutil.rmtree(tmp_path)


def test_a_picture_is_cut_in_the_middle_and_resized():
    image = np.zeros((100, 300), np.uint8)
    image[:, 75:225] = 100
    fitted = fit_picture(image, (96, 64))
    assert fitted.shape == (64, 96)
    np.testing.assert_array_equal(fitted, 100)


def test_a_mixture_takes_each_source_in_order_in_its_share():
    mixture = Mixture([Numbers(0, 30), Numbers(100, 90)], [1.0, 3.0], count=120, seed=0)
    seen = [int(mixture.picture(index)[0, 0]) for index in range(120)]
    assert [value for value in seen if value < 100] == list(range(30))
    assert [value for value in seen if value >= 100] == list(range(100, 190))
    # Turns are mixed.
    assert 4 < sum(value < 100 for value in seen[:30]) < 12
    again = Mixture([Numbers(0, 30), Numbers(100, 90)], [1.0, 3.0], count=120, seed=0)
    assert int(again.picture(77)[0, 0]) == seen[77]


def test_a_source_that_is_at_its_end_begins_again_and_one_without_share_is_never_asked():
    mixture = Mixture([Numbers(0, 5), Numbers(100, 1)], [1.0, 0.0], count=12)
    assert [int(mixture.picture(index)[0, 0]) for index in range(12)] == [k % 5 for k in range(12)]


@pytest.mark.parametrize("shares", [[1.0], [1.0, -1.0], [0.0, 0.0]], ids=str)
def test_shares_that_do_not_fit_are_refused(shares):
    with pytest.raises(ConfigError, match="shares"):
        Mixture([Numbers(0, 5), Numbers(0, 5)], shares, count=3)
