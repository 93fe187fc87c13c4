"""Losses of SuperPoint: what they are on cases that can be worked out by hand."""

import math

import pytest

torch = pytest.importorskip("torch", reason="needs torch (extra learn)")

from vioframe_superpoint.training import DenseLoss, SparseHingeLoss, SparseTripletLoss  # noqa: E402
from vioframe_superpoint.training.losses import (  # noqa: E402
    cell_centres,
    dense_loss,
    descriptor_loss,
    detector_loss,
    sparse_hinge_loss,
    sparse_triplet_loss,
    warp,
)

ROWS, COLUMNS, CHANNELS = 3, 4, 16
CELLS = ROWS * COLUMNS
DENSE = DenseLoss(weight=1.0, positive_margin=1.0, negative_margin=0.2, positive_weight=5.0, radius_px=7.9)
HINGE = SparseHingeLoss(
    weight=1.0, positive_margin=1.0, negative_margin=0.2, positive_weight=1.0, negatives=30, radius_px=7.9
)
TRIPLET = SparseTripletLoss(weight=1.2, margin=1.0, negatives=2, radius_px=7.9, both_ways=True)


def maps_of(descriptors):
    """Descriptors (N, D) of the cells as a map (1, D, h, w)."""
    return descriptors.T.reshape(1, -1, ROWS, COLUMNS)


@pytest.fixture
def orthogonal():
    return torch.eye(CHANNELS)[:CELLS]


def all_cells():
    return torch.ones(1, ROWS, COLUMNS, dtype=torch.bool)


def test_centre_of_the_first_cell_is_three_and_a_half():
    centres = cell_centres(ROWS, COLUMNS)
    assert centres[0].tolist() == [3.5, 3.5]
    assert centres[1].tolist() == [11.5, 3.5]
    assert centres[COLUMNS].tolist() == [3.5, 11.5]


def test_warp_translates_and_sends_what_lies_behind_far_away():
    points = torch.tensor([[[1.0, 2.0], [3.0, 4.0]]])
    H = torch.tensor([[[1.0, 0.0, 5.0], [0.0, 1.0, -1.0], [0.0, 0.0, 1.0]]])
    assert warp(points, H)[0].tolist() == [[6.0, 1.0], [8.0, 3.0]]
    H[0, 2, 2] = -1.0
    assert (warp(points, H).abs() > 1e5).all()


def test_detector_loss_of_knowing_nothing_is_the_logarithm_of_the_classes():
    logits = torch.zeros(2, 65, ROWS, COLUMNS)
    classes = torch.randint(65, (2, ROWS, COLUMNS), generator=torch.Generator().manual_seed(0))
    loss = detector_loss(logits, classes, torch.ones_like(classes, dtype=torch.bool))
    assert float(loss) == pytest.approx(math.log(65.0), rel=1e-6)


def test_detector_loss_counts_valid_cells_only():
    logits = torch.zeros(1, 65, ROWS, COLUMNS)
    classes = torch.full((1, ROWS, COLUMNS), 64)
    logits[0, 64, 0, 0] = 100.0
    valid = torch.zeros(1, ROWS, COLUMNS, dtype=torch.bool)
    valid[0, 0, 0] = True
    assert float(detector_loss(logits, classes, valid)) == pytest.approx(0.0, abs=1e-6)
    assert float(detector_loss(logits, classes, ~valid)) == pytest.approx(math.log(65.0), rel=1e-6)
    assert float(detector_loss(logits, classes, torch.zeros_like(valid))) == 0.0


def test_all_losses_vanish_where_descriptors_are_orthogonal_and_correspond(orthogonal):
    points = cell_centres(ROWS, COLUMNS)[None]
    maps = maps_of(orthogonal)
    matched = torch.ones(1, CELLS, dtype=torch.bool)
    for options in (DENSE, HINGE, TRIPLET):
        loss = descriptor_loss(
            options,
            maps,
            maps,
            torch.eye(3)[None],
            points=(points, points),
            matched=matched,
            valid=(all_cells(), all_cells()),
            seed=0,
        )
        assert float(loss) == pytest.approx(0.0, abs=1e-5), options


def test_dense_loss_of_equal_descriptors_is_the_share_of_pairs_apart_times_the_hinge():
    maps = torch.ones(1, CHANNELS, ROWS, COLUMNS)
    loss = dense_loss(DENSE, maps, maps, torch.eye(3)[None], (all_cells(), all_cells()))
    apart = 1.0 - 1.0 / CELLS
    assert float(loss) == pytest.approx(apart * (1.0 - 0.2), rel=1e-5)


