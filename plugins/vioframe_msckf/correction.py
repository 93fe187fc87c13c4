"""The two forms of the filter's correction."""

import numpy as np

from vioframe.checks import Array
from vioframe_msckf.state import FilterState


def correct_by_information(state: FilterState, information: Array, right: Array) -> bool:
    """Correct by many residuals that depend on the clones only, at a cost that does not grow with their number.

    With Λ = HᵀH and η = Hᵀr of residuals of unit noise on the errors c: ``δ = P_c (I + Λ P_cc)⁻¹ η`` and
    ``P ← P − P_c (I + Λ P_cc)⁻¹ Λ P_cᵀ`` (the push-through identity on the Kalman gain).

    The residuals do not change when all clones move as one, so c may be told relative to the newest clone. Then the
    large variance of a common turn and shift is not multiplied by a large Λ only to cancel, and rounding cannot
    make the filter learn what no track can say.

    Args:
        state: is corrected.
        information: Λ (6M, 6M); the same error of all clones is in its null space.
        right: η (6M,).

    Returns:
        False where rounding gave no finite answer; the state is then as before.
    """
    P = state.covariance
    columns = state.clone_errors
    by_clone = P[:, columns].reshape(len(P), -1, 6)
    P_c: Array = (by_clone - by_clone[:, -1:]).reshape(len(P), -1)
    among = P_c[columns].reshape(-1, 6, P_c.shape[1])
    system = information @ (among - among[-1]).reshape(-1, P_c.shape[1])
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
