"""What the truth of a batch says of the body, for losses."""

import numpy as np

from vioframe.checks import Array
from vioframe.geometry import so3
from vioframe_lstm.pairs import Pairs, transposed, turned


def true_motions(T_prev_cur: Array, T_body_cam: Array) -> tuple[Array, Array]:
    """Rotation (B, S, 3, 3) and shift (B, S, 3) m of the body of motions (B, S, 4, 4) of a camera at (B, 4, 4)."""
    R_body_cam, p_body_cam = T_body_cam[:, None, :3, :3], T_body_cam[:, None, :3, 3]
    R = R_body_cam @ T_prev_cur[..., :3, :3] @ transposed(R_body_cam)
    return R, turned(R_body_cam, T_prev_cur[..., :3, 3]) + p_body_cam - turned(R, p_body_cam)


def gyro_errors(pairs: Pairs, T_prev_cur: Array) -> tuple[Array, Array, np.ndarray]:
    """Mean errors (W, 3) rad/s of the gyro in the windows that have samples, over how long (W,) s, and which (W,).

    Args:
        pairs: (B, S).
        T_prev_cur: (B, ≥ S, 4, 4) true motion of the camera.
    """
    R_true, _ = true_motions(T_prev_cur[:, -len(pairs) :], pairs.T_body_cam)
    apart = so3.log(transposed(R_true) @ pairs.R_gyro) * pairs.inertial[..., None]
    seconds = (pairs.duration_s * pairs.inertial).sum(axis=1)
    total = apart.sum(axis=1)
    which = np.flatnonzero((seconds > 0.0) & np.isfinite(total).all(axis=-1))
    return total[which] / seconds[which, None], seconds[which], which
