"""The losses: their printed form, their minimum, and the gradients that lead there."""

import math

import pytest

pytest.importorskip("torch", reason="needs torch: pip install 'vioframe[learn]'")

import torch

from vioframe.errors import ConfigError
from vioframe.learning.losses import FixedWeights, GaussianLikelihood, LearnedWeights, squared_errors


@pytest.fixture
def vectors():
    torch.manual_seed(0)
    target = torch.randn(5, 4, 6, dtype=torch.float64)
    return target + 0.1 * torch.randn_like(target), target


def test_squared_errors_are_mean_squared_lengths(vectors):
    predicted, target = vectors
    rotation, translation = squared_errors(predicted, target)
    lengths = torch.linalg.vector_norm(predicted[..., :3] - target[..., :3], dim=-1)
    assert rotation.item() == pytest.approx((lengths**2).mean().item())
    lengths = torch.linalg.vector_norm(predicted[..., 3:] - target[..., 3:], dim=-1)
    assert translation.item() == pytest.approx((lengths**2).mean().item())


def test_learned_weights_start_as_printed(vectors):
    """Equation 7 with s_t = 0 and s_r = −3."""
    loss = LearnedWeights()
    rotation, translation = squared_errors(*vectors)
    expected = translation.item() + 0.0 + rotation.item() * math.exp(3.0) - 3.0
    assert loss(*vectors)["loss"].item() == pytest.approx(expected, rel=1e-6)


def test_learned_weights_settle_at_the_logarithm_of_the_errors(vectors):
    loss = LearnedWeights().double()
    optimizer = torch.optim.LBFGS(loss.parameters(), max_iter=100, line_search_fn="strong_wolfe")

    def closure():
        optimizer.zero_grad()
        value = loss(*vectors)["loss"]
        value.backward()
        return value

    optimizer.step(closure)
    rotation, translation = squared_errors(*vectors)
    assert loss.log_variance_rotation.item() == pytest.approx(math.log(rotation), abs=1e-4)
    assert loss.log_variance_translation.item() == pytest.approx(math.log(translation), abs=1e-4)
    assert loss(*vectors)["loss"].item() == pytest.approx(2 + math.log(rotation) + math.log(translation), abs=1e-6)


def test_fixed_weights_are_one_to_a_hundred(vectors):
    rotation, translation = squared_errors(*vectors)
    assert FixedWeights()(*vectors)["loss"].item() == pytest.approx((translation + 100 * rotation).item())
    with pytest.raises(ConfigError, match="weight of rotation must be positive, got 0"):
        FixedWeights(rotation_weight=0)


def test_likelihood_is_that_of_a_gaussian_and_finds_its_variance():
    torch.manual_seed(1)
    sigma = torch.tensor([0.1, 0.2, 0.3, 1.0, 2.0, 3.0], dtype=torch.float64)
    target = torch.zeros(20_000, 6, dtype=torch.float64)
    predicted = sigma * torch.randn_like(target)
    stated = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    value = GaussianLikelihood()(predicted, target, stated.expand_as(target))["loss"]
    density = torch.distributions.Normal(target, torch.ones_like(target)).log_prob(predicted).sum(-1).mean()
    assert value.item() == pytest.approx(-density.item() - 3 * math.log(2 * math.pi), rel=1e-9)
    at_truth = (2 * sigma.log()).clone().requires_grad_()
    GaussianLikelihood()(predicted, target, at_truth.expand_as(target))["loss"].backward()
    torch.testing.assert_close(at_truth.grad, torch.zeros(6, dtype=torch.float64), rtol=0, atol=0.02)


def test_gradients_are_the_numerical_ones(vectors):
    predicted, target = vectors[0][:2].clone().requires_grad_(), vectors[1][:2]
    learned = LearnedWeights().double()
    assert torch.autograd.gradcheck(lambda p: learned(p, target)["loss"], (predicted,))
    s = torch.randn_like(predicted).requires_grad_()
    assert torch.autograd.gradcheck(lambda p, v: GaussianLikelihood()(p, target, v)["loss"], (predicted, s))
