"""No motion, as a measurement."""

import numpy as np

from vioframe.error_state import THETA, VELOCITY
from vioframe.fusion_options import StandstillOptions
from vioframe.geometry import se3, so3
from vioframe_msckf.correction import correct_by_residuals
from vioframe_msckf.state import CLONES, DELAY, FilterState


def measure_standstill(state: FilterState, options: StandstillOptions) -> bool:
    """Measure that the camera stands where the newest clone was taken, and has no velocity.

    The reference stays the same as long as the body rests, so the position does not walk however long that is. When
    exactly an image of a rest was taken makes no difference, and must not: the rate of a body that rests is
    vibration, from which the filter would otherwise learn a delay.

    Args:
        state: with one clone or more.
        options: how sharp; a contradiction is not used.

    Returns:
        Whether it was used.
    """
    reference = slice(state.clone_errors.stop - 6, state.clone_errors.stop)
    T_before = se3.from_parts(state.R_clones[-1], state.p_clones[-1])
    T_new, J = state.camera_pose(0.0, np.zeros(3))
    J[:, DELAY] = 0.0
    H = np.zeros((9, len(state.covariance)))
    residual = np.zeros(9)
    residual[:6] = se3.log(se3.inverse(T_new) @ T_before)
    back = se3.adjoint(se3.inverse(T_new))
    H[:6, :CLONES] = back @ J
    H[:6, reference] = -back
    residual[6:] = -state.body.v
    H[6:, VELOCITY] = np.eye(3)
    H[6:, THETA] = -so3.hat(state.body.v)
    sigmas = np.repeat([options.rotation_sigma, options.position_sigma, options.velocity_sigma], 3)
    HP = H @ state.covariance
    S = HP @ H.T + np.diag(sigmas**2)
    if not residual @ np.linalg.solve(S, residual) <= options.gate():
        return False
    return correct_by_residuals(state, HP, S, residual)
