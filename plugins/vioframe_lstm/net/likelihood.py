"""How likely the errors that add up over longer and longer stretches are, under the variances that are stated."""

from collections.abc import Sequence

import torch
from torch import Tensor

from vioframe.learning.motion import product

# Below this standard deviation (rad, m) nothing is gained by stating less.
_LEAST_VARIANCE = 1e-12


def accumulated_likelihood(
    errors: Tensor, variances: Tensor, R_first_cur: Tensor, counted: Tensor, horizons: Sequence[int]
) -> Tensor:
    """Mean negative log-likelihood of summed errors over the horizons, a degree of freedom.

    A filter adds up the variances of motions as if their errors were independent. Errors that last (a scale that is
    off for a minute) add up to more. So that what the filter states in the end holds, the likelihood is not that of
    each error but of their sums: with e_k turned into one frame by the true attitude R_k, for each stretch of h pairs

        E = Σ R_k e_k,    V = Σ R_k diag(σ_k²) R_kᵀ,    ½ (Eᵀ V⁻¹ E + ln det V) / 3,

    the mean over stretches, then over the horizons h. At its best σ_k² is the variance of white noise that would
    have summed up as far, in the mean over the horizons.

    Args:
        errors: (B, S, 3), in the body at the later image.
        variances: (B, S, 3) in the same axes.
        R_first_cur: (B, S, 3, 3) true attitude there.
        counted: (B, S) bool, where there is an error.
        horizons: pairs; those longer than S are left out.
    """
    turned = (product(R_first_cur, errors[..., None])[..., 0] * counted[..., None]).double()
    spread = product(R_first_cur * variances[..., None, :], R_first_cur.transpose(-1, -2))
    spread = (spread * counted[..., None, None]).double()
    sums, spreads, numbers = _running(turned), _running(spread), _running(counted.double())
    length = errors.shape[1]
    losses = []
    for horizon in horizons:
        if horizon > length:
            continue
        starts = torch.arange(0, length - horizon + 1, max(horizon // 8, 1), device=errors.device)
        error = sums[:, starts + horizon] - sums[:, starts]
        spread_there = spreads[:, starts + horizon] - spreads[:, starts]
        # A stretch with hardly a motion says nothing about stretches of its length.
        heard = 2.0 * (numbers[:, starts + horizon] - numbers[:, starts]) >= horizon
        if not bool(heard.any()):
            continue
        V = spread_there[heard] + _LEAST_VARIANCE * torch.eye(3, dtype=torch.float64, device=errors.device)
        factor = torch.linalg.cholesky(V)
        whitened = torch.linalg.solve_triangular(factor, error[heard][..., None], upper=False)[..., 0]
        log_determinant = 2.0 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        losses.append(0.5 * (whitened.square().sum(-1) + log_determinant).mean() / 3.0)
    if not losses:
        return (errors.sum() + variances.sum()) * 0.0
    return torch.stack(losses).mean().to(errors.dtype)


def attitudes(R_prev_cur: Tensor) -> Tensor:
    """Products R_0_k (B, S, 3, 3) of rotations in a row, k = 1 … S, by doubling the stretches that are multiplied."""
    products, step = R_prev_cur, 1
    while step < products.shape[1]:
        products = torch.cat([products[:, :step], product(products[:, :-step], products[:, step:])], dim=1)
        step *= 2
    return products


def _running(values: Tensor) -> Tensor:
    """Sums (B, S + 1, …) of the first 0, 1, … S values."""
    return torch.cat([torch.zeros_like(values[:, :1]), values.cumsum(1)], dim=1)
