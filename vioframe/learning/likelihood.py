"""How likely the errors that add up over longer and longer stretches are, under the variances that are stated."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

# Below this variance (rad², m²) of a sum nothing is gained by stating less.
_LEAST_VARIANCE = 1e-12


def accumulated_likelihood(
    errors: Tensor,
    variances: Tensor,
    R_first_cur: Tensor,
    counted: Tensor,
    horizons: Sequence[int],
    *,
    lasting: Tensor | None = None,
    memory: float = math.inf,
) -> Tensor:
    """Mean negative log-likelihood of summed errors over the horizons, a degree of freedom.

    A filter adds up the variances of motions as if their errors were independent. Errors that last (a scale that is
    off for a minute) add up to more. So that what the filter states in the end holds, the likelihood is not that of
    each error but of their sums: with e_k turned into one frame by the true attitude R_k, for each stretch of h pairs

        E = Σ R_k e_k,    V = Σ R_k diag(σ_k²) R_kᵀ,    ½ (Eᵀ V⁻¹ E + ln det V) / 3,

    the mean over stretches, then over the horizons h. At its best σ_k² is the variance of white noise that would
    have summed up as far, in the mean over the horizons.

    What is known to last is stated as such: with J_k, what the motions of a stretch share adds (Σ R_k J_k)(Σ R_k J_k)ᵀ
    to V, less where a stretch outlasts its memory τ (a Gauss-Markov process: times 2 (x − 1 + e⁻ˣ) / x², x = h / τ).

    Args:
        errors: (B, S, 3), in the body at the later image.
        variances: (B, S, 3) in the same axes.
        R_first_cur: (B, S, 3, 3) true attitude there.
        counted: (B, S) bool, where there is an error.
        horizons: pairs; one that is longer than S counts as S.
        lasting: (B, S, 3, K), K errors that last, a standard deviation of each, in the same axes; None: there are none.
        memory: pairs after which of these 1/e is left.
    """
    R = R_first_cur.double() * counted[..., None, None]
    turned = (R @ errors.double()[..., None])[..., 0]
    spread = (R * variances.double()[..., None, :]) @ R.transpose(-1, -2)
    sums, spreads, numbers = _running(turned), _running(spread), _running(counted.double())
    shared = None if lasting is None else _running(R @ lasting.double())
    length = errors.shape[1]
    losses = []
    for horizon in sorted({min(horizon, length) for horizon in horizons}):
        starts = torch.arange(0, length - horizon + 1, max(horizon // 8, 1), device=errors.device)
        # A stretch with hardly a motion says nothing about stretches of its length.
        heard = 2.0 * (numbers[:, starts + horizon] - numbers[:, starts]) >= horizon
        if not bool(heard.any()):
            continue
        E = (sums[:, starts + horizon] - sums[:, starts])[heard]
        V = (spreads[:, starts + horizon] - spreads[:, starts])[heard]
        if shared is not None:
            together = (shared[:, starts + horizon] - shared[:, starts])[heard]
            V = V + _remembered(horizon / memory) * (together @ together.transpose(-1, -2))
        losses.append(_negative_log(E, V).mean())
    if not losses:
        return (errors.sum() + variances.sum()) * 0.0
    return torch.stack(losses).mean().to(variances.dtype)


def _negative_log(E: Tensor, V: Tensor) -> Tensor:
    """``½ (Eᵀ V⁻¹ E + ln det V) / 3`` of (K, 3) and (K, 3, 3), by cofactors, which is faster than factors."""
    a, b, c = (V[:, axis, axis] + _LEAST_VARIANCE for axis in range(3))
    d, e, f = V[:, 0, 1], V[:, 0, 2], V[:, 1, 2]
    aa, bb, cc = b * c - f * f, a * c - e * e, a * b - d * d
    ab, ac, bc = e * f - d * c, d * f - e * b, d * e - a * f
    determinant = a * aa + d * ab + e * ac
    x, y, z = E.unbind(-1)
    squared = aa * x * x + bb * y * y + cc * z * z + 2.0 * (ab * x * y + ac * x * z + bc * y * z)
    return (0.5 / 3.0) * (squared / determinant + determinant.log())


def _remembered(share: float) -> float:
    """Variance of a sum over ``share`` memories of a Gauss-Markov process, relative to that of one that stays."""
    if share < 1e-3:
        return 1.0 - share / 3.0
    return 2.0 * (share - 1.0 + math.exp(-share)) / share**2


def _running(values: Tensor) -> Tensor:
    """Sums (B, S + 1, …) of the first 0, 1, … S values."""
    return torch.cat([torch.zeros_like(values[:, :1]), values.cumsum(1)], dim=1)
