"""How likely errors are that add up, beside multivariate Gaussians written out."""

import math

import pytest

pytest.importorskip("torch", reason="needs torch: pip install 'vioframe[learn]'")

import torch

from vioframe.learning.likelihood import accumulated_likelihood
from vioframe.learning.motion import exp_so3


@pytest.mark.parametrize("memory", [math.inf, 5.0])
def test_sums_are_those_of_a_gaussian_with_what_lasts(memory):
    torch.manual_seed(0)
    pairs = 12
    errors = torch.randn(1, pairs, 3, dtype=torch.float64)
    variances = 0.1 + torch.rand(1, pairs, 3, dtype=torch.float64)
    lasting = torch.randn(1, pairs, 3, 2, dtype=torch.float64)
    R = exp_so3(torch.randn(1, pairs, 3, dtype=torch.float64))
    counted = torch.ones(1, pairs, dtype=torch.bool)
    found = accumulated_likelihood(errors, variances, R, counted, [pairs], lasting=lasting, memory=memory)
    total = (R @ errors[..., None]).sum((0, 1))[:, 0]
    shared = (R @ lasting).sum((0, 1))
    share = pairs / memory
    left = 1.0 if share == 0.0 else 2.0 * (share - 1.0 + math.exp(-share)) / share**2
    V = (R @ torch.diag_embed(variances) @ R.transpose(-1, -2)).sum((0, 1)) + left * shared @ shared.T
    gaussian = torch.distributions.MultivariateNormal(torch.zeros(3, dtype=torch.float64), V)
    expected = -gaussian.log_prob(total) / 3.0 - 0.5 * math.log(2.0 * math.pi)
    assert found.item() == pytest.approx(expected.item(), rel=1e-9)


def test_a_scale_that_is_off_is_found_beside_white_noise():
    """Both variances at once, by descent: a share of 3 % that lasts, and 0.1 m each time."""
    torch.manual_seed(1)
    sequences, pairs = 400, 128
    steps = torch.zeros(sequences, pairs, 3, dtype=torch.float64)
    steps[..., 0] = 1.0
    scale = 0.03 * torch.randn(sequences, 1, 1, dtype=torch.float64)
    errors = scale * steps + 0.1 * torch.randn(sequences, pairs, 3, dtype=torch.float64)
    R = torch.eye(3, dtype=torch.float64).expand(sequences, pairs, 3, 3)
    logs = torch.tensor([-2.0, -2.0], dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.Adam([logs], lr=0.1)
    for _ in range(120):
        white, shared = logs.exp()
        cost = accumulated_likelihood(
            errors,
            white**2 * torch.ones_like(errors),
            R,
            torch.ones(sequences, pairs, dtype=torch.bool),
            [8, 32, 128],
            lasting=(shared * steps)[..., None],
        )
        optimizer.zero_grad()
        cost.backward()
        optimizer.step()
    assert logs.exp().tolist() == pytest.approx([0.1, 0.03], rel=0.1)
