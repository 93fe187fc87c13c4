"""Finding the scale: a bank of filters, one for each range of it, weighed by how well they predict.

While the scale is unknown the problem is bilinear (an unknown scale times an unknown velocity), which one
Gaussian cannot hold. Given the scale to a third it is nearly linear. So the search is a Gaussian sum
(Alspach & Sorenson, "Nonlinear Bayesian Estimation Using Gaussian Sum Approximations", IEEE TAC 1972):
filters whose log scales tile the range, each with its weight; those that predict badly die, those that have
arrived at the same scale are merged, until one is left that knows it.
"""

from dataclasses import dataclass

import numpy as np

from vioframe.checks import Array
from vioframe.error_state import INERTIAL, Body, difference, retract
from vioframe_msf.state import ScaledFilter

# Spacing of the log scales and standard deviation of each: the sum of such Gaussians is flat to 1 %.
_SPACING = 0.5
_SIGMA = 0.35
# Weights below e^-12 of the best do not come back.
_HOPELESS = 12.0
# Two that are nearer than this many of the smaller sigma say the same.
_SAME = 1.0


@dataclass(slots=True)
class Hypothesis:
    """A filter and the logarithm of its weight."""

    state: ScaledFilter
    log_weight: float = 0.0


class ScaleSearch:
    """The bank, from one filter without a scale.

    Args:
        start: what is known without the scale.
        guess: middle of the range, metres per unit of the VO.
        ratio: the range goes from guess/ratio to guess·ratio.
    """

    def __init__(self, start: ScaledFilter, guess: float, ratio: float) -> None:
        count = 1 + int(np.ceil(np.log(ratio) / _SPACING))
        self.hypotheses: list[Hypothesis] = []
        for step in range(-count + 1, count):
            state = start.copy()
            state.set_scale(guess * float(np.exp(step * _SPACING)), _SIGMA)
            self.hypotheses.append(Hypothesis(state))

    @property
    def best(self) -> ScaledFilter:
        """The filter with the largest weight."""
        return max(self.hypotheses, key=lambda hypothesis: hypothesis.log_weight).state

    def summary(self) -> tuple[Body, Array]:
        """Mean and covariance (15, 15), right-invariant, of what all hypotheses together say of the body."""
        weights = np.exp([hypothesis.log_weight for hypothesis in self.hypotheses])
        weights /= weights.sum()
        best = self.best.body
        offsets = np.array([difference(best, hypothesis.state.body) for hypothesis in self.hypotheses])
        mean = weights @ offsets
        spread = offsets - mean
        covariance = np.einsum("n,ni,nj->ij", weights, spread, spread)
        for weight, hypothesis in zip(weights, self.hypotheses, strict=True):
            covariance += weight * hypothesis.state.covariance[INERTIAL, INERTIAL]
        return retract(best, mean), covariance

    def reduce(self) -> None:
        """Drop the hopeless, merge those that have come to say the same."""
        ranked = sorted(self.hypotheses, key=lambda hypothesis: -hypothesis.log_weight)
        kept: list[Hypothesis] = []
        for hypothesis in ranked:
            if hypothesis.log_weight < ranked[0].log_weight - _HOPELESS:
                break
            for other in kept:
                sigma = min(other.state.scale_sigma, hypothesis.state.scale_sigma)
                if abs(np.log(other.state.scale / hypothesis.state.scale)) < _SAME * sigma:
                    other.log_weight = float(np.logaddexp(other.log_weight, hypothesis.log_weight))
                    break
            else:
                kept.append(hypothesis)
        top = max(hypothesis.log_weight for hypothesis in kept)
        for hypothesis in kept:
            hypothesis.log_weight -= top
        self.hypotheses = kept

    def found(self, sigma: float, probability: float) -> bool:
        """True once one hypothesis has this probability, and knows the scale to this relative sigma."""
        weights = np.exp([hypothesis.log_weight for hypothesis in self.hypotheses])
        return bool(weights.max() / weights.sum() >= probability and self.best.scale_sigma < sigma)
