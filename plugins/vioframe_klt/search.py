"""Where the points of one image are in the next: pyramidal Lucas–Kanade, started by the gyro."""

import cv2
import numpy as np

from vioframe.checks import Array, Mask
from vioframe.geometry import camera as projection
from vioframe.geometry import so3
from vioframe.types import Camera, Image

_GRID_PX = 8
# Patches are only shifted by the search. Beyond this turn between two images, which a gap or a wild motion makes, the
# image before is turned first, as the gyro says.
_TURN_RAD = 0.15


class Search:
    """Lucas–Kanade (Bouguet 2001) from one image of a camera to the next.

    Args:
        camera: calibration.
        window_px: odd side of the patch.
        levels: pyramid levels above the full image.
        max_steps: of Lucas–Kanade, a level.
        step_px: shorter steps end the search.
    """

    def __init__(self, camera: Camera, *, window_px: int, levels: int, max_steps: int, step_px: float) -> None:
        self._camera = camera
        self._window = (window_px, window_px)
        self._levels = levels
        self._criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, max_steps, step_px)
        self._grid_bearings: Array | None = None

    def there(
        self, first: Image, second: Image, start: Array, guess: Array, levels: int | None = None
    ) -> tuple[Array, Mask]:
        """Pixels (M, 2) in the second image of the points ``start`` (M, 2) of the first, and found (M,)."""
        if len(start) == 0:
            return start, np.zeros(0, dtype=bool)
        # OpenCV's Python binding takes no pyramid built before, only images (it costs 0.3 ms of a search).
        found, status, _ = cv2.calcOpticalFlowPyrLK(
            first,
            second,
            start.astype(np.float32),
            guess.astype(np.float32),
            winSize=self._window,
            maxLevel=self._levels if levels is None else levels,
            criteria=self._criteria,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        return found.astype(float), status[:, 0] > 0

    def follow(
        self, first: Image, second: Image, pixels: Array, bearings: Array, R_first_second: Array | None
    ) -> tuple[Array, np.ndarray | None, Mask]:
        """The points of the image before, in the next.

        Args:
            first: (H, W) uint8.
            second: (H, W) uint8.
            pixels: (M, 2) in the first image.
            bearings: (M, 3) of them.
            R_first_second: (3, 3) rotation of the camera by the gyro, or None.

        Returns:
            pixels (M, 2); how a large rotation bends a patch on its way (M, 2, 2), or None; and found (M,).
        """
        if R_first_second is None:
            found, good = self.there(first, second, pixels, pixels)
            return found, None, good
        turned, visible = projection.project(self._camera, bearings @ R_first_second)
        if float(so3.angle(R_first_second)) < _TURN_RAD:
            found, good = self.there(first, second, pixels, np.where(visible[:, None], turned, pixels))
            return found, None, good
        inside = np.where(visible[:, None], turned, 0.0)
        found, good = self.there(self._turn(first, R_first_second), second, inside, inside)
        return found, self._bend(pixels, turned, R_first_second), good & visible

    def _turn(self, image: Image, R_first_second: Array) -> Image:
        """The image (H, W) as it would look after the rotation; its map is computed at every eighth pixel."""
        width, height = self._camera.size_px
        columns, rows = -(-width // _GRID_PX), -(-height // _GRID_PX)
        if self._grid_bearings is None:
            # The pixel that cv2.resize puts at the middle of each cell.
            x, y = (np.arange(count) * _GRID_PX + 0.5 * (_GRID_PX - 1) for count in (columns, rows))
            with np.errstate(all="ignore"):
                self._grid_bearings = projection.bearings(self._camera, np.stack(np.meshgrid(x, y), axis=-1))
        came_from, visible = projection.project(self._camera, self._grid_bearings @ R_first_second.T)
        came_from = np.where(visible[..., None], came_from, -1e3).astype(np.float32)
        size = (columns * _GRID_PX, rows * _GRID_PX)
        where = cv2.resize(came_from, size, interpolation=cv2.INTER_LINEAR)[:height, :width]
        turned: Image = cv2.remap(image, np.ascontiguousarray(where), None, cv2.INTER_LINEAR)
        return turned

    def _bend(self, pixels: Array, turned: Array, R_first_second: Array) -> np.ndarray:
        """Derivative (M, 2, 2) of a point's place after the rotation by its place before, by differences of 1 px."""
        columns = []
        for step in np.eye(2):
            moved, _ = projection.project(
                self._camera, projection.bearings(self._camera, pixels + step) @ R_first_second
            )
            columns.append(moved - turned)
        bend: np.ndarray = np.stack(columns, axis=-1).astype(np.float32)
        return bend
