"""Heat, suppression and sampled descriptors against plain definitions."""

import pytest

pytest.importorskip("torch", reason="needs torch: pip install 'vioframe[learn]'")

import torch

from vioframe_superpoint.net.keypoints import heatmap, remove_border, sample_descriptors, suppress


def test_heat_puts_each_channel_at_its_pixel():
    logits = torch.full((1, 65, 2, 3), -20.0)
    logits[0, 64] = 0.0
    logits[0, 8 * 5 + 2, 1, 2] = 20.0
    heat = heatmap(logits)
    assert heat.shape == (1, 16, 24)
    assert heat[0].argmax() == (8 + 5) * 24 + (16 + 2)
    assert heat.max() > 0.99 and heat.sum() < 1.01


def test_heat_of_a_cell_and_its_dustbin_is_one():
    logits = torch.randn(2, 65, 2, 2, generator=torch.Generator().manual_seed(0))
    cells = torch.nn.functional.avg_pool2d(heatmap(logits)[:, None], 8)[:, 0] * 64
    torch.testing.assert_close(cells + logits.softmax(dim=1)[:, 64], torch.ones(2, 2, 2))


@pytest.mark.parametrize("radius", [1, 3, 4])
@pytest.mark.parametrize("levels", [5, 10_000])
def test_suppression_keeps_the_maximum_of_each_square(radius, levels):
    """Against the definition; few levels make ties."""
    random = torch.Generator().manual_seed(radius)
    heat = torch.randint(1, levels, (2, 23, 31), generator=random).float()
    kept = suppress(heat, radius)
    for image, result in zip(heat, kept, strict=True):
        for row in range(image.shape[0]):
            for column in range(image.shape[1]):
                top, left = max(row - radius, 0), max(column - radius, 0)
                square = image[top : row + radius + 1, left : column + radius + 1]
                value = result[row, column]
                assert value in (0.0, image[row, column])
                if value > 0:
                    assert image[row, column] == square.max()
                    around = result[top : row + radius + 1, left : column + radius + 1]
                    assert (around > 0).sum() == 1
                elif levels > 10:
                    assert image[row, column] < square.max() or (square == square.max()).sum() > 1
    first = torch.zeros(1, 9, 9)
    first[0, 4, 3:6] = 1.0
    assert suppress(first, 2).nonzero().tolist() == [[0, 4, 3]]


def test_radius_and_border_of_zero_change_nothing():
    heat = torch.rand(1, 8, 8, generator=torch.Generator().manual_seed(0))
    assert torch.equal(suppress(heat, 0), heat)
    assert torch.equal(remove_border(heat, 0), heat)


def test_border_is_empty():
    inner = remove_border(torch.ones(1, 10, 12), 3)
    assert inner.sum() == 4 * 6
    assert inner[0, 3, 3] == 1.0 and inner[0, 2, 3] == 0.0


def test_descriptors_are_linear_between_the_centres_of_cells():
    """A map that grows with the place says it: the centre of cell (i, j) is at pixel (8j + 3.5, 8i + 3.5)."""
    rows, columns = torch.meshgrid(torch.arange(6.0), torch.arange(7.0), indexing="ij")
    ramps = torch.stack([8 * columns + 3.5, 8 * rows + 3.5, torch.ones(6, 7)])[None]
    random = torch.Generator().manual_seed(0)
    pixels = 3.5 + torch.rand(1, 50, 2, generator=random) * torch.tensor([48.0, 40.0])
    found = sample_descriptors(ramps, pixels)
    torch.testing.assert_close(found[..., :2] / found[..., 2:], pixels)
    torch.testing.assert_close(found.norm(dim=-1), torch.ones(1, 50))


def test_sampling_is_the_libraries_own():
    random = torch.Generator().manual_seed(3)
    descriptors = torch.randn(2, 16, 5, 9, generator=random)
    pixels = torch.rand(2, 40, 2, generator=random) * torch.tensor([71.0, 39.0])
    size = torch.tensor([9.0, 5.0])
    grid = (2 * ((pixels - 3.5) / 8) + 1) / size - 1
    known = torch.nn.functional.grid_sample(descriptors, grid[:, None], padding_mode="border", align_corners=False)
    known = torch.nn.functional.normalize(known[:, :, 0].mT, dim=-1)
    torch.testing.assert_close(sample_descriptors(descriptors, pixels), known)


def test_one_cell_has_one_descriptor():
    descriptors = torch.tensor([3.0, 4.0]).reshape(1, 2, 1, 1)
    found = sample_descriptors(descriptors, torch.tensor([[[0.0, 0.0], [7.0, 7.0]]]))
    torch.testing.assert_close(found, torch.tensor([[[0.6, 0.8], [0.6, 0.8]]]))


def test_no_points_have_no_descriptors():
    assert sample_descriptors(torch.ones(1, 4, 2, 2), torch.zeros(1, 0, 2)).shape == (1, 0, 4)
