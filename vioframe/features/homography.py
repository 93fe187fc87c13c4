"""Whether matches give the motion: a homography estimated from them, against the true one."""

from collections.abc import Sequence

import cv2
import numpy as np

from vioframe.checks import Array
from vioframe.features.protocol import FeatureProtocol
from vioframe.pictures.homographies import warp_points

_FEWEST = 4


def estimate_homography(first: Array, second: Array, protocol: FeatureProtocol) -> Array | None:
    """The homography (3, 3) that most matches agree with, refined on them; None where there is none.

    ``cv2.findHomography`` with RANSAC, whose generator starts from the same seed each time.

    Args:
        first: (N, 2) px.
        second: (N, 2) px, the points matched with them.
        protocol: of RANSAC.
    """
    if len(first) < _FEWEST:
        return None
    H, _ = cv2.findHomography(
        first.astype(np.float64),
        second.astype(np.float64),
        cv2.RANSAC,
        protocol.ransac_px,
        maxIters=protocol.ransac_iterations,
        confidence=protocol.ransac_confidence,
    )
    return None if H is None or not np.isfinite(H).all() else H


def corner_error_px(estimated: Array | None, H_second_first: Array, size_px: tuple[int, int]) -> float:
    """Mean distance, in the second picture, of the first's four corners under both homographies.

    DeTone et al. 2018, section 7.3: ‖ĉ'_j − c'_j‖ averaged over the corners. Infinite where there is no estimate, or
    where it sends a corner behind the camera.

    Args:
        estimated: (3, 3) or None.
        H_second_first: (3, 3), the true one.
        size_px: (width, height).
    """
    if estimated is None:
        return float("inf")
    right, bottom = size_px[0] - 1.0, size_px[1] - 1.0
    corners = np.array([[0.0, 0.0], [right, 0.0], [right, bottom], [0.0, bottom]])
    error = float(np.linalg.norm(warp_points(corners, estimated) - warp_points(corners, H_second_first), axis=1).mean())
    return error if np.isfinite(error) else float("inf")


def homography_accuracy(errors_px: Sequence[float], epsilon_px: float) -> float:
    """Share of pairs whose corner error is at most ε; pairs without an estimate count as missed.

    Args:
        errors_px: of at least one pair.
        epsilon_px: ε.
    """
    return float(np.mean(np.asarray(errors_px) <= epsilon_px))
