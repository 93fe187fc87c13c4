"""The two forms of the filter's correction."""

import numpy as np

from vioframe.checks import Array
from vioframe_msckf.state import FilterState


def correct_by_information(state: FilterState, columns: slice, information: Array, right: Array) -> bool:
    """Correct by many residuals that depend on some errors only, at a cost that does not grow with their number.

    With Λ = HᵀH and η = Hᵀr of residuals of unit noise on the errors c: ``δ = P_c (I + Λ P_cc)⁻¹ η`` and
    ``P ← P − P_c (I + Λ P_cc)⁻¹ Λ P_cᵀ`` (the push-through identity on the Kalman gain).

    Args:
        state: is corrected.
        columns: the errors c.
        information: Λ (c, c).
        right: η (c,).

    Returns:
        False where rounding gave no finite answer; the state is then as before.
    """
    P = state.covariance
    P_c = P[:, columns]
    system = information @ P_c[columns]
    system[np.diag_indices_from(system)] += 1.0
    solved = np.linalg.solve(system, np.concatenate([information, right[:, None]], axis=1))
    error = P_c @ solved[:, -1]
    weight = solved[:, :-1]
    return _accept(state, error, P - P_c @ (0.5 * (weight + weight.T)) @ P_c.T)


def correct_by_residuals(state: FilterState, HP: Array, S: Array, residual: Array) -> bool:
    """Correct by few residuals.

    Args:
        state: is corrected.
        HP: (m, n) H P.
        S: (m, m) covariance of the residuals.
        residual: (m,).

    Returns:
        False where there was no finite answer; the state is then as before.
    """
    try:
        # The inverse of the factor, since it multiplies a matrix as wide as the state.
        factor = np.linalg.inv(np.linalg.cholesky(S))
    except np.linalg.LinAlgError:
        return False
    half = factor @ HP
    return _accept(state, half.T @ (factor @ residual), state.covariance - half.T @ half)


def _accept(state: FilterState, error: Array, covariance: Array) -> bool:
    if not (np.isfinite(error).all() and np.isfinite(covariance).all() and covariance.diagonal().min() >= 0.0):
        return False
    state.covariance = covariance
    state.apply(error)
    return True
