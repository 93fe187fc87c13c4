"""How large one pixel is on the normalised image plane, all over the image."""

import numpy as np

from vioframe.checks import Array
from vioframe.geometry import camera as projection
from vioframe.types import Camera

# Distortion changes slowly over so many pixels.
_CELL_PX = 16
# A ray farther off the axis than 78° has no use on a plane.
_MIN_FORWARD = 0.2


class PixelNoise:
    """Turns tracked points into points of the normalised plane with their standard deviation.

    A barrel-shaped lens squeezes its margin, so that one pixel there is up to twice as much angle as in the middle.

    Args:
        camera: calibration.
        sigma_px: px, noise of an image point an axis.
    """

    def __init__(self, camera: Camera, sigma_px: float) -> None:
        width, height = camera.size_px
        x = np.arange(0.5 * _CELL_PX, width + _CELL_PX, _CELL_PX)
        y = np.arange(0.5 * _CELL_PX, height + _CELL_PX, _CELL_PX)
        middle = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        half_x, half_y = 0.5 * np.eye(2)
        right = projection.normalised(camera, middle + half_x) - projection.normalised(camera, middle - half_x)
        down = projection.normalised(camera, middle + half_y) - projection.normalised(camera, middle - half_y)
        area = np.abs(right[:, 0] * down[:, 1] - right[:, 1] * down[:, 0])
        least = 1.0 / float(np.prod(camera.intrinsics_px[:2]))
        # Beyond the lens' range the undistortion has no answer; no pixel is sharper than half the middle's.
        area = np.where(np.isfinite(area), np.maximum(area, 0.25 * least), 100.0 * least)
        self._sigmas = (sigma_px * np.sqrt(area)).reshape(len(y), len(x))

    def measure(self, pixels: Array, bearings: Array) -> tuple[Array, Array]:
        """Points (M, 2) on the plane z = 1 and their weights (M,), 1/σ; 0 where a ray is too far off the axis."""
        forward = bearings[:, 2]
        usable = forward > _MIN_FORWARD
        points = bearings[:, :2] / np.where(usable, forward, 1.0)[:, None]
        cells = (pixels / _CELL_PX).astype(np.int64)
        rows = np.clip(cells[:, 1], 0, self._sigmas.shape[0] - 1)
        columns = np.clip(cells[:, 0], 0, self._sigmas.shape[1] - 1)
        return points, np.where(usable, 1.0 / self._sigmas[rows, columns], 0.0)
