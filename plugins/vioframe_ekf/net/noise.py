"""What of the filter is learned: how far each sensor is believed."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn


class FilterNoise(nn.Module):
    """Variances that stay within some decades of where they start: σ² = σ₀² · 10^(β tanh(γ w)).

    Li & Waslander 2020, eq. 14, with w a weight each instead of the output of a net: where the VO has a net that
    states variances, σ₀² is what it states, and w only says by how much that is too little.
    """

    def __init__(
        self,
        *,
        densities: Sequence[float],
        bias_sigmas: Sequence[float],
        decades: float = 3.0,
        slope: float = 1.0,
        learn_inertial: bool = False,
    ) -> None:
        """Start from what is stated.

        Args:
            densities: (4) of the gyro rad/s/√Hz, the accelerometer m/s²/√Hz, the gyro's bias rad/s²/√Hz and the
                accelerometer's m/s³/√Hz.
            bias_sigmas: (2) of the two biases at the start, rad/s and m/s².
            decades: β, by which a variance can change at most.
            slope: γ.
            learn_inertial: learn densities and sigmas of the biases too.
        """
        super().__init__()
        self.decades, self.slope = decades, slope
        self.visual = nn.Parameter(torch.zeros(6))
        self.inertial = nn.Parameter(torch.zeros(6)) if learn_inertial else None
        self.register_buffer("_stated", torch.tensor([*densities, *bias_sigmas], dtype=torch.float64), persistent=False)

    def visual_factors(self) -> Tensor:
        """(6,) on the standard deviations of the VO, rotation first."""
        return self.factors(self.visual)

    def densities(self) -> Tensor:
        """(4,) as the argument of that name."""
        return self._inertial()[:4]

    def bias_sigmas(self) -> Tensor:
        """(2,) as the argument of that name."""
        return self._inertial()[4:]

    def _inertial(self) -> Tensor:
        stated: Tensor = self.get_buffer("_stated")
        return stated if self.inertial is None else stated * self.factors(self.inertial)

    def factors(self, w: Tensor) -> Tensor:
        """Of standard deviations, for weights of any shape."""
        return 10.0 ** (0.5 * self.decades * torch.tanh(self.slope * w.double()))
