"""Where a point of camera 0 can be in camera 1 at the same instant, and whether a match is possible."""

import numpy as np

from vioframe.checks import Array, Mask
from vioframe.errors import DataError
from vioframe.geometry import camera as projection
from vioframe.geometry import se3
from vioframe.types import Camera


class TwoCameras:
    """The calibrated geometry of a rig whose views overlap; nothing is rectified.

    Args:
        left: camera 0.
        right: camera 1.
        epipolar_px: distance from the epipolar line that contradicts a match.
        min_depth: nearer points are not matched, m.

    Raises:
        DataError: the cameras sit at the same place.
    """

    def __init__(self, left: Camera, right: Camera, *, epipolar_px: float, min_depth: float) -> None:
        self.left, self.right = left, right
        T_right_left = se3.inverse(right.T_body_cam) @ left.T_body_cam
        self._R_right_left, self._base = T_right_left[:3, :3], T_right_left[:3, 3]
        self.baseline = float(np.linalg.norm(self._base))
        if self.baseline < 1e-4:
            raise DataError(f"stereo needs two cameras apart from each other, but theirs is {self.baseline:.2g} m")
        self.focal_px = float(np.mean(right.intrinsics_px[:2]))
        self.max_inverse_depth = 1.0 / min_depth
        self._threshold = epipolar_px / self.focal_px
        # So far beyond infinity does noise put a point that is far away.
        self._least_inverse_depth = -2.0 * self._threshold / self.baseline

    def project(self, bearings: Array, inverse_depth: Array) -> tuple[Array, Mask]:
        """Pixels (M, 2) in camera 1, and visible there (M,).

        Args:
            bearings: (M, 3) in camera 0.
            inverse_depth: (M,) 1/z in camera 0, 1/m.
        """
        return projection.project(self.right, self._turned(bearings) + inverse_depth[:, None] * self._base)

    def inverse_depth(self, bearings: Array, bearings_right: Array) -> tuple[Array, Mask]:
        """1/z (M,) in camera 0 of matches, and which (M,) lie near their epipolar line at a possible depth.

        The inverse depth ρ is the least-squares solution of ``b₁ × (R h₀ + ρ t) = 0``, with ``h₀`` the ray of
        camera 0 at depth 1.
        """
        turned = self._turned(bearings)
        across_base = np.cross(bearings_right, self._base)
        inverse_depth = -np.sum(np.cross(bearings_right, turned) * across_base, axis=-1) / np.maximum(
            np.sum(across_base * across_base, axis=-1), 1e-18
        )
        possible = (inverse_depth > self._least_inverse_depth) & (inverse_depth < self.max_inverse_depth)
        return inverse_depth, possible & self.near_line(bearings, bearings_right)

    def near_line(self, bearings: Array, bearings_right: Array) -> Mask:
        """Which rays (M, 3) and (M, 3) of the two cameras lie in one epipolar plane (M,)."""
        normal, length = self._planes(bearings)
        near: Mask = np.abs(np.sum(normal * bearings_right, axis=-1)) < self._threshold * length
        return near

    def possible_pairs(self, bearings: Array, bearings_right: Array) -> tuple[np.ndarray, np.ndarray]:
        """Pairs (rows, columns) of rays (M, 3) and (K, 3) that can be one point."""
        normal, length = self._planes(bearings)
        rows, columns = np.nonzero(np.abs(normal @ bearings_right.T) < (self._threshold * length)[:, None])
        _, possible = self.inverse_depth(bearings[rows], bearings_right[columns])
        return rows[possible], columns[possible]

    def _planes(self, bearings: Array) -> tuple[Array, Array]:
        """Normals (M, 3) of the epipolar planes, in the axes of camera 1, and their lengths (M,)."""
        normal = np.cross(self._turned(bearings), self._base)
        return normal, np.linalg.norm(normal, axis=-1)

    def _turned(self, bearings: Array) -> Array:
        """Rays at depth 1 in camera 0, in the axes of camera 1."""
        turned: Array = (bearings / np.maximum(bearings[..., 2:], 1e-3)) @ self._R_right_left.T
        return turned
