"""Pairs: pixels of both pictures agree under the homography; the layout of HPatches and its errors."""

import cv2
import numpy as np
import pytest

from shared_data import shared_data
from vioframe.errors import ConfigError, DataError
from vioframe.pictures import PicturePair, generated_pairs, hpatches_pairs, valid_mask, warp_picture

SIZE = (160, 120)


@pytest.fixture(scope="module")
def generated() -> dict[str, list[PicturePair]]:
    return {split: list(generated_pairs(split, 10, SIZE, seed=1)) for split in ("illumination", "viewpoint")}


def correlation(pair: PicturePair) -> float:
    """Of what the second picture shows with what the first, warped, says it should."""
    size = pair.second.shape[::-1]
    seen = valid_mask(pair.H_second_first, pair.first.shape[::-1], border=4, warped_size_px=size)
    warped = warp_picture(pair.first, pair.H_second_first, size).astype(float)
    # Slow changes of light are no matter: what is compared is the detail.
    detail = [p - cv2.GaussianBlur(p, (0, 0), 6.0) for p in (warped, pair.second.astype(float))]
    return float(np.corrcoef(detail[0][seen], detail[1][seen])[0, 1])


def test_what_cannot_be_is_refused_at_once():
    with pytest.raises(ConfigError, match="illumination, viewpoint"):
        generated_pairs("weather", 3, SIZE)
    with pytest.raises(ConfigError, match="count"):
        generated_pairs("viewpoint", 0, SIZE)
    with pytest.raises(ConfigError, match="32 px"):
        generated_pairs("viewpoint", 1, (16, 16))


@pytest.mark.parametrize("split", ["illumination", "viewpoint"])
def test_generated_pairs_agree_pixel_by_pixel_under_their_homography(split, generated):
    pairs = generated[split]
    assert [pair.name for pair in pairs] == [f"{split}_{index:03d}" for index in range(10)]
    found = []
    for pair in pairs:
        assert pair.split == split
        assert pair.first.shape == pair.second.shape == SIZE[::-1]
        assert np.array_equal(pair.H_second_first, np.eye(3)) == (split == "illumination")
        found.append(correlation(pair))
    # Strong light leaves little of some; a homography that is off leaves nothing of all.
    assert np.median(found) > 0.55
    off = np.array([[1.0, 0.0, 6.0], [0.0, 1.0, 6.0], [0.0, 0.0, 1.0]])
    wrong = [
        PicturePair(first=p.first, second=p.second, H_second_first=off @ p.H_second_first, name="", split=split)
        for p in pairs
    ]
    assert np.median([correlation(pair) for pair in wrong]) < 0.4


def test_generated_pairs_are_those_of_their_seed(generated):
    first, again = generated["viewpoint"][0], next(generated_pairs("viewpoint", 10, SIZE, seed=1))
    np.testing.assert_array_equal(first.second, again.second)
    np.testing.assert_array_equal(first.H_second_first, again.H_second_first)


def write_sequence(folder, count=3):
    folder.mkdir()
    rng = np.random.default_rng(0)
    for number in range(1, count + 1):
        cv2.imwrite(str(folder / f"{number}.ppm"), rng.integers(0, 255, (40, 50, 3), dtype=np.uint8))
        if number > 1:
            np.savetxt(folder / f"H_1_{number}", 2.0 * np.diag([number, 1.0, 1.0]))


def test_a_folder_of_sequences_gives_splits_by_name_and_homographies_of_unit_scale(tmp_path):
    write_sequence(tmp_path / "v_wall")
    write_sequence(tmp_path / "i_lamp", count=11)
    (tmp_path / "empty").mkdir()
    pairs = list(hpatches_pairs(tmp_path))
    assert [p.name for p in pairs if p.split == "viewpoint"] == ["v_wall_2", "v_wall_3"]
    assert [p.name for p in pairs if p.split == "illumination"] == [f"i_lamp_{k}" for k in range(2, 12)]
    np.testing.assert_allclose(pairs[-1].H_second_first, np.diag([3.0, 1.0, 1.0]))
    assert [p.name for p in hpatches_pairs(tmp_path / "v_wall")] == ["v_wall_2", "v_wall_3"]


def test_what_is_missing_or_broken_in_a_sequence_is_named(tmp_path):
    with pytest.raises(DataError, match="no folder"):
        hpatches_pairs(tmp_path / "nowhere")
    with pytest.raises(DataError, match="holds no sequence"):
        hpatches_pairs(tmp_path)
    write_sequence(tmp_path / "v_wall")
    (tmp_path / "v_wall" / "3.ppm").unlink()
    with pytest.raises(DataError, match="no picture 3"):
        list(hpatches_pairs(tmp_path))
    (tmp_path / "v_wall" / "3.ppm").write_bytes(b"P6 broken")
    with pytest.raises(DataError, match=r"3\.ppm cannot be read"):
        list(hpatches_pairs(tmp_path))
    (tmp_path / "v_wall" / "H_1_2").write_text("1 0\n0 1\n")
    with pytest.raises(DataError, match="H_1_2 must hold"):
        list(hpatches_pairs(tmp_path))
    (tmp_path / "v_wall" / "H_1_2").write_text("a b c")
    with pytest.raises(DataError, match="H_1_2 must hold"):
        list(hpatches_pairs(tmp_path))


def test_churchill_is_read_and_its_pictures_agree():
    pairs = list(hpatches_pairs(shared_data("homographies/hpatches_v_churchill")))
    assert [pair.name[-1] for pair in pairs] == list("23456")
    assert {pair.split for pair in pairs} == {"viewpoint"}
    assert all(correlation(pair) > 0.5 for pair in pairs)
