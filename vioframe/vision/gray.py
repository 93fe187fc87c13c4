"""The image of one camera as front ends want it: checked, grey, of one exposure."""

import cv2
import numpy as np

from vioframe.errors import DataError, ShapeError
from vioframe.types import Camera, Frame, Image

_TARGET_MEAN, _TARGET_DEVIATION = 118.0, 52.0
# More contrast than this would turn sensor noise of a dark or empty image into texture.
_MAX_GAIN = 4.0


def gray_image(frame: Frame, index: int, camera: Camera, frontend: str) -> Image:
    """The grey image (H, W) uint8 of camera ``index``.

    Args:
        frame: with an image for each camera.
        index: of the camera.
        camera: its calibration.
        frontend: who asks, for messages.

    Raises:
        DataError: the frame has no image of that camera, or one that does not fit the calibration.
    """
    if len(frame.images) <= index:
        raise DataError(
            f"frame at {frame.stamp_ns} ns has {len(frame.images) or 'no'} image{'s' * (len(frame.images) != 1)}, and "
            f"frontend={frontend} needs {'two where stereo=true' if index else 'one'}"
        )
    image = frame.images[index]
    if image.shape[:2] != camera.size_px[::-1]:
        raise ShapeError(
            f"image of camera {index} at {frame.stamp_ns} ns is {image.shape[1]}×{image.shape[0]} px, but its "
            f"calibration says {camera.size_px[0]}×{camera.size_px[1]}: correct the calibration or the images"
        )
    gray = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return np.ascontiguousarray(gray)


def normalise_exposure(gray: Image) -> Image:
    """The image brought to one mean and contrast, which are measured on every second row and column."""
    mean, deviation = (float(v[0, 0]) for v in cv2.meanStdDev(gray[::2, ::2]))
    gain = min(_TARGET_DEVIATION / max(deviation, 1e-3), _MAX_GAIN)
    table = np.clip(np.rint(_TARGET_MEAN + gain * (np.arange(256.0) - mean)), 0, 255).astype(np.uint8)
    normalised: Image = cv2.LUT(gray, table)
    return normalised
