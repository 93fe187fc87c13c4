"""Patches as they first looked, found again under an affine warp: what keeps a track from drifting."""

import cv2
import numpy as np

from vioframe.checks import Array
from vioframe.types import Image

# Standard deviation of the weight of a patch's pixels, in half sides: the middle counts most.
_WEIGHT_SPREAD = 0.6
# Variance of a patch below which it is noise of rounding to whole grey levels, (grey levels)².
_FLAT = 1.0 / 12.0
# Added to the diagonal of the normal equations, (grey levels)²: a patch without texture then does not move.
_DAMPING = 1e-3


class Anchors:
    """One template a point, cut from the image in which the point was taken.

    ``align`` minimises ``Σ w (I(A x + p) − g T(x) − b)²`` over the affine warp A, the position p, the gain g and
    the offset b, by inverse composition (Baker & Matthews 2004): gradients and normal equations are those of the
    template and computed once; gain and offset are projected out of them (Hager & Belhumeur 1998).

    Attributes:
        bend: (M, 2, 2) warp A of each point's template into the last image.

    Args:
        window_px: odd side of the template.
    """

    def __init__(self, window_px: int) -> None:
        half = window_px // 2
        self._side = window_px
        reach = np.arange(-half - 1, half + 2, dtype=np.float32)
        self._wide = np.stack(np.meshgrid(reach, reach), axis=-1)
        self._grid = np.ascontiguousarray(self._wide[1:-1, 1:-1].reshape(-1, 2).T)
        squared = np.sum(self._grid**2, axis=0) / half**2
        weight = np.exp(-0.5 * squared / _WEIGHT_SPREAD**2)
        self._weight = (weight / weight.sum()).astype(np.float32)
        count = window_px * window_px
        self.bend = np.zeros((0, 2, 2), np.float32)
        # Templates times their weights; and what turns a normalised patch into six parameters.
        self._weighted = np.zeros((0, count), np.float32)
        self._solver = np.zeros((0, 6, count), np.float32)

    def __len__(self) -> int:
        return len(self.bend)

    def select(self, keep: np.ndarray) -> None:
        """Forget all others."""
        self.bend = self.bend[keep]
        self._weighted = self._weighted[keep]
        self._solver = self._solver[keep]

    def add(self, image: Image, pixels: Array) -> None:
        """Take templates around ``pixels`` (K, 2) of an image (H, W) uint8."""
        if len(pixels) == 0:
            return
        weighted, solver = self._cut(image, pixels)
        self._weighted = np.concatenate([self._weighted, weighted])
        self._solver = np.concatenate([self._solver, solver])
        self.bend = np.concatenate([self.bend, np.tile(np.eye(2, dtype=np.float32), (len(pixels), 1, 1))])

    def renew(self, image: Image, pixels: Array, rows: np.ndarray) -> None:
        """Replace the templates of ``rows`` by what lies around ``pixels`` (K, 2) now."""
        self._weighted[rows], self._solver[rows] = self._cut(image, pixels)
        self.bend[rows] = np.eye(2, dtype=np.float32)

    def align(
        self, image: Image, pixels: Array, bend: np.ndarray, steps: int, rows: np.ndarray | None = None
    ) -> tuple[Array, np.ndarray, Array]:
        """Search for the templates near where they are thought to be.

        Args:
            image: (H, W) uint8.
            pixels: (K, 2) first guess of p.
            bend: (K, 2, 2) first guess of A.
            steps: Gauss–Newton steps.
            rows: (K,) which templates; all by default.

        Returns:
            pixels (K, 2), bend (K, 2, 2), and the correlation (K,) of patch and template there.
        """
        if len(pixels) == 0:
            return pixels, bend, np.zeros(0)
        weighted = self._weighted if rows is None else self._weighted[rows]
        solver = self._solver if rows is None else self._solver[rows]
        p, A = pixels.astype(np.float32), bend.copy()
        step = np.empty_like(A)
        contrast = None
        for _ in range(steps):
            patch = self._sample(image, p, A)
            # The light on a patch hardly changes between steps.
            contrast = self._contrast(patch) if contrast is None else contrast
            change = (solver @ patch[:, :, None])[:, :, 0] / contrast[:, None]
            step[:, 0, 0], step[:, 0, 1] = 1.0 + change[:, 0], change[:, 1]
            step[:, 1, 0], step[:, 1, 1] = change[:, 2], 1.0 + change[:, 3]
            # W ← W ∘ W(change)⁻¹, with the inverse of a 2×2 matrix written out.
            inverse = step[:, ::-1, ::-1].transpose(0, 2, 1).copy()
            inverse[:, 0, 1] *= -1.0
            inverse[:, 1, 0] *= -1.0
            determinant = step[:, 0, 0] * step[:, 1, 1] - step[:, 0, 1] * step[:, 1, 0]
            A = A @ (inverse / np.where(np.abs(determinant) > 0.1, determinant, 0.1)[:, None, None])
            p = p - (A @ change[:, 4:, None])[:, :, 0]
        patch = self._sample(image, p, A)
        correlation = (weighted[:, None, :] @ patch[:, :, None])[:, 0, 0] / self._contrast(patch)
        return p.astype(float), A, correlation.astype(float)

    def _sample(self, image: Image, p: np.ndarray, A: np.ndarray) -> np.ndarray:
        """Patches (K, side²) float32; their means stay in, since what they are multiplied with adds up to zero."""
        x, y = self._grid
        where = np.empty((len(p), len(x), 2), np.float32)
        for axis in (0, 1):
            place = np.multiply(A[:, axis, :1], x, out=where[:, :, axis])
            place += A[:, axis, 1:] * y
            place += p[:, axis, None]
        patch = cv2.remap(image, where, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        sampled: np.ndarray = patch.astype(np.float32)
        return sampled

    def _contrast(self, patch: np.ndarray) -> np.ndarray:
        """Root of the weighted variance (K,) of patches (K, side²)."""
        mean = patch @ self._weight
        contrast: np.ndarray = np.sqrt(np.maximum((patch * patch) @ self._weight - mean * mean, _FLAT))
        return contrast

    def _cut(self, image: Image, pixels: Array) -> tuple[np.ndarray, np.ndarray]:
        count, side, weight = len(pixels), self._side, self._weight
        where = (pixels[:, None, None, :].astype(np.float32) + self._wide).reshape(count, -1, 2)
        wide = cv2.remap(image, where, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        wide = wide.reshape(count, side + 2, side + 2).astype(np.float32)
        along_x = 0.5 * (wide[:, 1:-1, 2:] - wide[:, 1:-1, :-2]).reshape(count, -1)
        along_y = 0.5 * (wide[:, 2:, 1:-1] - wide[:, :-2, 1:-1]).reshape(count, -1)
        template = wide[:, 1:-1, 1:-1].reshape(count, -1)
        template = template - (template @ weight)[:, None]
        contrast = np.sqrt(np.maximum((template * template) @ weight, _FLAT))
        template /= contrast[:, None]
        x, y = self._grid
        slopes = np.stack([along_x * x, along_x * y, along_y * x, along_y * y, along_x, along_y], axis=1)
        slopes -= (slopes @ weight)[:, :, None]
        slopes -= ((slopes * weight) @ template[:, :, None]) * template[:, None, :]
        right = slopes * weight
        normal = (right @ slopes.transpose(0, 2, 1)).astype(float) + _DAMPING * np.eye(6)
        solver = np.linalg.inv(normal).astype(np.float32) @ right
        return template * weight, solver * contrast[:, None, None]
