"""Unit quaternions, scalar first, for files: everything else in vioframe uses matrices."""

import numpy as np

from vioframe.checks import Array


def to_matrix(quat_wxyz: Array) -> Array:
    """Rotation (..., 3, 3) of quaternions (..., 4), which are normalised first."""
    q = quat_wxyz / np.linalg.norm(quat_wxyz, axis=-1, keepdims=True)
    w, x, y, z = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    return np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], axis=-1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], axis=-1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=-1),
        ],
        axis=-2,
    )


def from_matrix(R: Array) -> Array:
    """Quaternions (..., 4), ordered (w, x, y, z) with w ≥ 0, of rotations (..., 3, 3)."""
    from vioframe.geometry import so3

    phi = so3.log(R)
    angle = np.linalg.norm(phi, axis=-1, keepdims=True)
    # sin(x/2)/x through sinc, which is exact at zero.
    vector = 0.5 * np.sinc(angle / (2 * np.pi)) * phi
    return np.concatenate([np.cos(0.5 * angle), vector], axis=-1)
