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


def gyro_biases(pairs: Pairs, T_prev_cur: Array) -> Array:
    """Mean bias (W, 3) rad/s of the gyro in each window that has samples, of true motions (B, ≥ S, 4, 4)."""
    R_true, _ = true_motions(T_prev_cur[:, -len(pairs) :], pairs.T_body_cam)
    apart = so3.log(transposed(R_true) @ pairs.R_gyro) * pairs.inertial[..., None]
    seconds = (pairs.duration_s * pairs.inertial).sum(axis=1)
    heard = seconds > 0.0
    biases: Array = apart.sum(axis=1)[heard] / seconds[heard][:, None]
    return biases[np.isfinite(biases).all(axis=-1)]