def test_dense_loss_follows_the_homography(orthogonal):
    # The second image is the first moved by one cell to the right.
    second = torch.roll(maps_of(orthogonal), 1, dims=3)
    H = torch.tensor([[[1.0, 0.0, 8.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]])
    inside = all_cells()
    inside[..., -1] = False
    shown = all_cells()
    shown[..., 0] = False
    assert float(dense_loss(DENSE, maps_of(orthogonal), second, H, (inside, shown))) == pytest.approx(0.0, abs=1e-5)
    still = dense_loss(DENSE, maps_of(orthogonal), second, torch.eye(3)[None], (inside, shown))
    assert float(still) > 0.1


def test_sparse_hinge_by_hand():
    # Two matches a distance apart: one perfect, the other at right angles; all non-matches alike.
    first = torch.tensor([[[1.0, 0.0], [1.0, 0.0]]])
    second = torch.tensor([[[1.0, 0.0], [0.0, 1.0]]])
    places = torch.tensor([[[0.0, 0.0], [100.0, 0.0]]])
    matched = torch.ones(1, 2, dtype=torch.bool)
    loss = sparse_hinge_loss(HINGE, first, second, places, matched, seed=3)
    # Non-matches of the second point: with the first of the other image, which is the same, 1 - 0.2 each time.
    generator = torch.Generator().manual_seed(3)
    drawn = torch.randint(2, (1, 2, 2), generator=generator)
    violating = int((drawn[0, 1] == 0).sum())
    assert float(loss) == pytest.approx(0.5 * (0.0 + 1.0) + 0.8 * violating / (violating + 1), rel=1e-6)


def test_sparse_triplet_by_hand():
    angle = math.pi / 3
    first = torch.tensor([[[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]]])
    second = torch.tensor([[[1.0, 0.0], [math.sin(angle), math.cos(angle)], [-1.0, 0.0]]])
    places = torch.tensor([[[0.0, 0.0], [50.0, 0.0], [100.0, 0.0]]])
    matched = torch.ones(1, 3, dtype=torch.bool)
    options = SparseTripletLoss(weight=1.0, margin=1.0, negatives=1, radius_px=8.0, both_ways=False)
    loss = sparse_triplet_loss(options, first, second, (places, places), matched)
    # Squared distances 2 - 2 cos: rows of the first against columns of the second.
    distance = 2.0 - 2.0 * (first[0] @ second[0].T)
    hardest = [min(float(distance[i, j]) for j in range(3) if j != i) for i in range(3)]
    expected = sum(max(0.0, 1.0 + float(distance[i, i]) - hardest[i]) for i in range(3)) / 3
    assert float(loss) == pytest.approx(expected, rel=1e-5)
    assert expected > 0.1


def test_triplet_takes_no_negative_beside_the_match_and_none_that_is_not_there():
    first = torch.tensor([[[1.0, 0.0], [1.0, 0.0], [1.0, 0.0]]])
    places = torch.tensor([[[0.0, 0.0], [3.0, 0.0], [500.0, 0.0]]])
    matched = torch.tensor([[True, True, False]])
    # Only neighbours and what is not there would violate the margin.
    assert float(sparse_triplet_loss(TRIPLET, first, first, (places, places), matched)) == 0.0


@pytest.mark.parametrize("options", [DENSE, HINGE, TRIPLET], ids=lambda options: type(options).__name__)
def test_losses_are_computed_in_single_precision_whatever_the_net_computes_in(options):
    # Far from the origin, where bf16 knows coordinates to 2 px; the radius is within a pixel of a warped centre.
    generator = torch.Generator().manual_seed(2)
    rows, columns = 30, 40
    maps = [torch.randn(1, CHANNELS, rows, columns, generator=generator).bfloat16() for _ in range(2)]
    H = torch.tensor([[[1.01, 0.02, 3.3], [-0.01, 0.99, -2.7], [1e-5, 2e-5, 1.0]]])
    centres = cell_centres(rows, columns)[None]
    points = (centres, warp(centres, H))
    shown = torch.ones(1, rows, columns, dtype=torch.bool)

    def loss(first, second):
        return descriptor_loss(
            options,
            first,
            second,
            H,
            points=points,
            matched=torch.ones(1, rows * columns, dtype=torch.bool),
            valid=(shown, shown),
            seed=0,
        )

    with torch.autocast("cpu", dtype=torch.bfloat16):
        mixed = loss(*maps)
    assert mixed.dtype == torch.float32
    assert float(mixed) == float(loss(*(each.float() for each in maps)))


@pytest.mark.parametrize("options", [DENSE, HINGE, TRIPLET], ids=lambda options: type(options).__name__)
def test_losses_have_gradients_that_bring_matches_together(options):
    generator = torch.Generator().manual_seed(1)
    first = torch.randn(2, CHANNELS, ROWS, COLUMNS, generator=generator)
    second = torch.randn(2, CHANNELS, ROWS, COLUMNS, generator=generator).requires_grad_()
    points = cell_centres(ROWS, COLUMNS).expand(2, -1, -1)
    arguments = {
        "points": (points, points),
        "matched": torch.ones(2, CELLS, dtype=torch.bool),
        "valid": (all_cells().expand(2, -1, -1), all_cells().expand(2, -1, -1)),
        "seed": 0,
    }
    H = torch.eye(3).expand(2, 3, 3)
    optimizer = torch.optim.Adam([second], lr=0.1)
    losses = []
    for _ in range(60):
        loss = descriptor_loss(options, first, second, H, **arguments)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.2 * losses[0]
    nearest = torch.nn.functional.cosine_similarity(first, second, dim=1)
    assert float(nearest.detach().mean()) > 0.5
